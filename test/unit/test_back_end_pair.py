"""Two views of a room with exact corners: derivatives, motion, bend, rolling shutter, movers."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
import pytest

from bdgs_ros.back_end.calibration import Calibration, Known
from bdgs_ros.back_end.corners import Shared
from bdgs_ros.back_end.graph import Edge, solve
from bdgs_ros.back_end.pair import PairFactor, condense, linearise
from bdgs_ros.core import se3
from bdgs_ros.core.bend import bend_functions
from bdgs_ros.core.config import BackEndConfig

CONFIG = BackEndConfig().bundle
FOCAL = 500.0
STILL = np.zeros(6)
SIGMA_S = 0.03
UNKNOWN = Known(Calibration.perfect(), SIGMA_S)


@dataclass(frozen=True)
class Room:
    """Points in world and a camera with a rolling shutter and a bent depth sensor."""

    points: np.ndarray
    calibration: Calibration

    @classmethod
    def random(cls, calibration: Calibration, seed: int = 0) -> Room:
        rng = np.random.default_rng(seed)
        points = rng.uniform([-1.2, -0.9, 1.5], [1.2, 0.9, 4.0], (60, 3))
        return cls(points, calibration)

    def seen(self, T_world_camera: np.ndarray, twist: np.ndarray) -> tuple[np.ndarray, ...]:
        """Return tangents, rows and measured inverse depth of all points."""
        row = np.zeros(len(self.points))
        for _ in range(10):  # the row of a point depends on when it is seen
            points = np.array(
                [
                    (se3.inverse(T_world_camera @ se3.exp(v * self.calibration.readout_s * twist)))
                    @ [*p, 1]
                    for p, v in zip(self.points, row, strict=True)
                ]
            )
            tangents = points[:, :2] / points[:, 2:3]
            row = tangents[:, 1] * FOCAL / 480
        bend = bend_functions(tangents) @ self.calibration.bend
        return tangents, row, 1 / points[:, 2] - bend

    def share(
        self,
        T_one: np.ndarray,
        T_other: np.ndarray,
        twists: tuple[np.ndarray, np.ndarray] = (STILL, STILL),
    ) -> Shared:
        one, other = self.seen(T_one, twists[0]), self.seen(T_other, twists[1])
        rows = np.stack([one[1], other[1]], axis=1)
        return Shared(one[0], one[2], other[0], other[2], rows, np.ones(len(rows)))


def motions(count: int, seed: int = 0) -> list[np.ndarray]:
    """Return poses within a decimetre and a few degrees of the origin; the first is there."""
    rng = np.random.default_rng(seed)
    xis = rng.normal(0, 1, (count, 6)) * [0.1, 0.1, 0.1, 0.05, 0.05, 0.05]
    return [se3.identity(), *(se3.exp(xi) for xi in xis[1:])]


def test_derivatives_agree_with_differences() -> None:
    rng = np.random.default_rng(1)
    calibration = Calibration(rng.normal(0, 0.02, 5), 0.03)
    T = motions(2)[1]
    twists = (rng.normal(0, 0.5, 6), rng.normal(0, 0.5, 6))
    shared = Room.random(calibration).share(se3.identity(), se3.inverse(T), twists)
    inverse = shared.inverse_depth * 1.05

    def residuals(y: np.ndarray, change: float = 0.0) -> np.ndarray:
        moved = Calibration.of_vector(calibration.vector + y[6:])
        return linearise(
            shared, se3.exp(y[:6]) @ T, twists, moved, inverse + change, FOCAL, CONFIG
        ).residuals

    linear = linearise(shared, T, twists, calibration, inverse, FOCAL, CONFIG)
    step = 1e-6
    for i in range(12):
        y = np.zeros(12)
        y[i] = step
        slope = (residuals(y) - residuals(-y)) / (2 * step)
        # what the rolling shutter's small motion changes in a small motion is left out
        tolerance = 1e-5 if 6 <= i < 11 else 2e-2
        scale = np.abs(slope).max() + 1.0
        np.testing.assert_allclose(
            linear.by_unknowns[:, :, i] / scale, slope / scale, atol=tolerance
        )
    slope = (residuals(np.zeros(12), step) - residuals(np.zeros(12), -step)) / (2 * step)
    assert np.abs(linear.by_inverse - slope).max() < 0.05 * np.abs(slope).max()


def pair(room: Room, T_one: np.ndarray, T_other: np.ndarray, start: np.ndarray) -> PairFactor:
    shared = room.share(T_one, T_other)
    return condense(shared, start, (STILL, STILL), Calibration.perfect(), SIGMA_S, FOCAL, CONFIG)


def test_the_motion_between_two_views_is_found() -> None:
    room = Room.random(Calibration.perfect())
    truth = motions(2)[1]
    start = se3.exp(np.full(6, 0.02)) @ truth
    found = pair(room, truth, se3.identity(), start)
    np.testing.assert_allclose(found.T_other_one, truth, atol=1e-5)
    assert found.inliers == 60


def test_movers_have_no_say() -> None:
    room = Room.random(Calibration.perfect())
    truth = motions(2)[1]
    shared = room.share(truth, se3.identity())
    walking = np.arange(60) < 25
    there = shared.tangents_other + np.where(walking[:, None], [0.05, 0.0], 0.0)
    known = replace(shared, tangents_other=there, p_static=np.where(walking, 0.0, 1.0))
    found = condense(known, truth, (STILL, STILL), Calibration.perfect(), SIGMA_S, FOCAL, CONFIG)
    np.testing.assert_allclose(found.T_other_one, truth, atol=1e-5)
    unknown = replace(known, p_static=np.ones(60))
    fooled = condense(
        unknown, truth, (STILL, STILL), Calibration.perfect(), SIGMA_S, FOCAL, CONFIG
    )
    assert np.abs(fooled.T_other_one - truth).max() > 1e-4


def noisy(poses: list[np.ndarray], seed: int = 5) -> list[np.ndarray]:
    rng = np.random.default_rng(seed)
    sigma = np.repeat([0.02, 0.01], 3)
    return [poses[0], *(se3.exp(rng.normal(0, sigma)) @ T for T in poses[1:])]


def edges(room: Room, poses: list[np.ndarray], twists: list[np.ndarray]) -> list[Edge]:
    start = noisy(poses)
    found = []
    for one in range(len(poses)):
        for other in range(max(0, one - 4), one):
            shared = room.share(poses[one], poses[other], (twists[one], twists[other]))
            T = se3.inverse(start[other]) @ start[one]
            moving = twists[one], twists[other]
            perfect = Calibration.perfect()
            found.append(
                Edge(one, other, condense(shared, T, moving, perfect, SIGMA_S, FOCAL, CONFIG))
            )
    return found


def worst_m(found: list[np.ndarray], truth: list[np.ndarray]) -> float:
    return max(
        float(np.linalg.norm(a[:3, 3] - b[:3, 3])) for a, b in zip(found, truth, strict=True)
    )


def test_noisy_poses_are_put_right() -> None:
    room = Room.random(Calibration.perfect())
    truth = motions(8)
    still = [STILL] * 8
    solution = solve(
        noisy(truth), edges(room, truth, still), Calibration.perfect(), UNKNOWN, CONFIG
    )
    assert worst_m(noisy(truth), truth) > 0.02
    assert worst_m(solution.poses, truth) < 0.001
    assert abs(solution.calibration.readout_s) < 0.001


@pytest.mark.parametrize('readout_s', [0.0, 0.03])
def test_a_rolling_shutter_is_found_and_taken_out(readout_s: float) -> None:
    bend = np.array([0.0, 0.0, -0.02, 0.01, 0.01])
    room = Room.random(Calibration(bend, readout_s))
    truth = motions(10)
    rng = np.random.default_rng(2)
    twists = [rng.normal(0, [0.2] * 3 + [0.5] * 3) for _ in truth]
    solution = solve(
        noisy(truth), edges(room, truth, twists), Calibration.perfect(), UNKNOWN, CONFIG
    )
    assert solution.calibration.readout_s == pytest.approx(readout_s, abs=0.002)
    np.testing.assert_allclose(solution.calibration.bend, bend, atol=0.005)
    blind = Known(Calibration.perfect(), 1e-6)
    without = solve(noisy(truth), edges(room, truth, twists), Calibration.perfect(), blind, CONFIG)
    assert worst_m(solution.poses, truth) < 0.003
    if readout_s:
        assert worst_m(without.poses, truth) > 2 * worst_m(solution.poses, truth)


def test_a_pair_that_turned_back_tells_the_readout_at_once() -> None:
    room = Room.random(Calibration(np.zeros(5), 0.025))
    truth = motions(2)[1]
    turning = np.array([0, 0, 0, 0, 1.8, 0])
    shared = room.share(truth, se3.identity(), (turning, -turning))
    known = Calibration.perfect(), SIGMA_S, FOCAL, CONFIG
    factor = condense(shared, truth, (turning, -turning), *known)
    assert factor.calibration.readout_s == pytest.approx(0.025, abs=0.001)
    assert factor.inliers > 55
    held = condense(shared, truth, (turning, -turning), Calibration.perfect(), 1e-6, *known[2:])
    assert held.inliers < 45


def test_what_is_known_of_the_shutter_is_kept_where_nothing_moves() -> None:
    room = Room.random(Calibration.perfect())
    truth = motions(4)
    known = Known(Calibration(np.zeros(5), 0.02), 0.002)
    solution = solve(truth, edges(room, truth, [STILL] * 4), known.calibration, known, CONFIG)
    assert solution.calibration.readout_s == pytest.approx(0.02, abs=1e-4)
    assert solution.readout_sigma_s == pytest.approx(0.002, rel=0.01)


def test_a_pair_that_all_others_contradict_is_overruled() -> None:
    room = Room.random(Calibration.perfect())
    truth = motions(8)
    good = edges(room, truth, [STILL] * 8)
    false = replace(good[0].factor, T_other_one=se3.exp(np.array([0.3, 0, 0, 0, 0, 0])))
    solution = solve(
        noisy(truth), [*good, Edge(7, 0, false)], Calibration.perfect(), UNKNOWN, CONFIG
    )
    assert worst_m(solution.poses, truth) < 0.003


@pytest.mark.parametrize('seed', range(6))
def test_the_kernel_agrees_with_its_twin(seed: int) -> None:
    """With movers, missing depth, rolling shutter and bend: to the last digits."""
    pytest.importorskip('bdgs_ros._two_views')
    rng = np.random.default_rng(seed)
    calibration = Calibration(rng.normal(0, 0.02, 5), 0.02 * seed / 5)
    one, other = motions(3, seed)[1:]
    twists = (rng.normal(0, 0.5, 6), rng.normal(0, 0.5, 6))
    shared = Room.random(calibration, seed).share(one, other, twists)
    shared.tangents_other[:10] += rng.normal(0, 0.2, (10, 2))
    shared.inverse_depth_other[10:20] = 0
    shared.p_static[20:30] = rng.uniform(0, 1, 10)
    start = se3.exp(rng.normal(0, 0.01, 6)) @ se3.inverse(other) @ one
    given = shared, start, twists, calibration, SIGMA_S, FOCAL, CONFIG
    fast, slow = condense(*given), condense(*given, native=False)
    assert np.abs(fast.T_other_one - slow.T_other_one).max() < 1e-9
    assert abs(fast.calibration.readout_s - slow.calibration.readout_s) < 1e-9
    scale = np.abs(slow.information).max()
    assert np.abs(fast.information - slow.information).max() < 1e-8 * scale
    # at the optimum the pull of the motion is what is left of large numbers
    assert np.abs(fast.gradient - slow.gradient).max() < 1e-8 * scale
    assert fast.inliers == slow.inliers


def test_the_kernel_refuses_arrays_that_do_not_fit() -> None:
    pytest.importorskip('bdgs_ros._two_views')
    one, other = motions(2)
    shared = Room.random(Calibration.perfect()).share(one, other)
    short = replace(shared, p_static=shared.p_static[:-1])
    with pytest.raises(ValueError, match='p_static: expected 60 numbers, received 59'):
        condense(short, one, (STILL, STILL), Calibration.perfect(), SIGMA_S, FOCAL, CONFIG)
