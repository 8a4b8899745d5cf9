"""Corrections reach tracking late and the map later still: none is made twice, none grows."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from test_back_end import CONFIG, SECOND, STEP_M, at, keyframe, texture
from test_bridge_adjuster import FakeMapper

from bdgs_ros.back_end.back_end import BackEnd
from bdgs_ros.bridge.adjuster import Adjuster
from bdgs_ros.core import se3
from bdgs_ros.core.config import TrackingConfig
from bdgs_ros.core.types import Pose
from bdgs_ros.tracking.camera_tracker import CameraTracker
from bdgs_ros.tracking.starts import Reference

NOISE = np.repeat([0.01, 0.003], 3)  # m and rad, of a step


class LateTracking:
    """Tracks keyframe to keyframe with noise; hears what it is told some keyframes later."""

    def __init__(self, late: int) -> None:
        self._tracker = CameraTracker(TrackingConfig())
        self._late = late
        self._inbox: deque[tuple[int, Callable[[], None]]] = deque()
        self._rng = np.random.default_rng(0)
        self._count = 0

    def hear_poses(self, poses: dict[int, Pose]) -> None:
        self._put(lambda: self._tracker.note_keyframes(poses))

    def hear_view(self, view: Any) -> None:
        self._put(lambda: self._tracker._follow(view))

    def _put(self, told: Callable[[], None]) -> None:
        self._inbox.append((self._count + self._late, told))

    def step(self, motion: Pose) -> tuple[Pose, Pose | None]:
        """Return T_world_camera of the next keyframe, and by what the world moved before it."""
        while self._inbox and self._inbox[0][0] <= self._count:
            self._inbox.popleft()[1]()
        before, T = self._tracker._keyframe, np.eye(4)
        if before is not None:
            T = before.T_world_camera @ motion @ se3.exp(self._rng.normal(0, NOISE))
        pyramid: Any = None
        self._tracker._keyframe = Reference(self._count * SECOND, T, pyramid)
        self._tracker._tracked[self._count * SECOND] = T
        self._count += 1
        return T, self._tracker.take_move()


@pytest.mark.parametrize(('late', 'every'), [(0, 1), (4, 5), (8, 5), (4, 99)])
def test_late_corrections_are_made_once(late: int, every: int) -> None:
    tracking, mapper = LateTracking(late), FakeMapper()
    stand_in: Any = mapper
    back_end = BackEnd(CONFIG)
    adjuster = Adjuster(back_end, stand_in, tracking.hear_poses, tracking.hear_view, at_once=True)
    xs = [STEP_M * (10 - abs(i % 20 - 10)) for i in range(30)]
    for i, x in enumerate(xs):
        T, move = tracking.step(at(x - xs[i - 1] if i else 0.0))
        if move is not None:
            adjuster.note_move(i * SECOND, move)
        picture = keyframe(i, x, texture(), T)
        adjustment = adjuster.adjust(picture, [])
        assert adjustment is not None
        if i % every == 0:
            adjuster.into_map(picture, adjustment)
        poses = adjuster._present()
        off = [np.linalg.norm(poses[n * SECOND][:3, 3] - [xs[n], 0, 0]) for n in range(i + 1)]
        assert max(off) < 0.01  # a single step of odometry, however late
        assert se3.are_rigid(np.array(list(poses.values())))
    assert back_end.refusals == 0
