"""
What is left out when the machine is short, in which order; ROS-free.

Tracking sees first that there is not enough of the machine: frames wait for it. Its governor
knows the frame period and how long poses took lately, and raises or lowers a level by one step
at a time; the other nodes hear the level and leave out what stands at or below it. Tracking
is the last to lose: only a frame that has waited for two periods while newer ones are there
is passed over.
"""

from __future__ import annotations

from collections import deque
from enum import IntEnum

import numpy as np

_INTERVALS = 31  # arrivals that tell the period
_POSES, _LEAST_POSES = 30, 10  # that tell how late they are
_LONGEST_PERIOD_S = 0.5  # of a camera that SLAM is done with
_DECIDE_S = 0.5  # between two changes
_CALM_S = 2.0  # without pressure before a step is given back
_PRESSED, _PRESSED_S = 1.5, 0.04  # periods and s from image to pose, 90th percentile: too many
_AT_EASE, _AT_EASE_S = 1.0, 0.03  # there is room
_LATE = 2.0  # periods that a frame may wait while newer ones are there
_COSTS = 12  # frames that tell what one costs
_FULL, _ROOM = 0.9, 0.35  # of the period: a frame costs too much, or could cost twice as much
_NEEDED = 2  # processors of the graph at camera rate
_FEWEST = 1 / 8  # of the points


class Shed(IntEnum):
    """What is left out, and with it everything above."""

    NOTHING = 0
    RENDERS = 1
    """Views of the map for people."""
    ITERATIONS = 2
    """Most iterations of the map."""
    LABELS = 3
    """Half of the detector's images."""
    PAIRS = 4
    """All but a few pairs of the back end; places are looked for a third as often."""
    KEYFRAMES = 5
    """Every other keyframe."""

    @property
    def words(self) -> str:
        """For diagnostics."""
        names = [step.name.lower() for step in Shed if Shed.NOTHING < step <= self]
        return ', '.join(names) or 'nothing'


def spare_processors(level: Shed, processors: int) -> int:
    """Return how many processors have nothing to do for the graph; none while it is short."""
    return max(processors - _NEEDED, 0) if level is Shed.NOTHING else 0


class Governor:
    """
    Watches how late poses are, and says what is to be left out.

    Times are of one monotonic clock, in seconds.
    """

    def __init__(self) -> None:
        self.level = Shed.NOTHING
        self.reason = ''
        """Why the level is not zero, with numbers."""
        self.points_share = 1.0
        """Share of its points that tracking compares: with all it might not keep up."""
        self._costs_s: deque[float] = deque(maxlen=_COSTS)
        self._arrivals: deque[float] = deque(maxlen=_INTERVALS)
        self._ages_s: deque[float] = deque(maxlen=_POSES)  # of images when their poses came
        self._passed_over = 0  # since they were last looked at
        self._changed_s = -np.inf
        self._pressed_s = -np.inf

    @property
    def period_s(self) -> float:
        """Of the frames as they arrive: the median of the last ones."""
        if len(self._arrivals) < 3:
            return _LONGEST_PERIOD_S
        return min(float(np.median(np.diff(self._arrivals))), _LONGEST_PERIOD_S)

    def note_arrival(self, now_s: float) -> None:
        """Note that a frame has come."""
        if self._arrivals and now_s - self._arrivals[-1] > 2 * _LONGEST_PERIOD_S:
            self._arrivals.clear()  # a pause is no period
        self._arrivals.append(now_s)

    def is_late(self, received_s: float, now_s: float) -> bool:
        """Return whether a frame has waited for so long that a newer one is worth more."""
        return now_s - received_s > _LATE * self.period_s

    def note_passed_over(self) -> None:
        """Note that a frame was passed over."""
        self._passed_over += 1

    def note_pose(self, received_s: float, now_s: float) -> bool:
        """Note that a frame is done; return whether the level has changed."""
        self._ages_s.append(now_s - received_s)
        if len(self._ages_s) < _LEAST_POSES or now_s - self._changed_s < _DECIDE_S:
            return False
        pressure = self._pressure()
        if pressure:
            self._pressed_s = now_s
        return self._step(pressure, now_s)

    def note_cost(self, processor_s: float) -> None:
        """
        Note what a frame took of tracking's processor; choose how closely it looks.

        No other process is to blame for that, so nothing else that is left out would help.
        """
        self._costs_s.append(processor_s)
        if min(len(self._costs_s), len(self._arrivals)) < _COSTS:
            return
        share = float(np.median(self._costs_s)) / self.period_s
        before = self.points_share
        if share > _FULL:
            self.points_share = max(before / 2, _FEWEST)
        elif share < _ROOM:
            self.points_share = min(before * 2, 1.0)
        if self.points_share != before:
            self._costs_s.clear()

    def _pressure(self) -> str:
        """Say why something must be left out; nothing where poses are in time."""
        if self._passed_over:
            return f'{self._passed_over} frames were passed over'
        if self._late_s() > max(_PRESSED * self.period_s, _PRESSED_S):
            return f'poses come {1e3 * self._late_s():.0f} ms after their images'
        return ''

    def _late_s(self) -> float:
        return float(np.percentile(self._ages_s, 90))

    def _is_at_ease(self) -> bool:
        return self._late_s() < max(_AT_EASE * self.period_s, _AT_EASE_S)

    def _step(self, pressure: str, now_s: float) -> bool:
        """Go one step up or down; what it changes is looked at anew."""
        before = self.level
        if pressure:
            self.level = Shed(min(self.level + 1, max(Shed)))
            self.reason = pressure
        elif now_s - self._pressed_s > _CALM_S and self._is_at_ease():
            self.level = Shed(max(self.level - 1, min(Shed)))
        self._passed_over = 0
        if self.level == before:
            return False
        self._changed_s = now_s
        self._ages_s.clear()
        if self.level is Shed.NOTHING:
            self.reason = ''
        return True
