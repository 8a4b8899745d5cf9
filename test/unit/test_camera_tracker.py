"""The tracker in a rendered room with exact truth: poses, keyframes, loss and recovery."""

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.types import (
    Keyframe,
    Labels,
    ModelView,
    RgbdFrame,
    TrackingResult,
    TrackingStatus,
)
from bdgs_ros.data.synth.render import FrameRenderer
from bdgs_ros.data.synth.scenarios import make_world
from bdgs_ros.tracking.camera_tracker import CameraTracker

CAMERA = PinholeCamera(320, 240, 267.7, 269.6, 159.8, 123.6)
CONFIG = BdgsConfig().tracking
PERIOD_S = 1 / 30
FRAMES = 16


@pytest.fixture(scope='module')
def recording() -> tuple[list[RgbdFrame], list[np.ndarray]]:
    """A camera that moves through a static room, from the middle of the scenario."""
    world = make_world('static', 3, 4.0)
    renderer = FrameRenderer(world, CAMERA, 0.01)
    frames, poses = [], []
    for i in range(FRAMES):
        time_s = 1.5 + i * PERIOD_S
        images = renderer.render(time_s)
        color = np.ascontiguousarray(images.color).astype(np.uint8)
        depth = images.static_depth_m.astype(np.float32)
        frames.append(RgbdFrame(round(time_s * 1e9), color, depth, CAMERA))
        poses.append(world.camera_path.pose(time_s))
    return frames, poses


def error_m(result: TrackingResult, poses: list[np.ndarray], i: int) -> float:
    truth = se3.inverse(poses[0]) @ poses[i]
    return float(np.linalg.norm(se3.log(se3.inverse(truth) @ result.T_world_camera)[:3]))


def test_poses_are_right_to_millimetres(recording: tuple) -> None:
    frames, poses = recording
    tracker = CameraTracker(CONFIG)
    results = [tracker.process(frame) for frame in frames]
    assert all(r.status is TrackingStatus.OK for r in results)
    assert results[0].is_keyframe
    travelled = np.linalg.norm(poses[-1][:3, 3] - poses[0][:3, 3])
    assert travelled > 0.02
    assert max(error_m(r, poses, i) for i, r in enumerate(results)) < 0.005


def test_the_model_corrects_a_keyframe_that_is_off(recording: tuple) -> None:
    """The view of the map outweighs the drift of the last keyframe."""
    frames, _ = recording
    tracker = CameraTracker(CONFIG)
    first = tracker.process(frames[0])
    shift = se3.exp(np.array([0.01, 0, 0, 0, 0, 0]))
    view = ModelView(
        frames[0].stamp_ns,
        first.T_world_camera @ shift,
        CAMERA,
        frames[0].color,
        frames[0].depth_m,
        np.zeros(CAMERA.shape, np.uint8),
    )
    tracker.set_model(view)
    again = tracker.process(replace(frames[0], stamp_ns=frames[1].stamp_ns))
    offset = se3.log(se3.inverse(view.T_world_camera) @ again.T_world_camera)
    assert np.linalg.norm(offset[:3]) < 0.004


def test_a_covered_lens_is_lost_and_found_again(recording: tuple) -> None:
    frames, poses = recording
    tracker = CameraTracker(CONFIG)
    for frame in frames[:5]:
        tracker.process(frame)
    dark = np.zeros_like(frames[0].color)
    no_depth = np.zeros_like(frames[0].depth_m)
    lost = [tracker.process(replace(f, color=dark, depth_m=no_depth)) for f in frames[5:8]]
    assert all(r.status is TrackingStatus.LOST and not r.is_keyframe for r in lost)
    found = tracker.process(frames[8])
    assert found.status is TrackingStatus.OK
    assert error_m(found, poses, 8) < 0.01


def blind(frame: RgbdFrame) -> RgbdFrame:
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


def test_where_depth_alone_is_lost_colour_tells_the_pose(recording: tuple) -> None:
    """Keyframes are due all the time, but none can be made: nothing could be aligned to it."""
    frames, poses = recording
    config = replace(CONFIG, keyframe=replace(CONFIG.keyframe, max_interval=1))
    tracker = CameraTracker(config)
    for frame in frames[:5]:
        assert tracker.process(frame).is_keyframe
    results = [tracker.process(blind(frame)) for frame in frames[5:12]]
    assert all(r.status is TrackingStatus.OK and not r.is_keyframe for r in results)
    assert max(error_m(r, poses, i) for i, r in enumerate(results, 5)) < 0.01
    assert tracker.process(frames[12]).is_keyframe


@pytest.mark.parametrize('color', [None, 0, 12])
def test_a_world_begins_with_the_first_frame_that_has_depth(
    recording: tuple, color: int | None
) -> None:
    frames, _ = recording
    tracker = CameraTracker(CONFIG)
    covered = [blind(frame) for frame in frames[:3]]
    if color is not None:
        covered = [replace(f, color=np.full_like(f.color, color)) for f in covered]
    for frame in covered:
        result = tracker.process(frame)
        assert result.status is TrackingStatus.LOST and not result.is_keyframe
    first = tracker.process(frames[3])
    assert first.status is TrackingStatus.OK and first.is_keyframe
    np.testing.assert_array_equal(first.T_world_camera, np.eye(4))


def test_a_lost_camera_is_not_found_without_depth(recording: tuple) -> None:
    """What it would be recognised by is less than usual, and mapping could show nothing."""
    frames, _ = recording
    tracker = CameraTracker(CONFIG)
    for frame in frames[:5]:
        tracker.process(frame)
    dark = np.zeros_like(frames[0].color)
    tracker.process(replace(blind(frames[5]), color=dark))
    waiting = [tracker.process(blind(frame)) for frame in frames[6:9]]
    assert all(r.status is TrackingStatus.LOST for r in waiting)
    assert tracker.process(frames[9]).status is TrackingStatus.OK


def test_a_frame_that_is_all_people_is_lost(recording: tuple) -> None:
    frames, _ = recording
    tracker = CameraTracker(CONFIG)
    tracker.process(frames[0])
    everywhere = Labels(frames[1].stamp_ns, np.full(CAMERA.shape, 255, np.uint8))
    assert tracker.process(frames[1], everywhere).status is TrackingStatus.LOST


def test_keyframes_come_at_least_every_interval(recording: tuple) -> None:
    frames, _ = recording
    config = replace(CONFIG, keyframe=replace(CONFIG.keyframe, max_interval=4))
    tracker = CameraTracker(config)
    flags = [tracker.process(frame).is_keyframe for frame in frames]
    gaps = np.diff(np.flatnonzero(flags))
    assert flags[0]
    assert gaps.max() <= 4


def test_a_mover_in_front_of_the_model_is_marked_without_a_detector(recording: tuple) -> None:
    frames, _ = recording
    tracker = CameraTracker(CONFIG)
    first = tracker.process(frames[0])
    nothing = np.zeros(CAMERA.shape, np.uint8)
    view = ModelView(
        frames[0].stamp_ns,
        first.T_world_camera,
        CAMERA,
        frames[0].color,
        frames[0].depth_m,
        nothing,
    )
    tracker.set_model(view)
    where = np.zeros(CAMERA.shape, bool)
    where[60:180, 120:200] = True
    color = np.where(where[..., None], np.uint8(40), frames[1].color)
    depth = np.where(where, np.float32(0.8), frames[1].depth_m)
    result = tracker.process(replace(frames[1], color=color, depth_m=depth))
    marked = result.p_dynamic >= 128
    assert (marked & where).sum() > 0.8 * where.sum()
    assert (marked & ~where).sum() < 0.1 * where.sum()


def test_reset_starts_a_new_world(recording: tuple) -> None:
    frames, _ = recording
    tracker = CameraTracker(CONFIG)
    for frame in frames[:4]:
        tracker.process(frame)
    tracker.reset()
    again = tracker.process(frames[2])
    np.testing.assert_array_equal(again.T_world_camera, np.eye(4))
    assert again.is_keyframe


def test_an_old_model_view_does_not_make_every_frame_a_keyframe(recording: tuple) -> None:
    """Mapping is behind in real time: keyframes are counted against the last one."""
    frames, _ = recording
    tracker = CameraTracker(CONFIG)
    first = tracker.process(frames[0])
    narrow = frames[0].depth_m.copy()
    narrow[:, 40:] = 0  # the old view shows little of what is seen now
    view = ModelView(
        frames[0].stamp_ns,
        first.T_world_camera @ se3.exp(np.array([0, 0, 0, 0, 0.3, 0])),
        CAMERA,
        frames[0].color,
        narrow,
        np.zeros(CAMERA.shape, np.uint8),
    )
    tracker.set_model(view)
    assert not any(tracker.process(frame).is_keyframe for frame in frames[1:6])


@pytest.fixture(scope='module')
def two_places() -> tuple[list[RgbdFrame], list[np.ndarray]]:
    """Six frames, a second later six more, elsewhere: stamps go on at camera rate."""
    world = make_world('walking_halfsphere', 3, 9.0)
    renderer = FrameRenderer(world, CAMERA, 0.01)
    frames, poses = [], []
    for i in range(12):
        time_s = 1.0 + i * PERIOD_S + (2.5 if i >= 6 else 0.0)
        images = renderer.render(time_s)
        color = np.ascontiguousarray(images.static_color).astype(np.uint8)
        depth = images.static_depth_m.astype(np.float32)
        stamp_ns = round((1.0 + i * PERIOD_S) * 1e9)
        frames.append(RgbdFrame(stamp_ns, color, depth, CAMERA))
        poses.append(world.camera_path.pose(time_s))
    return frames, poses


def at(frame: RgbdFrame, i: int) -> RgbdFrame:
    return replace(frame, stamp_ns=round((1.0 + i * PERIOD_S) * 1e9))


def test_after_a_jump_back_the_camera_is_found_at_once_or_nearly(two_places: tuple) -> None:
    frames, poses = two_places
    tracker = CameraTracker(CONFIG)
    apart = np.linalg.norm((se3.inverse(poses[0]) @ poses[11])[:3, 3])
    assert apart > 0.2
    start_elsewhere(tracker, frames, poses)
    results = [tracker.process(at(frames[i], 30 + i)) for i in range(6)]
    wrong = [
        i
        for i, r in enumerate(results)
        if r.status is TrackingStatus.OK and error_m(r, poses, i) > 0.05
    ]
    assert not wrong
    assert all(r.status is TrackingStatus.OK for r in results[2:])


def test_a_lost_camera_seldom_looks_at_places_while_frames_wait(
    recording: tuple, monkeypatch: pytest.MonkeyPatch
) -> None:
    frames, _ = recording
    tracker = CameraTracker(replace(CONFIG, places=replace(CONFIG.places, patience=2)))
    tracker.process(frames[0])
    searches: list[int] = []

    def find(frame: RgbdFrame, p_dynamic: np.ndarray) -> list:
        searches.append(frame.stamp_ns)
        return []

    monkeypatch.setattr(tracker._places, 'find', find)
    dark = [replace(f, color=np.zeros_like(f.color)) for f in frames[1:10]]
    results = [tracker.process(frame, hurried=True) for frame in dark[:6]]
    assert all(r.status is TrackingStatus.LOST for r in results)
    assert searches == [dark[2].stamp_ns, dark[5].stamp_ns]
    tracker.process(dark[6])
    assert searches[-1] == dark[6].stamp_ns


def start_elsewhere(
    tracker: CameraTracker, frames: list[RgbdFrame], poses: list[np.ndarray]
) -> TrackingResult:
    """Track the first place, then put the camera at the second as a known one."""
    first = tracker.process(frames[0])
    view = ModelView(
        frames[11].stamp_ns,
        se3.inverse(poses[0]) @ poses[11],
        CAMERA,
        frames[11].color,
        frames[11].depth_m,
        np.zeros(CAMERA.shape, np.uint8),
    )
    known = Keyframe(frames[0], first.T_world_camera, np.zeros(CAMERA.shape, np.uint8))
    tracker.start_from(view, [known])
    return tracker.process(at(frames[11], 20))


def test_a_known_map_is_entered_anywhere(two_places: tuple) -> None:
    """The view is of one place, the camera at another, of which the map has a keyframe."""
    frames, poses = two_places
    tracker = CameraTracker(CONFIG)
    view = ModelView(
        0,
        se3.inverse(poses[0]) @ poses[11],
        CAMERA,
        frames[11].color,
        frames[11].depth_m,
        np.zeros(CAMERA.shape, np.uint8),
    )
    known = Keyframe(frames[0], np.eye(4), np.zeros(CAMERA.shape, np.uint8))
    tracker.start_from(view, [known])
    results = [tracker.process(frames[i]) for i in (1, 2, 3)]
    found = [i for i, r in enumerate(results, 1) if r.status is TrackingStatus.OK]
    assert found and found[0] <= 2
    assert all(error_m(results[i - 1], poses, i) < 0.02 for i in found)
    assert results[found[0] - 1].is_keyframe


def test_a_correction_moves_everything_that_is_known(recording: tuple) -> None:
    frames, _ = recording
    corrected, plain = CameraTracker(CONFIG), CameraTracker(CONFIG)
    for frame in frames[:4]:
        corrected.process(frame)
        plain.process(frame)
    new = se3.exp(np.array([0.5, -0.2, 0.1, 0.1, 0.2, -0.1]))  # the first was at the origin
    still = np.zeros(CAMERA.shape, np.uint8)
    view = ModelView(frames[0].stamp_ns, new, CAMERA, frames[0].color, frames[0].depth_m, still)
    same = replace(view, T_world_camera=np.eye(4))
    corrected.set_model(view)
    plain.set_model(same)
    one, other = corrected.process(frames[4]), plain.process(frames[4])
    expected = new @ other.T_world_camera
    np.testing.assert_allclose(one.T_world_camera, expected, atol=1e-6)


def test_keyframes_move_before_their_view_comes_and_not_twice(recording: tuple) -> None:
    """The path says where a keyframe is; its view, later, says the same."""
    frames, _ = recording
    told, plain = CameraTracker(CONFIG), CameraTracker(CONFIG)
    for frame in frames[:4]:
        told.process(frame)
        plain.process(frame)
    new = se3.exp(np.array([0.5, -0.2, 0.1, 0.1, 0.2, -0.1]))  # the first was at the origin
    still = np.zeros(CAMERA.shape, np.uint8)
    image = frames[0].color, frames[0].depth_m, still
    told.note_keyframes({frames[0].stamp_ns: new, frames[9].stamp_ns: se3.exp(np.ones(6))})
    np.testing.assert_allclose(told.take_move(), new, atol=1e-9)
    told.set_model(ModelView(frames[0].stamp_ns, new, CAMERA, *image))
    told.note_keyframes({frames[0].stamp_ns: new})
    plain.set_model(ModelView(frames[0].stamp_ns, np.eye(4), CAMERA, *image))
    one, other = told.process(frames[4]), plain.process(frames[4])
    np.testing.assert_allclose(one.T_world_camera, new @ other.T_world_camera, atol=1e-6)
    move = told.take_move()
    assert move is None or np.allclose(move, np.eye(4), atol=1e-9)


@pytest.mark.parametrize('by', [np.nan, 1e7, 1.0])
def test_what_mapping_cannot_mean_is_not_followed(recording: tuple, by: float) -> None:
    frames, _ = recording
    told, plain = CameraTracker(CONFIG), CameraTracker(CONFIG)
    for frame in frames[:4]:
        told.process(frame)
        plain.process(frame)
    new = np.eye(4)
    if by == 1.0:
        new[0, 0] = -1.0  # a mirror
    new[0, 3] = by
    still = np.zeros(CAMERA.shape, np.uint8)
    view = ModelView(frames[0].stamp_ns, new, CAMERA, frames[0].color, frames[0].depth_m, still)
    told.note_keyframes({frames[0].stamp_ns: new})
    told.set_model(view)
    assert told.refused == 2
    assert told.take_move() is None
    one, other = told.process(frames[4]), plain.process(frames[4])
    np.testing.assert_array_equal(one.T_world_camera, other.T_world_camera)


def test_places_go_where_mapping_has_their_keyframes(recording: tuple) -> None:
    """A loop is closed: what the camera will be recognised at has moved."""
    frames, _ = recording
    tracker = CameraTracker(CONFIG)
    tracker.start_from(
        ModelView(
            0,
            np.eye(4),
            CAMERA,
            frames[0].color,
            frames[0].depth_m,
            np.zeros(CAMERA.shape, np.uint8),
        ),
        [Keyframe(frames[n], np.eye(4), np.zeros(CAMERA.shape, np.uint8)) for n in (0, 5)],
    )
    new = se3.exp(np.array([0.5, -0.2, 0.1, 0.1, 0.2, -0.1]))
    tracker.note_keyframes({frames[5].stamp_ns: new})
    first, second = (place.T_world_camera for place in tracker._places)
    assert np.array_equal(first, np.eye(4))
    assert np.array_equal(second, new)


def test_while_lost_no_pose_is_made_up(recording: tuple) -> None:
    """The prediction stays where the camera was last seen, and grows uncertain."""
    frames, _ = recording
    tracker = CameraTracker(CONFIG)
    for frame in frames[:6]:
        last = tracker.process(frame)
    blank = np.full_like(frames[0].color, 128), np.zeros_like(frames[0].depth_m)
    lost = [
        tracker.process(replace(at(frames[0], 60 + i), color=blank[0], depth_m=blank[1]))
        for i in range(3)
    ]
    assert all(r.status is TrackingStatus.LOST for r in lost)
    moved = se3.inverse(last.T_world_camera) @ lost[-1].T_world_camera
    assert np.linalg.norm(moved[:3, 3]) < 0.1
    assert np.sqrt(lost[-1].covariance[0, 0]) > 0.5
