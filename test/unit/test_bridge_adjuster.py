"""Keyframes are adjusted while the mapper is busy, and tracking hears of it at once."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np
import pytest

from bdgs_ros.bridge.adjuster import Adjuster
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import Keyframe, ModelView, Pose, RgbdFrame, StampedPose

CAMERA = PinholeCamera(8, 6, 8.0, 8.0, 3.5, 2.5)


def at(x: float) -> Pose:
    return se3.exp(np.array([x, 0, 0, 0, 0, 0]))


def a_keyframe(stamp_ns: int, x: float) -> Keyframe:
    color = np.zeros((*CAMERA.shape, 3), np.uint8)
    frame = RgbdFrame(stamp_ns, color, np.ones(CAMERA.shape, np.float32), CAMERA)
    return Keyframe(frame, at(x), np.zeros(CAMERA.shape, np.uint8))


class FakeBackEnd:
    """Moves every keyframe it knows, the new one too, by 1 m each time."""

    readout_s = 0.0

    def process(self, keyframe: Keyframe, poses: Mapping[int, Pose]) -> dict[int, Pose]:
        return {stamp_ns: at(1.0) for stamp_ns in [*poses, keyframe.frame.stamp_ns]}

    def sweep(self, stamp_ns: int) -> Any:
        return np.zeros(6)

    def reset(self) -> None:
        pass


class FakeMapper:
    """Keeps poses; `during` is called amid each keyframe."""

    def __init__(self) -> None:
        self.poses: dict[int, Pose] = {}
        self.readout_s: float | None = None
        self.during: Callable[[], object] = lambda: None

    def keyframe_poses(self) -> dict[int, Pose]:
        return dict(self.poses)

    def announce(self, stamp_ns: int, T_world_camera: Pose) -> None:
        self.poses[stamp_ns] = T_world_camera

    def correct_poses(self, transforms: Mapping[int, Pose]) -> None:
        for stamp_ns, T_new_old in transforms.items():
            self.poses[stamp_ns] = T_new_old @ self.poses[stamp_ns]

    def process(self, keyframe: Keyframe, early: Callable[[ModelView], None] | None) -> ModelView:
        images = keyframe.frame.color, keyframe.frame.depth_m, keyframe.p_dynamic
        view = ModelView(keyframe.frame.stamp_ns, keyframe.T_world_camera, CAMERA, *images)
        if early is not None:
            early(view)
        self.during()
        return view


class Heard:
    """What tracking is told, in order: x of each keyframe, or x of a view."""

    def __init__(self, *, at_once: bool) -> None:
        self.log: list[Any] = []
        self.mapper = FakeMapper()
        back_end: Any = FakeBackEnd()
        mapper: Any = self.mapper
        self.adjuster = Adjuster(
            back_end,
            mapper,
            lambda poses: self.log.append({s: x_of(T) for s, T in poses.items()}),
            lambda view: self.log.append((view.stamp_ns, x_of(view.T_world_camera))),
            at_once=at_once,
        )

    def take(self, stamp_ns: int, x: float) -> None:
        keyframe = a_keyframe(stamp_ns, x)
        adjustment = self.adjuster.adjust(keyframe, [])
        assert adjustment is not None
        self.adjuster.into_map(keyframe, adjustment)


def x_of(T: Pose) -> float:
    return float(round(T[0, 3], 9))


def test_poses_are_told_before_the_map_has_the_keyframe() -> None:
    heard = Heard(at_once=True)
    assert heard.adjuster.adjust(a_keyframe(10, 0.0), []) is not None
    assert heard.log == [{10: 1.0}]
    assert not heard.mapper.poses


def test_a_view_is_shown_where_its_keyframe_is_by_now() -> None:
    heard = Heard(at_once=True)
    heard.mapper.during = lambda: heard.adjuster.adjust(a_keyframe(20, 5.0), [])
    heard.take(10, 0.0)
    assert heard.log == [{10: 1.0}, (10, 1.0), {10: 2.0, 20: 7.0}, (10, 2.0), {10: 2.0, 20: 7.0}]
    assert x_of(heard.mapper.poses[10]) == 1.0  # it learns of the rest with its next keyframe


def test_a_keyframe_that_never_reaches_the_map_is_in_the_graph() -> None:
    heard = Heard(at_once=True)
    heard.adjuster.adjust(a_keyframe(10, 0.0), [])
    heard.take(20, 5.0)
    assert {s: x_of(T) for s, T in heard.mapper.poses.items()} == {10: 2.0, 20: 7.0}


def test_a_keyframe_is_where_the_last_one_is_whether_tracking_has_heard_of_that_or_not() -> None:
    """It was tracked 5 m beside the last one, which is 1 m from where it was, and both move on."""
    late, knowing = Heard(at_once=True), Heard(at_once=True)
    for heard in (late, knowing):
        heard.take(10, 0.0)
    late.take(20, 5.0)
    knowing.adjuster.note_move(15, at(1.0))
    knowing.take(20, 6.0)
    for heard in (late, knowing):
        assert {s: x_of(T) for s, T in heard.mapper.poses.items()} == {10: 2.0, 20: 7.0}
    late.adjuster.note_move(25, at(2.0))  # of both corrections at once
    late.take(30, 9.0)
    assert x_of(late.mapper.poses[30]) == 2.0 + 7.0 + 1.0


def test_frames_before_a_keyframe_are_told_in_its_world() -> None:
    heard = Heard(at_once=True)
    observed: list[tuple[int, float]] = []
    back_end: Any = heard.adjuster._back_end
    back_end.observe = lambda stamp_ns, T: observed.append((stamp_ns, x_of(T)))
    heard.take(10, 0.0)
    heard.adjuster.note_move(16, at(1.0))
    frames = [StampedPose(12, at(0.2)), StampedPose(16, at(1.6))]
    heard.adjuster.adjust(a_keyframe(20, 2.0), frames)
    assert observed == [(12, 1.2), (16, 1.6)]


def test_in_lockstep_nothing_is_told_before_the_view() -> None:
    heard = Heard(at_once=False)
    heard.take(10, 0.0)
    assert heard.log == [(10, 1.0), {10: 1.0}]


@pytest.mark.parametrize('amid', [False, True])
def test_what_was_under_way_is_given_up_after_a_reset(amid: bool) -> None:
    heard = Heard(at_once=True)
    keyframe = a_keyframe(10, 0.0)
    adjustment = heard.adjuster.adjust(keyframe, [])
    assert adjustment is not None
    if amid:
        heard.mapper.during = heard.adjuster.forget
    else:
        heard.adjuster.forget()
    heard.adjuster.into_map(keyframe, adjustment)
    assert heard.log == [{10: 1.0}, (10, 1.0)] if amid else [{10: 1.0}]
    heard.log.clear()
    heard.adjuster.adjust(a_keyframe(30, 2.0), [])
    assert heard.log == [{30: 3.0}]


def test_adjusting_does_not_wait_for_the_mapper() -> None:
    heard = Heard(at_once=True)
    amid, free = threading.Event(), threading.Event()

    def wait() -> None:
        amid.set()
        free.wait(5.0)

    heard.mapper.during = wait
    mapping = threading.Thread(target=heard.take, args=(10, 0.0))
    mapping.start()
    assert amid.wait(5.0)
    assert heard.adjuster.adjust(a_keyframe(20, 5.0), []) is not None
    assert heard.log[-1] == {10: 2.0, 20: 7.0}
    free.set()
    mapping.join()
