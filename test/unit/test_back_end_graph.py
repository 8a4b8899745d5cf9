"""The graph of keyframes with pairs that lie or say nothing: never far from the truth."""

from __future__ import annotations

from dataclasses import dataclass, replace
from itertools import pairwise

import numpy as np
import pytest

from bdgs_ros.back_end import graph
from bdgs_ros.back_end.calibration import Calibration, Known
from bdgs_ros.back_end.graph import Edge, Solution, solve
from bdgs_ros.back_end.pair import PairFactor
from bdgs_ros.core import se3
from bdgs_ros.core.config.back_end import BundleConfig

Array = np.ndarray
CONFIG = BundleConfig()
PERFECT = Calibration.perfect()
KNOWN = Known(PERFECT, CONFIG.readout_sigma_s)
FOCAL_PX = 260.0
WINDOW = 8


@dataclass(frozen=True)
class Case:
    """A walk with drift, and what pairs say of it."""

    truth: list[Array]
    start: list[Array]
    edges: list[Edge]

    @property
    def off_m(self) -> float:
        """How far the start is from the truth."""
        return off_m(self.truth, self.start)


def off_m(truth: list[Array], poses: list[Array]) -> float:
    return max(
        float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in zip(truth, poses, strict=True)
    )


def factor(T_other_one: Array, rng: np.random.Generator, degenerate: bool = False) -> PairFactor:
    """Return what 30 corners with usual noise say, or one corner seen 30 times."""
    points = rng.uniform([-1, -0.8, 1], [1, 0.8, 4], (30, 3))
    if degenerate:
        points[:] = points[0]
    J = np.zeros((30, 3, 12))
    px = FOCAL_PX / CONFIG.pixel_sigma
    for row, (x, y, z) in zip(J, points, strict=True):
        by_point = np.array(
            [
                [px / z, 0, -px * x / z**2],
                [0, px / z, -px * y / z**2],
                [0, 0, -1 / z**2 / CONFIG.inverse_depth_sigma],
            ]
        )
        row[:, :3], row[:, 3:6] = by_point, -by_point @ se3.hat(np.array([x, y, z]))
        row[2, 6:11] = rng.normal(0, 1 / CONFIG.inverse_depth_sigma, 5)
        row[:2, 11] = rng.normal(0, 0.3 * px, 2)
    J = J.reshape(-1, 12)
    information, gradient = J.T @ J, J.T @ rng.normal(size=len(J))
    xi = np.linalg.solve(information[:6, :6] + 1e-3 * np.eye(6), -gradient[:6])
    return PairFactor(
        se3.exp(xi) @ T_other_one,
        PERFECT,
        0.0,
        (np.zeros(6), np.zeros(6)),
        information,
        gradient + information[:, :6] @ xi,
        30,
    )


def a_walk(seed: int, count: int, drift: float = 1.0) -> tuple[list[Array], list[Array]]:
    """Return the truth and what odometry makes of it."""
    rng = np.random.default_rng(seed)
    truth, start = [np.eye(4)], [np.eye(4)]
    for _ in range(count - 1):
        step = se3.exp(rng.normal(0, np.repeat([0.08, 0.15], 3)))
        error = drift * rng.normal(0, np.repeat([CONFIG.odometry_m, CONFIG.odometry_rad], 3))
        truth.append(truth[-1] @ step)
        start.append(start[-1] @ step @ se3.exp(error))
    return truth, start


def a_case(
    seed: int,
    count: int = 30,
    wrong: float = 0.0,
    degenerate: float = 0.0,
    lonely: int = 0,
    wrong_by: tuple[float, float] = (0.5, 0.5),
) -> Case:
    """Join each pose with eight before; some pairs lie, by m and rad, or say little."""
    rng = np.random.default_rng(1000 + seed)
    truth, start = a_walk(seed, count)
    alone = rng.choice(np.arange(1, count), lonely, replace=False)
    edges = []
    for one in range(count):
        for other in range(max(0, one - WINDOW), one):
            T = se3.inverse(truth[other]) @ truth[one]
            if rng.random() < wrong:
                T = se3.exp(rng.normal(0, np.repeat(wrong_by, 3))) @ T
            pair = Edge(one, other, factor(T, rng, rng.random() < degenerate))
            if not {one, other} & set(alone):
                edges.append(pair)
    return Case(truth, start, edges)


def solved(case: Case, start: list[Array] | None = None) -> Solution:
    return solve(start or case.start, case.edges, PERFECT, KNOWN, CONFIG)


@pytest.mark.parametrize('seed', range(4))
@pytest.mark.parametrize(
    'faults',
    [
        {},
        {'wrong': 0.3},
        {'wrong': 0.3, 'wrong_by': (3.0, 1.5)},
        {'wrong': 0.3, 'lonely': 6},
        {'wrong': 0.1, 'degenerate': 0.5},
        {'count': 90, 'wrong': 0.3},
    ],
)
def test_solved_poses_are_nearer_to_the_truth_than_odometry(seed: int, faults: dict) -> None:
    case = a_case(seed, **faults)
    poses = solved(case).poses
    assert np.isfinite(poses).all()
    # A keyframe without pairs stays between its neighbours, as well as odometry knows.
    at_most = 5 * CONFIG.odometry_m if 'lonely' in faults else 2 * CONFIG.odometry_m
    assert off_m(case.truth, poses) < at_most


@pytest.mark.parametrize('off', [100.0, 1e4, 1e6])
def test_pairs_that_are_kilometres_off_move_nothing(off: float) -> None:
    """At eb10d7b such pairs moved the keyframes by up to 100 km, in every round anew."""
    case = a_case(1, count=40)
    for i in (10, 40, 80, 120, 200):
        pair = case.edges[i].factor
        T = se3.exp(np.array([off, -off, off, 0.5, 1.0, -0.5])) @ pair.T_other_one
        case.edges[i] = replace(case.edges[i], factor=replace(pair, T_other_one=T))
    poses = case.start
    for _ in range(3):
        solution = solved(case, poses)
        poses = solution.poses
        assert off_m(case.truth, poses) < 2 * CONFIG.odometry_m
        assert abs(solution.calibration.readout_s) < 0.01


def test_a_pair_given_twice_is_no_harm() -> None:
    case = a_case(2)
    twice = replace(case, edges=[*case.edges, *case.edges])
    assert off_m(case.truth, solved(twice).poses) < 2 * CONFIG.odometry_m


@pytest.mark.parametrize('far', [3.0, 1e3, 1e7])
def test_a_far_start_stays_finite_and_comes_no_further(far: float) -> None:
    case = a_case(3)
    T = se3.exp(np.array([far, 0, far, 0.3, 2.0, 0]))
    start = case.start[:15] + [T @ pose for pose in case.start[15:]]
    poses = solved(case, start).poses
    assert np.isfinite(poses).all()
    assert off_m(case.truth, poses) < 1.1 * off_m(case.truth, start)


def test_information_that_is_not_positive_is_damped_and_raises_nothing() -> None:
    case = a_case(4)
    bad = case.edges[5].factor
    case.edges[5] = replace(case.edges[5], factor=replace(bad, information=-bad.information))
    assert np.isfinite(solved(case).poses).all()


def test_the_first_pose_stays_where_it_is() -> None:
    case = a_case(5)
    start = [se3.exp(np.array([1, 2, 3, 0.1, 0.2, 0.3])) @ pose for pose in case.start]
    np.testing.assert_allclose(solved(case, start).poses[0], start[0], atol=1e-9)


def test_the_change_of_a_motion_is_the_logarithm_also_if_it_is_large() -> None:
    rng = np.random.default_rng(0)
    before, after = ([se3.exp(rng.normal(size=6)) for _ in range(20)] for _ in range(2))
    now, then = ([se3.inverse(b) @ a for a, b in pairwise(p)] for p in (after, before))
    expected = [se3.log(n @ se3.inverse(t)) for n, t in zip(now, then, strict=True)]
    np.testing.assert_allclose(graph.motions_apart(before, after), expected, atol=1e-9)
