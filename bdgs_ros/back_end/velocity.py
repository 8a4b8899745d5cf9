"""How fast the camera was when a keyframe was taken, from the poses of the frames around it."""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Sequence
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.types import Pose

Array = NDArray[np.float64]

_AROUND = 3  # steps from frame to frame, on each side
_LONGEST_STEP_S = 0.2  # that tells a velocity
_STEADY_S = 0.05  # noise of a step's velocity over usual accelerations: 0.25 rad/s, 5 rad/s^2


def velocity_at(stamp_ns: int, tracked: Sequence[tuple[int, Pose]]) -> Array:
    """
    Fit a constant acceleration to the steps from frame to frame.

    A single step is noisy, and its velocity is that of half a step earlier. The step that follows
    the keyframe is left out: there tracking jumps by what the back end and mapping corrected.

    Parameters
    ----------
    stamp_ns : int
        Of the keyframe, among those of `tracked`.
    tracked : sequence of (int, ndarray of shape (4, 4))
        Stamp and `T_world_camera` in order of time.

    Returns
    -------
    twist : ndarray, shape (6,)
        (v, w) in the camera's frame, m/s and rad/s; 0 where nothing is known.

    """
    entries = list(tracked)
    at = bisect_left([entry[0] for entry in entries], stamp_ns)
    near = entries[max(at - _AROUND, 0) : at + _AROUND + 1]
    times, velocities = [], []
    for (before_ns, T_before), (after_ns, T_after) in pairwise(near):
        step_s = (after_ns - before_ns) * 1e-9
        if before_ns != stamp_ns and step_s <= _LONGEST_STEP_S:
            times.append(((before_ns + after_ns) / 2 - stamp_ns) * 1e-9)
            velocities.append(se3.log(se3.inverse(T_before) @ T_after) / step_s)
    return _at_zero(np.array(times), np.array(velocities).reshape(-1, 6))


def _at_zero(times: Array, values: Array) -> Array:
    """Return what a line through values, shape (N, 6), has at time 0."""
    if not len(times):
        return np.zeros(6)
    line = np.stack([np.ones_like(times), times], axis=1)
    normal = line.T @ line + np.diag([0, _STEADY_S**2])
    return np.asarray(np.linalg.solve(normal, line.T @ values)[0])
