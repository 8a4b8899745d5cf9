"""The back end on keyframes of a wall: drift is taken out, loops close, look-alikes do not."""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bdgs_ros.back_end.back_end import BackEnd
from bdgs_ros.back_end.corners import View, find_corners, follow
from bdgs_ros.back_end.loop import LoopDetector, Recognised, agree
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BackEndConfig, with_values
from bdgs_ros.core.types import Keyframe, RgbdFrame

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
CONFIG = BackEndConfig()
SECOND = 1_000_000_000
STEP_M = 0.1
_PER_M = 130.0  # texture pixels: as many as the camera resolves at 2 m


def texture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = np.kron(rng.integers(40, 215, (80, 160)), np.ones((6, 6))).astype(np.uint8)
    return np.asarray(cv2.GaussianBlur(coarse, (5, 5), 1.0))


def shot(stamp_ns: int, x_m: float, image: np.ndarray) -> RgbdFrame:
    """Photograph a wall 2 m away, looking straight at it, from `x_m` beside the origin."""
    affine = np.float64([[1, 0, -250 - x_m * _PER_M], [0, 1, -120]])
    grey = cv2.warpAffine(image, affine, (CAMERA.width, CAMERA.height))
    color = np.repeat(grey[..., None], 3, axis=2)
    return RgbdFrame(stamp_ns, color, np.full(CAMERA.shape, 2.0, np.float32), CAMERA)


def at(x_m: float) -> np.ndarray:
    return se3.from_rotation_translation(np.eye(3), np.array([x_m, 0.0, 0.0]))


def keyframe(index: int, x_m: float, image: np.ndarray, T: np.ndarray | None = None) -> Keyframe:
    frame = shot(index * SECOND, x_m, image)
    return Keyframe(frame, at(x_m) if T is None else T, np.zeros(CAMERA.shape, np.uint8))


def test_corners_are_followed_to_a_tenth_of_a_pixel() -> None:
    one, other = (View.of(keyframe(i, x, texture()), np.zeros(6)) for i, x in ((0, 0), (1, 0.1)))
    corners = find_corners(one, CONFIG.bundle)
    shared = follow(corners, other, at(-0.08))
    assert len(shared) > 20
    moved = (shared.tangents_other - shared.tangents) * CAMERA.fx
    assert np.abs(np.median(moved, axis=0) - [-0.1 * _PER_M, 0]).max() < 0.1


def test_nothing_is_followed_that_moves() -> None:
    moving = np.zeros(CAMERA.shape, np.uint8)
    moving[:, :160] = 255
    view = View.of(replace(keyframe(0, 0.0, texture()), p_dynamic=moving), np.zeros(6))
    assert find_corners(view, CONFIG.bundle).pixels[:, 0].min() > 160


def run(back_end: BackEnd, xs: list[float], error_per_step: np.ndarray) -> dict[int, np.ndarray]:
    """Move along a wall with drifting odometry; return the poses at the end by stamp."""
    poses: dict[int, np.ndarray] = {}
    image, drift = texture(), np.eye(4)
    T_new_old = np.eye(4)  # of tracking, which follows the newest keyframe
    for i, x in enumerate(xs):
        if i:
            drift = drift @ se3.exp(error_per_step)
        T = T_new_old @ drift @ at(x)
        moved = back_end.process(keyframe(i, x, image, T), poses)
        poses[i * SECOND] = T
        if moved:
            T_new_old = moved[i * SECOND] @ T_new_old
            poses = {stamp_ns: moved[stamp_ns] @ pose for stamp_ns, pose in poses.items()}
    return poses


def errors_m(poses: dict[int, np.ndarray], xs: list[float]) -> np.ndarray:
    return np.array(
        [np.linalg.norm(poses[i * SECOND][:3, 3] - [x, 0, 0]) for i, x in enumerate(xs)]
    )


DRIFT = np.array([0.01, 0.004, 0, 0, 0, 0.002])


def test_drift_between_keyframes_is_taken_out() -> None:
    xs = [STEP_M * i for i in range(10)]
    off = run(BackEnd(with_values(CONFIG, {'bundle.enabled': False})), xs, DRIFT)
    on = run(BackEnd(CONFIG), xs, DRIFT)
    assert errors_m(off, xs).max() > 0.08
    assert errors_m(on, xs).max() < 0.02


def test_corrections_one_after_the_other_stay_rigid_motions() -> None:
    """At eb10d7b what poses were off SO(3) doubled with each; after 54 the graph was singular."""
    xs = [STEP_M * abs((i + 15) % 30 - 15) for i in range(60)]
    poses = run(BackEnd(CONFIG), xs, 0.3 * DRIFT)
    rotations = np.array([pose[:3, :3] for pose in poses.values()])
    off = rotations @ rotations.swapaxes(1, 2) - np.eye(3)
    assert np.abs(off).max() < 1e-12
    assert errors_m(poses, xs).max() < 0.02


def test_poses_that_agree_are_left_alone() -> None:
    xs = [STEP_M * i for i in range(4)]
    assert errors_m(run(BackEnd(CONFIG), xs, np.zeros(6)), xs).max() < 0.002


def test_more_keyframes_than_allowed_leave_and_move_with_those_that_stay() -> None:
    config = with_values(CONFIG, {'keyframes': 20})
    xs = [0.02 * i for i in range(26)]
    poses = run(BackEnd(config), xs, 0.2 * DRIFT)
    assert len(poses) == 26
    assert errors_m(poses, xs).max() < 0.02


def detector(images: dict[int, np.ndarray]) -> LoopDetector:
    loop = LoopDetector(CONFIG.loop)
    for index, image in images.items():
        loop.add(keyframe(index, 0.0, image))
    return loop


def test_a_place_is_recognised_from_beside() -> None:
    loop = detector({0: texture(0), 1: texture(1)})
    loop.add(keyframe(2, 0.2, texture(1)))
    found = loop.find(2 * SECOND, [0, SECOND])
    assert found is not None
    assert found.stamp_ns == SECOND
    np.testing.assert_allclose(found.T_earlier_new, at(0.2), atol=0.02)


def test_the_same_poster_in_another_room_is_no_place() -> None:
    one, other = texture(0), texture(1)
    other[200:260, 380:440] = one[200:260, 380:440]
    loop = detector({0: one, 1: other})
    assert loop.find(SECOND, [0]) is None


def test_two_keyframes_agree_on_a_loop_or_do_not() -> None:
    poses = {i: at(x) for i, x in enumerate([0.0, 0.1, 5.0, 5.1])}
    one, same = Recognised(2, 0, at(0.0), 30), Recognised(3, 1, at(0.02), 30)
    assert agree(one, same, poses)
    assert not agree(one, Recognised(3, 0, at(0.6), 30), poses)
    assert not agree(one, Recognised(3, 99, at(0.0), 30), poses)


def test_the_shutter_outlives_a_reset_and_comes_with_a_map() -> None:
    back_end = BackEnd(CONFIG)
    assert back_end.readout_s == 0.0
    back_end.start_from(0.025)
    assert back_end.readout_s == pytest.approx(0.025, abs=0.001)
    run(back_end, [STEP_M * i for i in range(4)], np.zeros(6))
    back_end.reset()
    assert back_end.readout_s == pytest.approx(0.025, abs=0.003)
    fresh = BackEnd(CONFIG)
    fresh.start_from(None)
    assert fresh.readout_s == 0.0


def loop_error_m(enabled: bool) -> tuple[float, int]:
    """Go away, lose all contact, and come back with half a metre of drift."""
    config = with_values(CONFIG, {'loop.enabled': enabled, 'bundle.window': 2})
    back_end = BackEnd(config)
    image = texture()
    poses: dict[int, np.ndarray] = {}
    xs = [0.0, 0.1, 0.2, *([9.0 + 0.1 * i for i in range(7)]), 0.2, 0.1, 0.0]
    elsewhere = texture(7)
    drift = at(0.5)
    for i, x in enumerate(xs):
        away, back = x > 5, i > 9
        T = (drift if back else np.eye(4)) @ at(x)
        picture = keyframe(i, x - 9.0 if away else x, elsewhere if away else image, T)
        moved = back_end.process(picture, poses)
        poses[i * SECOND] = T
        poses = {s: moved.get(s, np.eye(4)) @ pose for s, pose in poses.items()}
        if moved:
            drift = moved[i * SECOND] @ drift if back else drift
    return float(np.linalg.norm(poses[12 * SECOND][:3, 3])), back_end.loops


@pytest.mark.parametrize('enabled', [True, False])
def test_a_loop_brings_the_camera_back(enabled: bool) -> None:
    error_m, loops = loop_error_m(enabled)
    assert (loops > 0) == enabled
    assert (error_m < 0.1) == enabled


def test_in_haste_a_keyframe_is_joined_with_few_and_places_are_looked_for_at_every_third() -> None:
    hurried = True
    back_end = BackEnd(CONFIG, lambda: hurried)
    poses: dict[int, np.ndarray] = {}

    def take(index: int, x_m: float) -> None:
        new = keyframe(index, x_m, texture())
        transforms = back_end.process(new, poses)
        poses[index * SECOND] = new.T_world_camera
        for stamp_ns, T in transforms.items():
            poses[stamp_ns] = T @ poses[stamp_ns]

    for i in range(5):
        take(i, i * STEP_M / 2)
    assert [i for i in range(5) if back_end._loop.knows(i * SECOND)] == [0, 1, 2]
    take(5, 5 * STEP_M / 2)
    joined = [[new - old for new, old in back_end._pairs if new == i * SECOND] for i in range(6)]
    assert all(
        SECOND in away and (i < 2 or 2 * SECOND in away) for i, away in enumerate(joined) if i
    )
    assert [len(away) for away in joined] == [0, 1, 2, 3, 3, 3]
    assert all(back_end._loop.knows(i * SECOND) for i in range(6))
    hurried = False
    take(6, 0.3)
    assert len([new for new, _ in back_end._pairs if new == 6 * SECOND]) == 6
    assert back_end._loop.knows(6 * SECOND)
