"""Paths on the floor: smooth in time, with heading, distance and speed."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.interpolate import CubicSpline, PchipInterpolator

Array = NDArray[np.float64]
_SAMPLES = 2000


class FloorPath(Protocol):
    """A point moving on the floor."""

    def place(self, time_s: float) -> tuple[float, float, float]:
        """Return x, y in metres and the heading in radians."""

    def distance(self, time_s: float) -> float:
        """Return the way gone since time 0 in metres."""

    def speed(self, time_s: float) -> float:
        """Return the speed in m/s."""


class LoopPath:
    """
    A closed smooth curve through points, followed at one speed.

    Before `start_s` the point waits at `phase` (a share of the loop); it takes a second to reach
    its speed when it has waited.
    """

    def __init__(
        self, points: Sequence[tuple[float, float]], speed: float, phase: float, start_s: float
    ) -> None:
        closed = np.array([*points, points[0]], dtype=np.float64)
        knots = np.arange(len(closed), dtype=np.float64)
        self._curve = CubicSpline(knots, closed, bc_type='periodic')
        self._turn = self._curve.derivative()
        fine = np.linspace(0, len(points), _SAMPLES)
        steps = np.linalg.norm(np.diff(self._curve(fine), axis=0), axis=1)
        self._knot, self._length = fine, np.concatenate([[0], np.cumsum(steps)])
        self.length = float(self._length[-1])
        self._speed, self._offset, self._start = speed, phase * self.length, start_s

    def distance(self, time_s: float) -> float:
        """Return the way gone since time 0 in metres."""
        if self._start <= 0:
            return self._speed * (time_s - self._start)
        t = time_s - self._start
        return self._speed * (0.0 if t < 0 else 0.5 * t * t if t < 1 else t - 0.5)

    def speed(self, time_s: float) -> float:
        """Return the speed in m/s."""
        if self._start <= 0:
            return self._speed
        return self._speed * float(np.clip(time_s - self._start, 0, 1))

    def place(self, time_s: float) -> tuple[float, float, float]:
        """Return x, y in metres and the heading in radians."""
        way = (self._offset + self.distance(time_s)) % self.length
        knot = np.interp(way, self._length, self._knot)
        (x, y), (dx, dy) = self._curve(knot), self._turn(knot)
        return float(x), float(y), float(np.arctan2(dy, dx))


class KeyedPath:
    """A path through places at given times, smooth and without overshoot (monotone cubic)."""

    def __init__(self, keys: Sequence[tuple[float, float, float, float]]) -> None:
        """Take keys of time in seconds, x, y in metres, heading in radians."""
        table = np.array(keys, dtype=np.float64)
        table[:, 3] = np.unwrap(table[:, 3])
        self._curve = PchipInterpolator(table[:, 0], table[:, 1:], extrapolate=False)
        self._first, self._last = float(table[0, 0]), float(table[-1, 0])
        self._times = np.linspace(self._first, self._last, _SAMPLES)
        points = self._curve(self._times)[:, :2]
        steps = np.linalg.norm(np.diff(points, axis=0), axis=1)
        self._ways = np.concatenate([[0], np.cumsum(steps)])

    def place(self, time_s: float) -> tuple[float, float, float]:
        """Return x, y in metres and the heading in radians."""
        x, y, heading = self._curve(float(np.clip(time_s, self._first, self._last)))
        return float(x), float(y), float(heading)

    def distance(self, time_s: float) -> float:
        """Return the way gone since the first key in metres."""
        return float(np.interp(time_s, self._times, self._ways))

    def speed(self, time_s: float) -> float:
        """Return the speed in m/s."""
        return (self.distance(time_s + 0.05) - self.distance(time_s - 0.05)) / 0.1
