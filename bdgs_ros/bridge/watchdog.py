"""Notice topics that fall silent and say what is missing; ROS-free, the caller reads the clock."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple


@dataclass
class _Topic:
    """What is known about one topic."""

    name: str
    once: bool
    """Whether one message is enough (camera_info)."""
    last_s: float | None = None
    warned: bool = False


class Change(NamedTuple):
    """Something the user should know."""

    is_bad: bool
    text: str


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

    def check(self, now_s: float) -> list[Change]:
        """Return what has changed for the worse or the better since the last check."""
        changed = [topic for topic in self._topics.values() if self._update(topic, now_s)]
        back = [topic.name for topic in changed if not topic.warned]
        changes = [Change(False, f'{_quoted(back)}: back')] if back else []
        groups: dict[str, list[_Topic]] = {}
        for topic in changed:
            if topic.warned:
                groups.setdefault(self._reason(topic), []).append(topic)
        for reason, group in groups.items():
            changes.append(Change(True, self._describe(group, reason, now_s)))
        return changes

    def silent(self) -> list[str]:
        """Return the topics that were silent at the last check."""
        return [topic.name for topic in self._topics.values() if topic.warned]

    def _update(self, topic: _Topic, now_s: float) -> bool:
        """Return whether a topic has fallen silent or come back."""
        done = topic.once and topic.last_s is not None
        is_silent = not done and now_s - self._since_s(topic) > self._silence_s
        changed = is_silent != topic.warned
        topic.warned = is_silent
        return changed

    def _since_s(self, topic: _Topic) -> float:
        return self._started_s if topic.last_s is None else topic.last_s

    def _reason(self, topic: _Topic) -> str:
        if self._publishers(topic.name) == 0:
            return 'no publisher: start the camera or the replay, or remap the topic'
        if topic.last_s is None:
            return (
                'its publisher is silent, or its quality of service does not match (try '
                'qos.reliability:=best_effort)'
            )
        return 'its publisher went silent'

    def _describe(self, group: list[_Topic], reason: str, now_s: float) -> str:
        silent_s = now_s - max(self._since_s(topic) for topic in group)
        never = 'never received anything' if group[0].last_s is None else 'nothing received'
        arriving = [
            topic.name
            for topic in self._topics.values()
            if not topic.warned and topic.last_s is not None
        ]
        beside = f'; {_quoted(arriving)} did arrive' if arriving else ''
        names = _quoted([topic.name for topic in group])
        return f'{names}: {never} for {silent_s:.1f} s; {reason}{beside}'


def _quoted(names: list[str]) -> str:
    return ', '.join(f"'{name}'" for name in names)
