"""Read single messages, mostly in order, from storage that is only quick to read in order."""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Iterator
from typing import NamedTuple

_HELD = 32  # messages; colour and depth that belong together lie closer
_NEAR_NS = 1_000_000_000  # further ahead it is quicker to start anew than to read up to there


class RawMessage(NamedTuple):
    """One message as it is stored."""

    topic: str
    msgtype: str
    stamp_ns: int
    """When it was logged; in bags made by `bdgs convert` this is the header's stamp."""
    data: bytes


class MessageKey(NamedTuple):
    """Which message, among those of a bag."""

    topic: str
    log_ns: int
    nth: int
    """Among the messages of its topic with the same log time."""


class BagCursor:
    """
    A position in a stream of messages, and the last few that went by.

    Parameters
    ----------
    messages : iterator of RawMessage
        In order of log time; the first log time must come with all its messages.

    """

    def __init__(self, messages: Iterator[RawMessage]) -> None:
        self._messages = messages
        self._held: OrderedDict[MessageKey, bytes] = OrderedDict()
        self._last: dict[str, MessageKey] = {}
        self._position_ns: int | None = None

    def find(self, key: MessageKey) -> bytes | None:
        """Return a message that went by lately or lies not far ahead, else None."""
        position_ns = self._position_ns
        if position_ns is None or position_ns <= key.log_ns <= position_ns + _NEAR_NS:
            while key not in self._held and self._advance(key.log_ns):
                pass
        return self._held.get(key)

    def _advance(self, until_ns: int) -> bool:
        """Take in one message; tell whether the stream has not passed a time yet."""
        raw = next(self._messages, None)
        if raw is None:
            return False
        before = self._last.get(raw.topic)
        again = before is not None and before.log_ns == raw.stamp_ns
        nth = before.nth + 1 if before is not None and again else 0
        key = self._last[raw.topic] = MessageKey(raw.topic, raw.stamp_ns, nth)
        self._position_ns = raw.stamp_ns
        self._held[key] = raw.data
        if len(self._held) > _HELD:
            self._held.popitem(last=False)
        return raw.stamp_ns <= until_ns
