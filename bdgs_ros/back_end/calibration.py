"""
What all keyframes have in common: the bend of the depth sensor and the shutter's readout time.

A rolling shutter exposes one row after the other. While the camera moves with `twist`, row `v` of
`H` is seen from `T_world_camera @ exp((v / H - 1/2) * readout_s * twist)`. On the recordings that
we have this is the largest error of all (`docs/architecture.md`).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

BENDS = 5
SIZE = BENDS + 1
_HALF_WIDTH = 0.5  # tangent at which the functions are about 1


@dataclass(frozen=True)
class Calibration:
    """Of one camera; starts as a perfect one."""

    bend: Array
    """Shape (5,), 1/m: coefficients of `bend_functions`, added to measured inverse depth."""
    readout_s: float
    """From the first row to the last."""

    @classmethod
    def perfect(cls) -> Calibration:
        """Return that of a camera without any error."""
        return cls(np.zeros(BENDS), 0.0)

    @property
    def vector(self) -> Array:
        """All numbers, shape (6,)."""
        return np.append(self.bend, self.readout_s)

    @classmethod
    def of_vector(cls, vector: Array) -> Calibration:
        """Undo `vector`."""
        return cls(vector[:BENDS].copy(), float(vector[BENDS]))


@dataclass(frozen=True)
class Known:
    """What is known of a calibration before any keyframe has been seen."""

    calibration: Calibration
    readout_sigma_s: float


def bend_functions(tangents: Array) -> Array:
    """
    Return the functions that a bend is made of, at viewing rays.

    The same as in `bdgs_ros.mapping.depth_bend`, which learns from depth alone; a constant is
    left out because it would scale the world.

    Parameters
    ----------
    tangents : ndarray, shape (N, 2)
        (x, y) of rays with z = 1.

    Returns
    -------
    functions : ndarray, shape (N, 5)

    """
    x, y = tangents.T / _HALF_WIDTH
    return np.stack([x, y, x * x, x * y, y * y], axis=1)
