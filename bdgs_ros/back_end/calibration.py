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

from bdgs_ros.core.bend import BENDS

Array = NDArray[np.float64]

SIZE = BENDS + 1


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
