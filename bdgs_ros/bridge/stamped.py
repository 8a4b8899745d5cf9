"""Hand items from the callback thread to the working thread, by their stamps; ROS-free."""

from __future__ import annotations

import threading
import time
from collections import OrderedDict
from typing import Generic, TypeVar

Item = TypeVar('Item')


class StampBuffer(Generic[Item]):
    """
    The newest items of a stream, found by stamp.

    Parameters
    ----------
    capacity : int
        The oldest items beyond this are forgotten.

    """

    def __init__(self, capacity: int) -> None:
        self._capacity = capacity
        self._items: OrderedDict[int, Item] = OrderedDict()
        self._changed = threading.Condition()

    def put(self, stamp_ns: int, item: Item) -> None:
        """Add an item and wake who waits for it."""
        with self._changed:
            self._items[stamp_ns] = item
            while len(self._items) > self._capacity:
                self._items.popitem(last=False)
            self._changed.notify_all()

    def get(self, stamp_ns: int) -> Item | None:
        """Return the item of exactly this stamp, if it is here."""
        with self._changed:
            return self._items.get(stamp_ns)

    def wait(self, stamp_ns: int, timeout_s: float, *, in_order: bool = False) -> Item | None:
        """
        Return the item of exactly this stamp; None when it has not come in time.

        Parameters
        ----------
        stamp_ns : int
            Of the item.
        timeout_s : float
            How long to wait.
        in_order : bool
            Items come by their stamps: once a later one is there, this one was lost on the way.

        """
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while stamp_ns not in self._items:
                if in_order and any(stamp > stamp_ns for stamp in self._items):
                    return None
                left = deadline - time.monotonic()
                if left <= 0:
                    return None
                self._changed.wait(left)
            return self._items[stamp_ns]

    def nearest(self, stamp_ns: int, max_apart_ns: int, timeout_s: float) -> Item | None:
        """Return the item nearest to a stamp; wait for one that is not older, while none is."""
        deadline = time.monotonic() + timeout_s
        with self._changed:
            while not any(stamp >= stamp_ns for stamp in self._items):
                left = deadline - time.monotonic()
                if left <= 0:
                    break
                self._changed.wait(left)
            found = min(self._items, key=lambda stamp: abs(stamp - stamp_ns), default=None)
            if found is None or abs(found - stamp_ns) > max_apart_ns:
                return None
            return self._items[found]

    def newest(self, not_after_ns: int, max_age_ns: int) -> Item | None:
        """Return the newest item up to a stamp and not older than an age before it."""
        with self._changed:
            stamps = [s for s in self._items if not_after_ns - max_age_ns <= s <= not_after_ns]
            return self._items[max(stamps)] if stamps else None

    def take_newest(self) -> Item | None:
        """Remove everything and return the newest item."""
        with self._changed:
            newest = self._items[max(self._items)] if self._items else None
            self._items.clear()
            return newest

    def clear(self) -> None:
        """Forget everything."""
        with self._changed:
            self._items.clear()


class Assembler(Generic[Item]):
    """
    Put the parts of one thing together that arrive on several topics with one stamp.

    Parameters
    ----------
    parts : tuple of str
        The names of all parts.
    capacity : int
        Things that may be incomplete at a time.

    """

    def __init__(self, parts: tuple[str, ...], capacity: int = 8) -> None:
        self._parts = parts
        self._capacity = capacity
        self._pending: OrderedDict[int, dict[str, Item]] = OrderedDict()

    def add(self, stamp_ns: int, part: str, item: Item) -> dict[str, Item] | None:
        """Add a part; return all parts when this was the last one."""
        parts = self._pending.setdefault(stamp_ns, {})
        parts[part] = item
        if len(parts) == len(self._parts):
            return self._pending.pop(stamp_ns)
        while len(self._pending) > self._capacity:
            self._pending.popitem(last=False)
        return None
