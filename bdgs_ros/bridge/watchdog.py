"""Notice topics that fall silent and say what is missing; ROS-free, the caller reads the clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass


@dataclass
class _Topic:
    """What is known about one topic."""

    name: str
    once: bool
    """Whether one message is enough (camera_info)."""
    last_s: float | None = None
    warned: bool = False


class Watchdog:
    """
    Warn once when a topic is silent, and once when it is back.

    Parameters
    ----------
    silence_s : float
        Silence longer than this is worth a warning.
    started_s : float
        Now, on the caller's clock.
    publishers : callable
        Returns how many publishers a topic has.

    """

    def __init__(
        self, silence_s: float, started_s: float, publishers: Callable[[str], int]
    ) -> None:
        self._silence_s = silence_s
        self._started_s = started_s
        self._publishers = publishers
        self._topics: dict[str, _Topic] = {}

    def expect(self, name: str, *, once: bool = False) -> None:
        """Watch a topic; with `once`, its first message is enough."""
        self._topics[name] = _Topic(name, once)

    def note(self, name: str, now_s: float) -> None:
        """Say that a message has arrived."""
        self._topics[name].last_s = now_s

    def check(self, now_s: float) -> list[str]:
        """Return what has changed for the worse or the better since the last check."""
        return [text for topic in self._topics.values() if (text := self._check(topic, now_s))]

    def silent(self) -> list[str]:
        """Return the topics that were silent at the last check."""
        return [topic.name for topic in self._topics.values() if topic.warned]

    def _check(self, topic: _Topic, now_s: float) -> str:
        since = self._started_s if topic.last_s is None else topic.last_s
        done = topic.once and topic.last_s is not None
        is_silent = not done and now_s - since > self._silence_s
        if is_silent == topic.warned:
            return ''
        topic.warned = is_silent
        if not is_silent:
            return f"'{topic.name}' is back"
        return self._describe(topic, now_s - since, now_s)

    def _describe(self, topic: _Topic, silent_s: float, now_s: float) -> str:
        never = 'nothing was ever received' if topic.last_s is None else 'nothing received'
        count = self._publishers(topic.name)
        if count == 0:
            reason = 'it has no publisher: start the camera or replay, or remap the topic'
        elif topic.last_s is None:
            reason = (
                f'it has {count} publisher(s): they are silent, or their quality of service does '
                'not match (try qos.reliability:=best_effort)'
            )
        else:
            reason = f'its {count} publisher(s) went silent'
        others = [
            other.name
            for other in self._topics.values()
            if other is not topic
            and other.last_s is not None
            and (other.once or now_s - other.last_s <= self._silence_s)
        ]
        names = ', '.join(f"'{name}'" for name in others)
        beside = f'; {names} did arrive' if others else ''
        return f"'{topic.name}': {never} for {silent_s:.1f} s; {reason}{beside}"
