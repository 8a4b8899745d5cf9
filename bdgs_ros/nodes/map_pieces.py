"""Keyframes that tracking makes while it is lost, kept until it says where they are."""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path
from rclpy.node import Node

from bdgs_ros.bridge import conversions, topics
from bdgs_ros.core.types import Keyframe, Pose, StampedPose

_KEPT = 60  # keyframes, 2 MB each: as many as tracking keeps by default


class MapPieces:
    """
    Keeps the images of such keyframes.

    Parameters
    ----------
    node : Node
        It subscribes.
    assemble : callable
        Returns what makes a keyframe of its announcement; called when that comes, since images
        are forgotten, and the result by the thread of `put`.
    put : callable
        Has a task done by the thread that calls `take`, too.
    on_joined : callable
        Called with the poses of all frames of a piece that was placed.

    """

    def __init__(
        self,
        node: Node,
        assemble: Callable[[PoseStamped], Callable[[], Keyframe | None]],
        put: Callable[[Callable[[], None]], None],
        on_joined: Callable[[Sequence[StampedPose]], None],
    ) -> None:
        self._assemble = assemble
        self._put = put
        self._on_joined = on_joined
        self._aside: dict[int, Keyframe] = {}
        self._lock = threading.Lock()
        self._placed: deque[dict[int, Pose]] = deque()
        node.create_subscription(Path, topics.PIECE, self._on_piece, topics.RELIABLE)
        node.create_subscription(
            PoseStamped, topics.PIECE_KEYFRAME, self._on_keyframe, topics.RELIABLE
        )

    def _on_keyframe(self, message: PoseStamped) -> None:
        self._put(partial(self._keep, self._assemble(message)))

    def _keep(self, made: Callable[[], Keyframe | None]) -> None:
        keyframe = made()
        if keyframe is None:
            return
        self._aside[keyframe.frame.stamp_ns] = keyframe
        if len(self._aside) > _KEPT:
            del self._aside[min(self._aside)]

    def _on_piece(self, message: Path) -> None:
        poses = conversions.poses_from_path(message)
        self._on_joined([StampedPose(*item) for item in sorted(poses.items())])
        with self._lock:
            self._placed.append(poses)
        self._put(lambda: None)  # who takes next finds it

    def take(self) -> list[Keyframe]:
        """Return keyframes that have become part of the world since the last call, in order."""
        with self._lock:
            pieces, self._placed = list(self._placed), deque()
        found = [
            replace(self._aside[stamp_ns], T_world_camera=pose)
            for poses in pieces
            for stamp_ns, pose in sorted(poses.items())
            if stamp_ns in self._aside
        ]
        if pieces:
            self._aside = {}
        return found
