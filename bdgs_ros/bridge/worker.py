"""A thread that works through a queue, so that callbacks never wait; ROS-free."""

from __future__ import annotations

import threading
import time
from collections import deque
from collections.abc import Callable, Sequence
from functools import partial
from typing import Any, Generic, TypeVar

from bdgs_ros.bridge.priority import give_way

Item = TypeVar('Item')


class Worker(Generic[Item]):
    """
    Handle items in order in a thread of its own.

    Parameters
    ----------
    handle : callable
        Called with each item.
    on_error : callable
        Called with what `handle` raised; the thread goes on.
    capacity : int or None
        Items that may wait; the oldest is dropped for a newer one. None: all wait.
    is_late : callable, optional
        Asked of the oldest item that waits, while newer ones do: whether it has waited for too
        long. Then the newest is handled and the others are dropped.
    on_drop : callable, optional
        Called with each item that is dropped, by whichever thread drops it.
    idle : callable, optional
        Called after every item and `idle_period_s` after the last call while nothing is to do.
    idle_period_s : float
        See `idle`.
    nice : int
        How much the thread gives way to others, see `priority.give_way`.
    source : Worker, optional
        One that hands its items over to this one: what is not handed over yet waits here too.

    """

    def __init__(
        self,
        handle: Callable[[Item], None],
        on_error: Callable[[Exception], None],
        capacity: int | None,
        idle: Callable[[], None] = lambda: None,
        idle_period_s: float = 0.1,
        nice: int = 0,
        source: Worker[Any] | None = None,
        is_late: Callable[[Item], bool] = lambda item: False,
        on_drop: Callable[[Item], None] = lambda item: None,
    ) -> None:
        self.dropped = 0
        self._is_late = is_late
        self._on_drop = on_drop
        self._handle = handle
        self._on_error = on_error
        self._capacity = capacity
        self._idle = idle
        self._idle_period_s = idle_period_s
        self._nice = nice
        self._source = source
        self._items: deque[Item] = deque()
        self._first: Callable[[], None] | None = None
        self._changed = threading.Condition()
        self._busy = False
        self._woken = False
        self._stopping = False
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    @property
    def waiting(self) -> int:
        """How many items wait."""
        return len(self._items)

    @property
    def unfinished(self) -> int:
        """How many items wait or are being handled."""
        return len(self._items) + self._busy

    def put(self, item: Item) -> None:
        """Append an item; never waits."""
        with self._changed:
            is_full = self._capacity is not None and len(self._items) >= self._capacity
            dropped = self._take_out(int(is_full))
            self._items.append(item)
            self._changed.notify_all()
        self._hand_back(dropped)

    def wake(self) -> None:
        """Have `idle` called soon, when nothing else is to do."""
        with self._changed:
            self._woken = True
            self._changed.notify_all()

    def restart(self, action: Callable[[], None]) -> None:
        """Forget what waits; call `action` in the thread before anything newer is handled."""
        with self._changed:
            self._items.clear()
            self._first = action
            self._changed.notify_all()

    def wait_idle(self, timeout_s: float) -> bool:
        """Return whether everything was handled within a time."""
        deadline = time.monotonic() + timeout_s
        if self._source is not None and not self._source.wait_idle(timeout_s):
            return False
        with self._changed:
            while self._items or self._busy or self._first is not None:
                left = deadline - time.monotonic()
                if left <= 0:
                    return False
                self._changed.wait(left)
        return True

    def stop(self, timeout_s: float = 2.0) -> None:
        """Finish the item at hand and end the thread."""
        with self._changed:
            self._stopping = True
            self._items.clear()
            self._changed.notify_all()
        self._thread.join(timeout_s)

    def _run(self) -> None:
        give_way(self._nice)
        while not self._stopping:
            call = self._next()
            if call is not None:
                self._guarded(call)
                with self._changed:
                    self._busy = False
                    self._changed.notify_all()
            if not self._stopping:
                self._guarded(self._idle)

    def _next(self) -> Callable[[], None] | None:
        with self._changed:
            if not (self._items or self._first or self._woken or self._stopping):
                self._changed.wait(self._idle_period_s)
            self._woken = False
            if self._stopping or not (self._items or self._first is not None):
                return None
            self._busy = True
            if self._first is not None:
                action, self._first = self._first, None
                return action
            dropped = self._pass_over()
            call = partial(self._handle, self._items.popleft())
        self._hand_back(dropped)
        return call

    def _pass_over(self) -> list[Item]:
        """Take out all but the newest item if the oldest has waited for too long."""
        newer = len(self._items) - 1
        return self._take_out(newer if newer and self._is_late(self._items[0]) else 0)

    def _take_out(self, count: int) -> list[Item]:
        """Drop the oldest items; the lock is held."""
        self.dropped += count
        return [self._items.popleft() for _ in range(count)]

    def _hand_back(self, items: Sequence[Item]) -> None:
        for item in items:
            self._guarded(partial(self._on_drop, item))

    def _guarded(self, call: Callable[[], None]) -> None:
        try:
            call()
        except Exception as error:  # whatever it was, the next item must be handled
            if not self._stopping:
                self._on_error(error)
