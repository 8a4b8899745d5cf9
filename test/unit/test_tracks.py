"""Objects followed from detection to detection."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.detection import TracksConfig
from bdgs_ros.core.types import Detection, Pose
from bdgs_ros.detection.classes import COCO_NAMES
from bdgs_ros.detection.sighting import Sighting, place, shown_as
from bdgs_ros.detection.tracks import ObjectTracks, transition

CAMERA = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
CONFIG = TracksConfig(speed=1.0, speed_s=2.0)  # walkers who do not turn
PERIOD_NS = 33_333_333
HOME = se3.identity()


def seen(
    position: tuple[float, float, float],
    score: float = 0.8,
    T_odom_camera: Pose = HOME,
    name: str = 'person',
) -> Sighting:
    """Return what a camera reports of an object of 0.5 x 1.6 m."""
    shown = shown_as(np.array([*position, 0.5, 1.6, 0, 0, 0]), CAMERA, T_odom_camera)
    assert shown is not None
    class_id = COCO_NAMES.index(name)
    return place(Detection(shown.box, score, class_id, name, 0.9), shown.depth_m, CAMERA)


def walker(k: int, speed: float = 1.0) -> tuple[float, float, float]:
    """Return where someone is who walks to the right, 3 m away."""
    return -1.0 + speed * k * PERIOD_NS * 1e-9, 0.0, 3.0


def follow(tracks: ObjectTracks, frames: range, speed: float = 1.0) -> None:
    for k in frames:
        tracks.update(k * PERIOD_NS, [seen(walker(k, speed))], CAMERA, HOME)


def centre(detection: Detection) -> float:
    return (detection.box_xyxy[0] + detection.box_xyxy[2]) / 2


def test_two_steps_are_one_step() -> None:
    """Prediction does not depend on how often it is asked for."""
    F1, Q1 = transition(0.1, CONFIG)
    F2, Q2 = transition(0.25, CONFIG)
    F3, Q3 = transition(0.35, CONFIG)
    assert np.allclose(F2 @ F1, F3)
    assert np.allclose(F2 @ Q1 @ F2.T + Q2, Q3)


def test_what_is_seen_keeps_its_box() -> None:
    """The filter does not smear a fresh detection."""
    tracks = ObjectTracks(CONFIG)
    follow(tracks, range(6))
    (found,) = tracks.at(5 * PERIOD_NS, CAMERA, HOME)
    assert found.box_xyxy == seen(walker(5)).detection.box_xyxy and found.depth_m is None
    assert found.p_dynamic == pytest.approx(0.95, abs=0.01)


def test_velocity_comes_with_its_covariance() -> None:
    """The truth lies within three sigma, and the sigma is useful."""
    tracks = ObjectTracks(CONFIG)
    follow(tracks, range(60))
    (track,) = tracks.tracks
    error = track.velocity - [1.0, 0.0, 0.0]
    assert np.linalg.norm(error) < 0.1
    sigma = np.sqrt(np.diag(track.velocity_covariance))
    assert (np.abs(error) < 3 * sigma).all() and sigma[0] < 0.6


def test_a_missed_walker_walks_on_and_fades() -> None:
    """Held where it should be, by the second and not by the frame."""
    tracks = ObjectTracks(CONFIG)
    follow(tracks, range(30))
    p = []
    for k in range(30, 40):
        tracks.update(k * PERIOD_NS, [], CAMERA, HOME)
        (held,) = tracks.at(k * PERIOD_NS, CAMERA, HOME)
        truth = CAMERA.project(np.array([walker(k)]))[0, 0]
        assert centre(held) == pytest.approx(truth, abs=8.0)
        assert held.depth_m is not None and held.depth_m[0] < 3.0 < held.depth_m[1]
        p.append(held.p_dynamic)
    assert p[0] > 0.9 and p == sorted(p, reverse=True)
    for k in range(40, 70):
        tracks.update(k * PERIOD_NS, [], CAMERA, HOME)
    assert not tracks.tracks


def test_fast_and_slow_detectors_fade_alike() -> None:
    """The same time without the object, at half the rate."""

    def p_after(step: int) -> float:
        tracks = ObjectTracks(CONFIG)
        follow(tracks, range(30))
        for k in range(29 + step, 36, step):
            tracks.update(k * PERIOD_NS, [], CAMERA, HOME)
        return tracks.tracks[0].p_exists

    assert p_after(1) == pytest.approx(p_after(2), abs=1e-9)


def test_a_single_false_box_is_no_object() -> None:
    """Out of nowhere it stays below one half and is gone with the next frame; seen again, not."""
    tracks = ObjectTracks(CONFIG)
    tracks.update(0, [], CAMERA, HOME)
    tracks.update(PERIOD_NS, [seen((0.0, 0.0, 3.0))], CAMERA, HOME)
    assert tracks.at(PERIOD_NS, CAMERA, HOME)[0].p_dynamic < 0.5
    again = ObjectTracks(CONFIG)
    again.tracks, again._stamp_ns = tracks.tracks, tracks._stamp_ns
    tracks.update(2 * PERIOD_NS, [], CAMERA, HOME)
    assert all(d.p_dynamic < 0.5 for d in tracks.at(2 * PERIOD_NS, CAMERA, HOME))
    again.update(2 * PERIOD_NS, [seen((0.0, 0.0, 3.0))], CAMERA, HOME)
    assert again.at(2 * PERIOD_NS, CAMERA, HOME)[0].p_dynamic > 0.5


def test_who_is_there_at_the_start_is_believed() -> None:
    """The first keyframe must not take a person into the map."""
    tracks = ObjectTracks(CONFIG)
    tracks.update(0, [seen((0.0, 0.0, 3.0), score=0.5)], CAMERA, HOME)
    assert tracks.at(0, CAMERA, HOME)[0].p_dynamic > 0.5


def test_who_comes_in_at_the_border_is_believed() -> None:
    """More than who appears in the middle."""
    tracks = ObjectTracks(CONFIG)
    tracks.update(0, [], CAMERA, HOME)
    entering = seen((-1.7, 0.0, 3.0))
    assert entering.cut_off == (True, False, False, False)
    tracks.update(PERIOD_NS, [entering], CAMERA, HOME)
    assert tracks.at(PERIOD_NS, CAMERA, HOME)[0].p_dynamic > 0.5


def test_a_late_answer_is_taken_in_at_its_time() -> None:
    """Answers 0.3 s old put the object where it is now."""
    tracks = ObjectTracks(CONFIG)
    follow(tracks, range(30))
    (now,) = tracks.at(38 * PERIOD_NS, CAMERA, HOME)
    truth = CAMERA.project(np.array([walker(38)]))[0, 0]
    assert centre(now) == pytest.approx(truth, abs=8.0)


def test_the_camera_may_turn() -> None:
    """A standing object stays in place in the odometry frame and moves in the image."""
    tracks = ObjectTracks(CONFIG)
    position = (0.0, 0.0, 3.0)
    for k in range(20):
        pose = se3.exp(np.array([0, 0, 0, 0, 0.01 * k, 0]))
        tracks.update(k * PERIOD_NS, [seen(position, T_odom_camera=pose)], CAMERA, pose)
    (track,) = tracks.tracks
    assert np.linalg.norm(track.velocity) < 0.02
    pose = se3.exp(np.array([0, 0, 0, 0, 0.3, 0]))
    (held,) = tracks.at(22 * PERIOD_NS, CAMERA, pose)
    truth = seen(position, T_odom_camera=pose).detection
    assert centre(held) == pytest.approx(centre(truth), abs=2.0)


def test_a_new_odometry_frame_moves_the_objects_along() -> None:
    """The image of them does not change."""
    tracks = ObjectTracks(CONFIG)
    follow(tracks, range(20))
    T_new_old = se3.exp(np.array([1.0, -2.0, 0.5, 0.3, -0.2, 0.9]))
    before = tracks.at(22 * PERIOD_NS, CAMERA, HOME)[0]
    tracks.move(T_new_old)
    after = tracks.at(22 * PERIOD_NS, CAMERA, T_new_old)[0]
    assert np.allclose(before.box_xyxy, after.box_xyxy, atol=1e-6)
    assert before.depth_m == pytest.approx(after.depth_m)


def test_two_walkers_who_cross_stay_two() -> None:
    """Behind each other for a moment, at two depths: nobody is doubled or swapped."""
    tracks = ObjectTracks(CONFIG)
    for k in range(60):
        x = -1.0 + k / 30
        left, right = (x, 0.0, 2.5), (-x, 0.0, 4.0)
        found = [seen(left)] if abs(x) < 0.15 else [seen(right), seen(left)]
        tracks.update(k * PERIOD_NS, found, CAMERA, HOME)
    near, far = sorted(tracks.tracks, key=lambda t: t.state[2])
    assert len(tracks.tracks) == 2
    assert near.velocity[0] == pytest.approx(1.0, abs=0.1)
    assert far.velocity[0] == pytest.approx(-1.0, abs=0.1)
    assert {near.track_id, far.track_id} == {1, 2}


def test_other_classes_are_other_objects() -> None:
    """A dog in the place of a person is not that person."""
    tracks = ObjectTracks(CONFIG)
    follow(tracks, range(5))
    tracks.update(5 * PERIOD_NS, [seen(walker(5), name='dog')], CAMERA, HOME)
    assert {t.detection.class_name for t in tracks.tracks} == {'person', 'dog'}


def test_who_leaves_the_image_is_gone() -> None:
    """The velocity carries the object out."""
    tracks = ObjectTracks(CONFIG)
    for k in range(20):
        tracks.update(k * PERIOD_NS, [seen((1.0 + 0.04 * k, 0.0, 3.0))], CAMERA, HOME)
    for k in range(20, 36):
        tracks.update(k * PERIOD_NS, [], CAMERA, HOME)
    assert not tracks.tracks


def test_objects_without_depth_are_followed() -> None:
    """A person nearer than the sensor sees has holes for depth."""
    tracks = ObjectTracks(CONFIG)
    for k in range(10):
        holes = replace(seen((-0.1 + 0.01 * k, 0.0, 0.5)), has_depth=False)
        tracks.update(k * PERIOD_NS, [holes], CAMERA, HOME)
    tracks.update(10 * PERIOD_NS, [], CAMERA, HOME)
    (held,) = tracks.at(10 * PERIOD_NS, CAMERA, HOME)
    assert held.p_dynamic > 0.5 and held.depth_m is not None and held.depth_m[0] < 0.9
