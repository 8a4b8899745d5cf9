"""What a node tells about itself: counts, timings, problems; on /diagnostics once a second."""

from __future__ import annotations

import time
from collections import Counter, deque
from collections.abc import Iterator
from contextlib import contextmanager

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.node import Node

from bdgs_ros.bridge import topics

_PERIOD_S = 1.0
_REPEAT_S = 30.0
_KEPT_TIMINGS = 20000


class Health:
    """
    Counts, timings and problems of one node.

    Parameters
    ----------
    node : Node
        It logs and publishes.
    name : str
        Of the status, for example 'tracking'.

    """

    def __init__(self, node: Node, name: str) -> None:
        self.counts: Counter[str] = Counter()
        self._begun_s = time.process_time()  # what starting took is another matter
        self._node = node
        self._name = name
        self._timings_ms: dict[str, deque[float]] = {}
        self._problems: dict[str, str] = {}
        self._failures: set[str] = set()  # of the problems
        self._logged_s: dict[str, float] = {}
        self._publisher = node.create_publisher(
            DiagnosticArray, topics.DIAGNOSTICS, topics.RELIABLE
        )
        self._timer = node.create_timer(
            _PERIOD_S, self.publish, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    @contextmanager
    def timed(self, name: str) -> Iterator[None]:
        """Measure a block."""
        started = time.perf_counter()
        yield
        self.add_timing(name, (time.perf_counter() - started) * 1e3)

    def add_timing(self, name: str, milliseconds: float) -> None:
        """Add one measurement."""
        self._timings_ms.setdefault(name, deque(maxlen=_KEPT_TIMINGS)).append(milliseconds)

    def set_problem(self, key: str, text: str) -> None:
        """Say and log that something is wrong, or with an empty text that it is right again."""
        self.mark(key, text)
        if text:
            self.warn(text)

    def set_failure(self, key: str, text: str) -> None:
        """Like `set_problem`, for what the node cannot do its work with: an ERROR, no WARN."""
        self.set_problem(key, text)
        (self._failures.add if text else self._failures.discard)(key)

    def mark(self, key: str, text: str) -> None:
        """Like `set_problem`, without the log."""
        if text:
            self._problems[key] = text
        else:
            self._problems.pop(key, None)

    def error(self, error: Exception) -> None:
        """Note an error that nobody expected; the node goes on."""
        if not self._node.context.ok():  # it is going down: publishing fails, and that is fine
            return
        self.counts['errors'] += 1
        self.set_problem('error', f'{type(error).__name__}: {error}')

    def warn(self, text: str) -> None:
        """Log a warning; the same text at most twice a minute."""
        now = time.monotonic()
        if now - self._logged_s.get(text, -_REPEAT_S) >= _REPEAT_S:
            self._logged_s[text] = now
            self._node.get_logger().warning(text)

    def publish(self) -> None:
        """Send the status now."""
        level = DiagnosticStatus.WARN if self._problems else DiagnosticStatus.OK
        status = DiagnosticStatus(
            level=DiagnosticStatus.ERROR if self._failures else level,
            name=f'bdgs_ros: {self._name}',
            message='; '.join(self._problems.values()) or 'ok',
            hardware_id=self._node.get_fully_qualified_name(),
            values=[KeyValue(key=key, value=value) for key, value in self.values().items()],
        )
        stamp = self._node.get_clock().now().to_msg()
        message = DiagnosticArray(status=[status])
        message.header.stamp = stamp
        self._publisher.publish(message)

    def values(self) -> dict[str, str]:
        """Return counts and timings, as the status carries them."""
        values = {key: str(count) for key, count in sorted(self.counts.items())}
        values['cpu_s'] = f'{time.process_time() - self._begun_s:.2f}'
        for name, timings in list(self._timings_ms.items()):
            measured = np.array(list(timings))  # one step, while another thread appends
            values[f'{name}_ms_median'] = f'{np.median(measured):.2f}'
            values[f'{name}_ms_p95'] = f'{np.percentile(measured, 95):.2f}'
            values[f'{name}_ms_max'] = f'{measured.max():.2f}'
        return values
