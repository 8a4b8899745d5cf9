"""Where a camera may be looked for, and what came of it."""

from __future__ import annotations

import bisect
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.types import Pose, ProbabilityImage
from bdgs_ros.tracking.align import AlignResult, ImagePyramid

Transform = Callable[[int], Pose | None]
"""Gives `T_new_old` in world for what belongs to a stamp (ns), None where it stays."""


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


@dataclass(frozen=True)
class Hypothesis:
    """Where a lost camera may be; the next frame decides."""

    stamp_ns: int
    T_world_camera: Pose
    start: Start


def moved(reference: Reference, transform: Transform) -> Reference:
    """Return a reference after a correction of the world."""
    T_new_old = transform(reference.stamp_ns)
    if T_new_old is None:
        return reference
    pose = se3.orthonormalise(T_new_old @ reference.T_world_camera)
    return replace(reference, T_world_camera=pose)


def information_of(sigma: tuple[float, float]) -> NDArray[np.float64]:
    """Return the inverse covariance of a pose known to metres and radians."""
    position, angle = sigma
    return np.diag([position**-2] * 3 + [angle**-2] * 3)


def latest_of(transforms: Mapping[int, Pose]) -> Transform:
    """Return the rule by which what is not named moves with the last before it that is."""
    named = sorted(transforms)

    def latest(stamp_ns: int) -> Pose | None:
        place = bisect.bisect_right(named, stamp_ns)
        return transforms[named[place - 1]] if place else None

    return latest
