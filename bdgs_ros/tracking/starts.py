"""Where a camera may be looked for, and what came of it."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.types import Pose, ProbabilityImage
from bdgs_ros.tracking.align import AlignResult, ImagePyramid


@dataclass(frozen=True)
class Reference:
    """An image with depth and known pose that frames are aligned to."""

    stamp_ns: int
    T_world_camera: Pose
    pyramid: ImagePyramid


@dataclass(frozen=True)
class Start:
    """Where to look for the camera."""

    reference: Reference
    T_world_camera: Pose
    information: NDArray[np.float64]
    """Shape (6, 6): how sure this is."""
    is_far: bool = False
    """Elsewhere than where the camera was last seen."""
    confirms: bool = False
    """The frame before looked right from here, too."""


@dataclass(frozen=True)
class Estimate:
    """One alignment, as a pose in world."""

    T_world_camera: Pose
    quality: AlignResult


@dataclass(frozen=True)
class Attempt:
    """What came of a start."""

    start: Start
    current: ImagePyramid
    coarse: Estimate
    best: Estimate
    p_dynamic: ProbabilityImage
    covariance: NDArray[np.float64]
    """Shape (6, 6): of the best estimate relative to the reference of the start."""
    p_moving: ProbabilityImage | None = None
    """See `TrackingResult`."""


@dataclass(frozen=True)
class Hypothesis:
    """Where a lost camera may be; the next frame decides."""

    stamp_ns: int
    T_world_camera: Pose
    start: Start


def information_of(sigma: tuple[float, float]) -> NDArray[np.float64]:
    """Return the inverse covariance of a pose known to metres and radians."""
    position, angle = sigma
    return np.diag([position**-2] * 3 + [angle**-2] * 3)
