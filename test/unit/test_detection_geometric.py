"""The class-agnostic prior, in a ray-cast room in which a ball moves or does not."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.detection import GeometricConfig
from bdgs_ros.core.types import Pose, ProbabilityImage, RgbdFrame
from bdgs_ros.detection.geometric import GeometricPrior, free_depth, free_space_gap, grow

CAMERA = PinholeCamera(320, 240, 262.0, 262.0, 159.5, 119.5)
CONFIG = GeometricConfig()
PERIOD_NS = 33_333_333


class KnownMotion:
    """The ego-motion of the test: told, not estimated."""

    def __init__(self) -> None:
        self.pose: Pose | None = se3.identity()
        self.told: ProbabilityImage | None = None

    def update(self, frame: RgbdFrame, p_dynamic: ProbabilityImage) -> Pose | None:
        """Return what the test set."""
        self.told = p_dynamic
        return self.pose

    def reset(self) -> None:
        """Keep what the test set."""


def cast(T_world_camera: Pose, ball: tuple[float, float, float] | None) -> tuple:
    """Return depth and ball mask of a room of 6 x 3 x 8 m with a pillar, and a ball of 0.3 m."""
    rays = CAMERA.rays().reshape(-1, 3).astype(np.float64) @ T_world_camera[:3, :3].T
    eye = T_world_camera[:3, 3]
    low, high = np.array([-3.0, -1.5, -4.0]), np.array([3.0, 1.5, 4.0])
    with np.errstate(divide='ignore', invalid='ignore'):
        depth = np.maximum((low - eye) / rays, (high - eye) / rays).min(axis=1)
    depth = np.minimum(depth, _sphere(rays, eye, (0.9, 0.4, 2.4), 0.5))
    if ball is None:
        return depth.reshape(CAMERA.shape), np.zeros(CAMERA.shape, bool)
    hit = _sphere(rays, eye, ball, 0.3)
    return np.minimum(depth, hit).reshape(CAMERA.shape), (hit < depth).reshape(CAMERA.shape)


def _sphere(rays: np.ndarray, eye: np.ndarray, centre: tuple, radius: float) -> np.ndarray:
    to = np.array(centre) - eye
    a, b, c = (rays**2).sum(1), rays @ to, to @ to - radius**2
    root = b**2 - a * c
    return np.where(root > 0, (b - np.sqrt(np.maximum(root, 0))) / a, np.inf)


def observe(k: int, pose: Pose, ball: tuple | None) -> tuple[RgbdFrame, np.ndarray]:
    """Return frame number k with Kinect noise, and the truth."""
    depth, truth = cast(pose, ball)
    rng = np.random.default_rng(k)
    depth = depth + 0.0025 * depth**2 * rng.standard_normal(depth.shape)
    depth[rng.random(depth.shape) < 0.02] = 0
    color = np.zeros((*CAMERA.shape, 3), np.uint8)
    return RgbdFrame(k * PERIOD_NS, color, depth.astype(np.float32), CAMERA), truth


def shaking(k: int) -> Pose:
    """Return a camera that turns and sways."""
    t = k / 30
    return se3.exp(
        np.array(
            [
                0.1 * np.sin(3 * t),
                0.05 * np.sin(4 * t),
                0,
                0.1 * np.sin(5 * t),
                0.3 * np.sin(3 * t),
                0.15 * np.sin(6 * t),
            ]
        )
    )


def run(n: int, pose_of, ball_of, told_of=None) -> list[tuple]:
    """Process n frames; return (P, truth) of each."""
    motion = KnownMotion()
    prior = GeometricPrior(CONFIG, motion)
    out = []
    for k in range(n):
        motion.pose = (told_of or pose_of)(k)
        frame, truth = observe(k, pose_of(k), ball_of(k))
        out.append((prior.process(frame, np.zeros(CAMERA.shape, np.uint8)), truth))
    return out


def test_static_room_stays_empty_under_a_shaking_camera() -> None:
    """Occlusion edges, noise and holes raise no alarm."""
    assert max((p > 0).mean() for p, _ in run(60, shaking, lambda k: (-0.5, 0.5, 2.0))) == 0.0


def test_a_moving_ball_is_found_whole() -> None:
    """A thing that no class table names."""
    results = run(40, shaking, lambda k: (-1.2 + 0.04 * k, 0.3, 2.0))
    for p, truth in results[15:]:
        found = p >= 128
        assert (found & truth).sum() > 0.85 * truth.sum()
        assert (found & truth).sum() > 0.5 * found.sum()


def test_a_ball_that_rests_is_static_again() -> None:
    """After the longest lag."""
    results = run(120, lambda k: se3.identity(), lambda k: (min(-1.2 + 0.04 * k, 0.0), 0.3, 2.0))
    assert (results[32][0] > 0).any()
    assert not (results[-1][0] > 0).any()


def test_wrong_ego_motion_gives_no_garbage() -> None:
    """When most depths disagree, the poses are wrong and not the world."""

    def wrong(k: int) -> Pose:
        return se3.exp(np.array([0, 0, 0.1 * k, 0, 0.0, 0]))

    assert not any(
        (p > 0).any() for p, _ in run(30, lambda k: se3.identity(), lambda k: None, wrong)
    )


def test_unknown_ego_motion_gives_nothing_and_starts_anew() -> None:
    """Frames from before the gap are not compared with."""
    motion = KnownMotion()
    prior = GeometricPrior(CONFIG, motion)
    for k in range(25):
        motion.pose = None if k == 20 else se3.identity()
        frame, _ = observe(k, se3.identity(), (-1.2 + 0.04 * k, 0.3, 2.0))
        p = prior.process(frame, np.zeros(CAMERA.shape, np.uint8))
        assert (k < 20) or not p.any()


def test_ego_motion_is_told_what_moves() -> None:
    """The prior handed in and the mask of the last frame."""
    motion = KnownMotion()
    prior = GeometricPrior(CONFIG, motion)
    given = np.zeros(CAMERA.shape, np.uint8)
    given[:20, :20] = 200
    for k in range(20):
        frame, _ = observe(k, se3.identity(), (-1.2 + 0.04 * k, 0.3, 2.0))
        last = prior.process(frame, given)
    assert last.any() and motion.told is not None
    assert motion.told[5, 5] == 200
    assert (motion.told > 0).sum() > 400


def test_free_space_gap_is_exact_on_a_wall() -> None:
    """A point 1 m before a wall 3 m away, seen from 0.5 m further back."""
    camera = PinholeCamera(40, 30, 30.0, 30.0, 19.5, 14.5)
    wall = np.full(camera.shape, 3.0, np.float32)
    T_ref_camera = se3.exp(np.array([0, 0, 0.5, 0, 0, 0]))
    near = camera.unproject(np.full(camera.shape, 1.5, np.float32))
    gap = free_space_gap(near, T_ref_camera, wall, camera)
    assert gap[15, 20] == pytest.approx(1.0, abs=1e-5)
    blind = free_space_gap(near, T_ref_camera, np.zeros_like(wall), camera)
    assert np.isnan(blind).all()


def test_free_depth_is_unknown_beside_holes() -> None:
    """And the least depth beside edges."""
    depth = np.full((9, 9), 2.0, np.float32)
    depth[4, 4], depth[0, 8] = 0.0, 1.0
    free = free_depth(depth, 1)
    assert (free[3:6, 3:6] == 0).all() and free[1, 7] == 1.0 and free[8, 0] == 2.0


def test_grow_takes_surfaces_that_are_mostly_new() -> None:
    """A tenth of a wall does not move the wall; half of an object moves it all."""
    depth = np.full((60, 80), 3.0, np.float32)
    depth[20:40, 20:50] = 2.0
    seeds = np.zeros(depth.shape, bool)
    seeds[20:40, 36:50] = True
    seeds[50:60, 60:80] = True
    grown = grow(seeds, ~seeds & (depth > 2.5), depth, 0.15)
    assert grown[30, 22] and not grown[10, 10] and not grown[55, 50]
