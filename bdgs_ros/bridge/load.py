"""Tracking's governor at work: it hears of frames, and tells all nodes what to leave out."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rclpy.node import Node
from std_msgs.msg import UInt8

from bdgs_ros.bridge import topics
from bdgs_ros.bridge.frames import RawFrame
from bdgs_ros.bridge.governor import Governor, Shed
from bdgs_ros.bridge.health import Health


class LoadWatch:
    """
    Feeds a governor with the times of frames, and publishes its level.

    Parameters
    ----------
    node : Node
        It publishes `bdgs/shed`.
    health : Health
        Shows what is left out, and why.
    enabled : bool
        In lockstep nothing is late: no frame is passed over, and nothing is left out.

    """

    def __init__(self, node: Node, health: Health, *, enabled: bool) -> None:
        self._enabled = enabled
        self._governor = Governor()
        self._health = health
        self._publisher = node.create_publisher(UInt8, topics.SHED, topics.LATCHED)

    @property
    def level(self) -> Shed:
        """What is left out now."""
        return self._governor.level

    @property
    def points_share(self) -> float:
        """Share of its points that tracking is to compare."""
        return self._governor.points_share

    @contextmanager
    def one_frame(self) -> Iterator[None]:
        """Measure what the calling thread does for a frame."""
        started_s = time.thread_time()
        yield
        if self._enabled:
            self._governor.note_cost(time.thread_time() - started_s)
            share = self._governor.points_share
            self._health.counts['points_left_out_percent'] = round(100 * (1 - share))

    def note_arrival(self, raw: RawFrame) -> None:
        """Note that a frame has come."""
        self._governor.note_arrival(raw.received_s)

    def is_late(self, raw: RawFrame) -> bool:
        """Return whether a newer frame is worth more than this one."""
        return self._enabled and self._governor.is_late(raw.received_s, time.monotonic())

    def note_passed_over(self) -> None:
        """Note that a frame was passed over."""
        self._governor.note_passed_over()

    def note_pose(self, raw: RawFrame) -> None:
        """Note that a frame is done; say so if more or less is to be left out now."""
        if not (self._enabled and self._governor.note_pose(raw.received_s, time.monotonic())):
            return
        level = self._governor.level
        self._publisher.publish(UInt8(data=level))
        self._health.counts['shed_level'] = int(level)
        self._health.counts['shed_most'] = max(self._health.counts['shed_most'], int(level))
        why = f'left out: {level.words}, since {self._governor.reason}' if level else ''
        self._health.mark('shed', why)


def hear_load(node: Node, on_level: Callable[[Shed], None]) -> None:
    """Have a callback called with what is to be left out, whenever that changes."""
    node.create_subscription(
        UInt8,
        topics.SHED,
        lambda message: on_level(Shed(min(message.data, max(Shed)))),
        topics.LATCHED,
    )
