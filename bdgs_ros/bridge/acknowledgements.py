"""Which of the images that were sent came back as a status; ROS-free."""

from __future__ import annotations

import threading
import time
from collections import Counter


class Acknowledgements:
    """
    Match what was sent with what was acknowledged, across threads.

    Parameters
    ----------
    passed_over : str
        The state of a frame that was left out: answered, and missed all the same.

    """

    def __init__(self, passed_over: str = '') -> None:
        self._passed_over = passed_over
        self.states: Counter[str] = Counter()
        self.sent = 0
        self.round_trips_ms: list[float] = []
        self._open: dict[int, float] = {}
        self._early: dict[int, tuple[str, float]] = {}
        self._changed = threading.Condition()

    @property
    def any(self) -> bool:
        """Whether anything was ever acknowledged."""
        return bool(self.states)

    @property
    def unanswered(self) -> int:
        """How many were sent and nothing was heard of."""
        return self.sent - sum(self.states.values())

    @property
    def missed(self) -> int:
        """How many were sent and got no answer, or the one that they were left out."""
        return self.unanswered + self.states[self._passed_over]

    def expect(self, stamp_ns: int, sent_s: float) -> None:
        """Note that a frame left at a time of `time.perf_counter`; it may be back already."""
        with self._changed:
            self.sent += 1
            early = self._early.pop(stamp_ns, None)
            self._early = {s: e for s, e in self._early.items() if s > stamp_ns}
            if early is None:
                self._open[stamp_ns] = sent_s
            else:
                self._count(early[0], early[1] - sent_s)

    def arrived(self, stamp_ns: int, state: str) -> None:
        """Note a status; a second one for the same frame is not counted."""
        now = time.perf_counter()
        with self._changed:
            sent_s = self._open.pop(stamp_ns, None)
            if sent_s is None:
                self._early[stamp_ns] = (state, now)
            else:
                self._count(state, now - sent_s)
            self._changed.notify_all()

    def _count(self, state: str, seconds: float) -> None:
        self.states[state] += 1
        if state != self._passed_over:
            self.round_trips_ms.append(seconds * 1e3)

    def wait(self, stamp_ns: int, timeout_s: float) -> bool:
        """Return whether a frame was acknowledged within a time."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while stamp_ns in self._open:
                left = deadline - time.monotonic()
                if left <= 0:
                    return False
                self._changed.wait(left)
        return True

    def wait_quiet(self, quiet_s: float) -> None:
        """Return when nothing is open, or nothing has come for a while."""
        with self._changed:
            while self._open:
                before = len(self._open)
                self._changed.wait(quiet_s)
                if len(self._open) == before:
                    return
