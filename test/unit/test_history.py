"""Late corrections of keyframes reach the frames between them."""

import json

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import Pose, StampedPose, Trajectory
from bdgs_ros.mapping.history import History
from bdgs_ros.mapping.keyframes import MapKeyframe, build_levels

CAMERA = PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5)


def shifted(x: float) -> Pose:
    return se3.exp(np.array([x, 0, 0, 0, 0, 0]))


def keyframe(index: int, stamp_ns: int, T: Pose, log_gain: float = 0.0) -> MapKeyframe:
    color = np.zeros((*CAMERA.shape, 3), np.uint8)
    depth = np.ones(CAMERA.shape, np.float32)
    levels = build_levels(color, depth, np.zeros(CAMERA.shape, bool), CAMERA, 1)
    made = MapKeyframe(index, stamp_ns, T, np.zeros(CAMERA.shape, np.uint8), levels)
    made.exposure = np.array([log_gain, 0.0], np.float32)
    return made


def online(*stamps_ns: int) -> Trajectory:
    """A camera that moves 1 m per 100 ns along y."""
    along = [se3.exp(np.array([0, s / 100, 0, 0, 0, 0])) for s in stamps_ns]
    return Trajectory(tuple(StampedPose(s, T) for s, T in zip(stamps_ns, along, strict=True)))


def moved(history: History, *stamps_ns: int) -> list[float]:
    """By how much the frames were moved along x."""
    before, after = online(*stamps_ns), history.correct(online(*stamps_ns))
    pairs = zip(before.poses, after.poses, strict=True)
    return [float(b.T_world_camera[0, 3] - a.T_world_camera[0, 3]) for a, b in pairs]


def two(held: float = 0.0) -> tuple[History, list[MapKeyframe]]:
    """Keyframes at 0 and 100 ns; the first had been moved by `held` when its view was given."""
    history = History()
    first = keyframe(0, 0, np.eye(4))
    history.add(0, first.T_world_camera)
    first.T_world_camera = shifted(held)
    history.note_move(1, shifted(held))
    second = keyframe(1, 100, online(100).poses[0].T_world_camera)
    history.add(100, second.T_world_camera)
    return history, [first, second]


def test_without_keyframes_nothing_changes() -> None:
    trajectory = online(0, 50)
    assert History().correct(trajectory) is trajectory


def test_the_correction_is_blended_between_keyframes() -> None:
    history, keyframes = two()
    keyframes[1].T_world_camera = shifted(0.2) @ keyframes[1].T_world_camera
    history.refresh(keyframes)
    np.testing.assert_allclose(
        moved(history, 0, 25, 50, 100, 140), [0, 0.05, 0.1, 0.2, 0.2], atol=1e-9
    )


def test_what_tracking_already_knew_is_not_added_twice() -> None:
    """The frames after a keyframe were tracked against the view from where it had been moved."""
    history, keyframes = two(held=0.3)
    history.refresh(keyframes)
    at_keyframe, later = moved(history, 0, 50)
    assert at_keyframe == pytest.approx(0.3)
    assert later == pytest.approx(0.0, abs=1e-9)


def test_frames_before_a_late_answer_are_corrected_by_all_of_it() -> None:
    """Tracking learnt at 60 ns that the keyframe at 0 is 0.3 further; mapping knows it now."""
    history, keyframes = two()
    keyframes[0].T_world_camera = shifted(0.3)
    history.note_move(60, shifted(0.3))
    history.refresh(keyframes)
    assert moved(history, 0, 59, 60, 99) == pytest.approx([0.3, 0.3, 0, 0], abs=1e-9)


def test_frames_before_the_first_keyframe_move_with_it() -> None:
    history, keyframes = two()
    keyframes[0].T_world_camera = shifted(0.1)
    history.refresh(keyframes)
    assert moved(history, -50)[0] == pytest.approx(0.1)


def test_corrections_of_forgotten_keyframes_stay() -> None:
    history, keyframes = two()
    keyframes[1].T_world_camera = shifted(0.2) @ keyframes[1].T_world_camera
    history.refresh([keyframes[1]])
    history.refresh([keyframes[0]])
    assert moved(history, 100)[0] == pytest.approx(0.2)


def test_exposure_is_blended_in_time() -> None:
    history, keyframes = two()
    keyframes[0].exposure = np.array([0.2, 0.0], np.float32)
    keyframes[1].exposure = np.array([0.4, 0.1], np.float32)
    history.refresh(keyframes)
    np.testing.assert_allclose(history.exposure(50), [0.3, 0.05], atol=1e-6)
    np.testing.assert_allclose(history.exposure(-10), [0.2, 0.0], atol=1e-6)
    np.testing.assert_allclose(history.exposure(900), [0.4, 0.1], atol=1e-6)
    np.testing.assert_array_equal(History().exposure(5), [0, 0])


def test_a_document_gives_the_same_history_back() -> None:
    history, keyframes = two(held=0.3)
    keyframes[1].T_world_camera = shifted(0.2) @ keyframes[1].T_world_camera
    keyframes[1].exposure = np.array([0.4, 0.1], np.float32)
    history.refresh(keyframes)
    back = History.from_document(json.loads(json.dumps(history.to_document())))
    assert back.stamps_ns == history.stamps_ns
    assert moved(back, -5, 0, 50, 100) == pytest.approx(moved(history, -5, 0, 50, 100))
    np.testing.assert_allclose(back.exposure(60), history.exposure(60), atol=1e-7)


@pytest.mark.parametrize(
    'document',
    [{}, {'anchors': [{}], 'earlier_ns': []}, {'anchors': [{'online': [1]}], 'earlier_ns': []}],
)
def test_a_damaged_document_is_an_error_that_callers_expect(document: dict[str, object]) -> None:
    with pytest.raises((KeyError, TypeError, ValueError)):
        History.from_document(document)


def test_a_new_run_is_not_corrected_by_the_keyframes_of_an_earlier_one() -> None:
    history, keyframes = two()
    keyframes[1].T_world_camera = shifted(0.2) @ keyframes[1].T_world_camera
    history.refresh(keyframes)
    history.begin_run()
    assert moved(history, 0, 100) == [0, 0]
    assert history.stamps_ns == [0, 100]
    history.refresh(keyframes)
    assert moved(history, 0, 100) == [0, 0]
    history.add(500, np.eye(4))
    assert history.stamps_ns == [0, 100, 500]
