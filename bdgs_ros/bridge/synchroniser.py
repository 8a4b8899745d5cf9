"""
Pair two streams of stamped items, colour and depth, nearest first: ROS-free and clock-free.

The offline association sees whole recordings: it takes the closest two stamps, then the closest
two of the rest, and so on. Here items arrive one by one, each stream in order of its stamps. Two
items that are each other's nearest are a pair of the offline association as soon as nothing that
may still arrive can come between them. What may still arrive is later than the newest item of
its stream by at least `gap`:

- `STRICT`: gap 0. The pairs are those of the offline association; a pair may have to wait for
  the next image.
- `PREDICT`: gap 0.9 of the shortest of the last intervals: for live cameras, no wait.
- `EAGER`: gap infinite. For lockstep, where nothing more arrives before this pair is done.
"""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from enum import Enum
from typing import Any, Generic, TypeVar

Left = TypeVar('Left')
Right = TypeVar('Right')
Item = TypeVar('Item')

_PREDICTED_SHARE = 0.9
_INTERVALS = 30
_FAR_AHEAD_NS = 60_000_000_000  # after a pause; or the stamp of one image is wrong
_CONFIRMED_WITHIN_NS = 10_000_000_000


class Patience(Enum):
    """How long a pair waits for a better one."""

    STRICT = 'strict'
    PREDICT = 'predict'
    EAGER = 'eager'


@dataclass
class SyncCounts:
    """What became of the items."""

    pairs: int = 0
    unpaired_left: int = 0
    unpaired_right: int = 0
    duplicates: int = 0
    out_of_order: int = 0
    jumps: int = 0
    strange: int = 0
    """Far from those before, and left out: one alone may be wrong, the next one will tell."""


@dataclass
class _Stream(Generic[Item]):
    """The items of one stream that may still find a partner, in order of their stamps."""

    items: deque[tuple[int, Item]] = field(default_factory=deque)
    newest_ns: int | None = None
    intervals_ns: deque[int] = field(default_factory=lambda: deque(maxlen=_INTERVALS))
    jump_pending: bool = False
    strange_ns: int | None = None
    """The last stamp that was far from those before it."""

    def append(self, stamp_ns: int, item: Item) -> None:
        if self.newest_ns is not None:
            self.intervals_ns.append(stamp_ns - self.newest_ns)
        self.newest_ns = stamp_ns
        self.items.append((stamp_ns, item))

    def confirms(self, stamp_ns: int) -> bool:
        """Return whether a stamp far off follows one like it: a single one may be wrong."""
        before, self.strange_ns = self.strange_ns, stamp_ns
        return before is not None and 0 < stamp_ns - before <= _CONFIRMED_WITHIN_NS

    def restart(self) -> None:
        self.items.clear()
        self.newest_ns = self.strange_ns = None
        self.intervals_ns.clear()
        self.jump_pending = False

    def earliest_next_ns(self, patience: Patience) -> float:
        """Return the earliest stamp that the next item is assumed to have."""
        if patience is Patience.EAGER:
            return math.inf
        if self.newest_ns is None:
            return -math.inf
        if patience is Patience.STRICT or not self.intervals_ns:
            return self.newest_ns
        return self.newest_ns + _PREDICTED_SHARE * min(self.intervals_ns)

    def nearest(self, stamp_ns: int) -> int:
        """Return the index of the item nearest to a stamp; the earlier one of two equals."""
        return min(range(len(self.items)), key=lambda i: abs(self.items[i][0] - stamp_ns))


class Synchroniser(Generic[Left, Right]):
    """
    Pair the items of two streams one to one, nearest within a tolerance, in order.

    Parameters
    ----------
    tolerance_ns : int
        Items further apart are no pair.
    jump_back_ns : int
        A stamp older than the newest by more than this starts over; a smaller step back only
        drops the item.
    patience : Patience
        How long a pair waits for a better one.
    on_jump : callable
        Called once when the stamps jump back, before anything newer is paired.
    capacity : int
        Items kept per stream.

    """

    def __init__(
        self,
        tolerance_ns: int,
        jump_back_ns: int,
        patience: Patience = Patience.STRICT,
        on_jump: Callable[[], None] = lambda: None,
        capacity: int = 30,
    ) -> None:
        self.counts = SyncCounts()
        self._tolerance_ns = tolerance_ns
        self._jump_back_ns = jump_back_ns
        self._patience = patience
        self._on_jump = on_jump
        self._capacity = capacity
        self._left: _Stream[Left] = _Stream()
        self._right: _Stream[Right] = _Stream()

    def add_left(self, stamp_ns: int, item: Left) -> list[tuple[Left, Right]]:
        """Take an item of the left stream; return the pairs that are now certain, in order."""
        if not self._accept(self._left, self._right, stamp_ns):
            return []
        self._left.append(stamp_ns, item)
        return self._take_pairs()

    def add_right(self, stamp_ns: int, item: Right) -> list[tuple[Left, Right]]:
        """Take an item of the right stream; return the pairs that are now certain, in order."""
        if not self._accept(self._right, self._left, stamp_ns):
            return []
        self._right.append(stamp_ns, item)
        return self._take_pairs()

    def flush(self) -> list[tuple[Left, Right]]:
        """Return the pairs that are left at the end of both streams."""
        pairs = self._resolve(len(self._left.items), len(self._right.items))
        self.clear()
        return pairs

    def clear(self) -> None:
        """Forget the items and the stamps seen, not the counts."""
        self._drop(len(self._left.items), len(self._right.items))
        self._left.restart()
        self._right.restart()

    def _accept(self, stream: _Stream[Item], other: _Stream[Any], stamp_ns: int) -> bool:
        if stream.jump_pending:
            return self._accept_after_jump(stream, other, stamp_ns)
        newest = stream.newest_ns
        if newest is None or 0 < stamp_ns - newest <= _FAR_AHEAD_NS:
            stream.strange_ns = None
            return True
        if 0 <= newest - stamp_ns <= self._jump_back_ns:
            if stamp_ns == newest:
                self.counts.duplicates += 1
            else:
                self.counts.out_of_order += 1
            return False
        # Whoever is sent pairs one by one, and waited for, takes them as they are.
        if self._patience is Patience.PREDICT and not stream.confirms(stamp_ns):
            self.counts.strange += 1
            return False
        if stamp_ns > newest:
            return True
        stream.restart()
        other.items.clear()
        other.jump_pending = True
        self.counts.jumps += 1
        self._on_jump()
        return True

    def _accept_after_jump(
        self, stream: _Stream[Item], other: _Stream[Any], stamp_ns: int
    ) -> bool:
        """Drop what comes late from before the jump of the other stream, then follow it."""
        if other.newest_ns is not None and stamp_ns - other.newest_ns > self._jump_back_ns:
            self.counts.out_of_order += 1
            return False
        stream.restart()
        return True

    def _take_pairs(self) -> list[tuple[Left, Right]]:
        pairs: list[tuple[Left, Right]] = []
        while (found := self._certain_pair()) is not None:
            left, right = found
            pairs += self._resolve(left, right)  # nothing can come between these any more
            pairs.append((self._left.items[left][1], self._right.items[right][1]))
            self.counts.pairs += 1
            self._drop(left, right)
            self._left.items.popleft()
            self._right.items.popleft()
        self._drop_hopeless()
        return pairs

    def _certain_pair(self) -> tuple[int, int] | None:
        """Return the indices of the first pair that no later item can break."""
        if not self._right.items:
            return None
        for left, (left_ns, _) in enumerate(self._left.items):
            right = self._right.nearest(left_ns)
            right_ns = self._right.items[right][0]
            if abs(left_ns - right_ns) > self._tolerance_ns:
                continue
            mutual = self._left.nearest(right_ns) == left
            if mutual and self._is_final(left_ns, right_ns):
                return left, right
        return None

    def _is_final(self, left_ns: int, right_ns: int) -> bool:
        distance = abs(left_ns - right_ns)
        next_left = self._left.earliest_next_ns(self._patience)
        next_right = self._right.earliest_next_ns(self._patience)
        return (
            max(next_left, right_ns) - right_ns >= distance
            and max(next_right, left_ns) - left_ns >= distance
        )

    def _resolve(self, left_end: int, right_end: int) -> list[tuple[Left, Right]]:
        """Pair the first items of both streams among themselves, nearest first, and drop them."""
        lefts = [self._left.items[i] for i in range(left_end)]
        rights = [self._right.items[i] for i in range(right_end)]
        pairs = _pair_all(lefts, rights, self._tolerance_ns)
        self.counts.pairs += len(pairs)
        self.counts.unpaired_left -= len(pairs)
        self.counts.unpaired_right -= len(pairs)
        return pairs

    def _drop(self, left_end: int, right_end: int) -> None:
        """Drop the first items of both streams; `_resolve` has put paired ones to our credit."""
        for _ in range(left_end):
            self._left.items.popleft()
        for _ in range(right_end):
            self._right.items.popleft()
        self.counts.unpaired_left += left_end
        self.counts.unpaired_right += right_end

    def _drop_hopeless(self) -> None:
        """Drop what is too old to find a partner."""
        self.counts.unpaired_left += self._trim(self._left, self._right)
        self.counts.unpaired_right += self._trim(self._right, self._left)

    def _trim(self, stream: _Stream[Item], other: _Stream[Any]) -> int:
        dropped = 0
        while stream.items and (
            len(stream.items) > self._capacity or self._is_hopeless(stream.items[0][0], other)
        ):
            stream.items.popleft()
            dropped += 1
        return dropped

    def _is_hopeless(self, stamp_ns: int, other: _Stream[Any]) -> bool:
        if other.newest_ns is None or other.jump_pending:
            return False
        if other.newest_ns <= stamp_ns + self._tolerance_ns:
            return False
        return not any(abs(ns - stamp_ns) <= self._tolerance_ns for ns, _ in other.items)


def _pair_all(
    lefts: list[tuple[int, Left]], rights: list[tuple[int, Right]], tolerance_ns: int
) -> list[tuple[Left, Right]]:
    """Pair two short lists nearest first, without crossing, in order."""
    if not lefts or not rights:
        return []
    distance, i, j = min(
        (abs(a[0] - b[0]), i, j) for i, a in enumerate(lefts) for j, b in enumerate(rights)
    )
    if distance > tolerance_ns:
        return []
    return [
        *_pair_all(lefts[:i], rights[:j], tolerance_ns),
        (lefts[i][1], rights[j][1]),
        *_pair_all(lefts[i + 1 :], rights[j + 1 :], tolerance_ns),
    ]
