"""What the graph found is looked at before anything moves; what cannot be is refused."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from test_back_end import CONFIG, SECOND, STEP_M, at, keyframe, run, texture
from test_back_end_graph import KNOWN, PERFECT, Case, a_case, solved

from bdgs_ros.back_end import back_end as module
from bdgs_ros.back_end.back_end import BackEnd
from bdgs_ros.back_end.calibration import Calibration
from bdgs_ros.back_end.check import objection
from bdgs_ros.back_end.graph import Edge, Solution, solve
from bdgs_ros.core import se3

XS = [STEP_M * i for i in range(5)]


def objection_to(case: Case, solution: Solution) -> str:
    return objection(case.start, solution, case.edges, PERFECT, KNOWN, CONFIG.bundle)


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize('wrong', [0.0, 0.3])
def test_nothing_speaks_against_what_is_right(seed: int, wrong: float) -> None:
    case = a_case(seed, wrong=wrong)
    assert not objection_to(case, solved(case))


def test_what_is_no_motion_is_refused() -> None:
    case = a_case(0)
    solution = solved(case)
    for scale in (np.nan, np.inf, 2.0):
        bad = [*solution.poses[:-1], np.full((4, 4), scale)]
        assert 'no motions' in objection_to(case, replace(solution, poses=bad))


@pytest.mark.parametrize('readout_s', [9.0, np.nan])
def test_a_shutter_that_no_camera_has_is_refused(readout_s: float) -> None:
    case = a_case(0)
    bad = Calibration(np.zeros(5), readout_s)
    assert 'no camera' in objection_to(case, replace(solved(case), calibration=bad))


def test_poses_that_suit_the_pairs_less_are_refused() -> None:
    case = a_case(0)
    solution = solved(case)
    rng = np.random.default_rng(0)
    bad = [se3.exp(rng.normal(0, 1, 6)) @ pose for pose in solution.poses]
    assert 'worse' in objection_to(case, replace(solution, poses=bad))


def test_neighbours_are_not_torn_apart_where_no_pair_joins_them() -> None:
    case = a_case(0)
    parted = [e for e in case.edges if (e.one < 15) == (e.other < 15)]
    case = replace(case, edges=parted)
    solution = solved(case)
    assert not objection_to(case, solution)
    moved = [*solution.poses[:15], *(at(1.0) @ pose for pose in solution.poses[15:])]
    assert 'torn' in objection_to(case, replace(solution, poses=moved))


def diverged(poses: Sequence[np.ndarray], edges: Sequence[Edge], *given: Any) -> Solution:
    solution = solve(poses, edges, *given)
    return replace(solution, poses=[at(1e7 * i) @ pose for i, pose in enumerate(poses)])


def test_a_refused_correction_moves_nothing_and_is_counted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    back_end = BackEnd(CONFIG)
    poses = run(back_end, XS, np.zeros(6))
    readout_s = back_end.readout_s
    monkeypatch.setattr(module, 'solve', diverged)
    for i in (5, 6):
        assert not back_end.process(keyframe(i, STEP_M * i, texture(), at(STEP_M * i)), poses)
    assert (back_end.refusals, back_end.refused_in_row) == (2, 2)
    assert back_end.readout_s == readout_s
    monkeypatch.setattr(module, 'solve', solve)
    moved = back_end.process(keyframe(7, STEP_M * 7, texture(), at(STEP_M * 7 + 0.05)), poses)
    assert (back_end.refusals, back_end.refused_in_row) == (2, 0)
    np.testing.assert_allclose(moved[7 * SECOND][:3, 3], [-0.05, 0, 0], atol=0.01)


def test_a_pair_that_breaks_the_solution_leaves(monkeypatch: pytest.MonkeyPatch) -> None:
    back_end = BackEnd(CONFIG)
    poses = run(back_end, XS, np.zeros(6))
    pair = back_end._pairs[4 * SECOND, SECOND]
    far = replace(pair.factor, T_other_one=at(1e4) @ pair.factor.T_other_one)
    pair.factor = far

    def breaks(given: Sequence[np.ndarray], edges: Sequence[Edge], *rest: Any) -> Solution:
        worst = any(edge.factor is far for edge in edges)
        return (diverged if worst else solve)(given, edges, *rest)

    monkeypatch.setattr(module, 'solve', breaks)
    back_end.process(keyframe(5, STEP_M * 5, texture(), at(STEP_M * 5)), poses)
    assert back_end.refusals == 0
    assert (4 * SECOND, SECOND) not in back_end._pairs
    assert (4 * SECOND, 2 * SECOND) in back_end._pairs


def test_poses_that_are_no_motions_are_not_taken() -> None:
    back_end = BackEnd(CONFIG)
    poses = run(back_end, XS, np.zeros(6))
    assert not back_end.process(keyframe(5, 0.5, texture(), np.full((4, 4), np.nan)), poses)
    assert back_end.refused_in_row == 1
    back_end.process(keyframe(6, 0.6, texture(), at(0.6)), poses)
    assert back_end.refused_in_row == 0


def test_a_jump_amid_the_frames_is_no_velocity() -> None:
    back_end = BackEnd(CONFIG)
    for i in range(6):
        back_end.observe(i * 30_000_000, at(0.0 if i < 4 else 3.0))
    assert not back_end._velocity(3 * 30_000_000 + 30_000_000).any()
