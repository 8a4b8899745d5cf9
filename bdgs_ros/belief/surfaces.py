"""
Depth-connected surfaces of an image: what moves together.

Surfaces end at steps of depth and at creases. Inverse depth is affine over the image of a plane,
so its second difference is zero on planes and jumps at creases: a leg ends where the floor
begins, although their depths touch. The noise of inverse depth is the same everywhere
(`sigma_z = depth_noise z^2`).
"""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.types import DepthImage

Array = NDArray[np.float32]
Index = NDArray[np.int32]

KINECT_NOISE = 0.0028  # of inverse depth, 1/m
_KERNEL = np.ones((3, 3), np.uint8)
_STEP_PX = 4  # between the samples of the second difference; creases add up over it
_STEP_SIGMA = 8.0  # neighbours farther apart in inverse depth lie on two surfaces
_CREASE_SIGMA = 4.0  # second differences larger than this are creases
_RIM_SIGMA = 12.0  # a rim may differ by this from the surface it is given back to
_MIN_PX = 60  # smaller surfaces are specks


def find_surfaces(depth_m: DepthImage, depth_noise: float = KINECT_NOISE) -> Index:
    """
    Cut a depth image into surfaces.

    Parameters
    ----------
    depth_m : ndarray, shape (H, W)
        Metres, 0 where invalid.
    depth_noise : float
        Standard deviation of inverse depth, 1/m.

    Returns
    -------
    label : ndarray of int32, shape (H, W)
        Number of the surface, from 1; 0 where there is none, beside steps of depth too.

    """
    inverse = np.where(depth_m > 0, 1 / np.maximum(depth_m, 1e-3), 0).astype(np.float32)
    near, far = cv2.dilate(inverse, _KERNEL), cv2.erode(inverse, _KERNEL)
    smooth = (far > 0) & (near - far < _STEP_SIGMA * depth_noise)
    for axis in (0, 1):
        smooth &= np.abs(_second_difference(inverse, axis)) < _CREASE_SIGMA * depth_noise
    _, label, stats, _ = cv2.connectedComponentsWithStats(
        smooth.astype(np.uint8), connectivity=4
    )
    large = stats[:, cv2.CC_STAT_AREA] >= _MIN_PX
    large[0] = False
    number = np.where(large, np.cumsum(large), 0).astype(np.int32)
    return _grown(np.asarray(number[label], np.int32), inverse, depth_noise)


def _grown(label: Index, inverse: Array, depth_noise: float) -> Index:
    """Give back to surfaces the rims that the differences cut off."""
    _, nearest = cv2.distanceTransformWithLabels(
        (label == 0).astype(np.uint8), cv2.DIST_L2, 3, labelType=cv2.DIST_LABEL_PIXEL
    )
    first = np.zeros(int(nearest.max()) + 1, np.int64)
    inside = label > 0
    first[nearest[inside]] = np.flatnonzero(inside)
    source = first[nearest]
    away = np.abs(inverse.ravel()[source] - inverse)
    same = (inverse > 0) & (away < _RIM_SIGMA * depth_noise)
    return np.where(same, label.ravel()[source], 0).astype(np.int32)


def _second_difference(inverse: Array, axis: int) -> Array:
    """Return f(x - s) - 2 f(x) + f(x + s) of the image blurred over s pixels."""
    mean = cv2.blur(inverse, (_STEP_PX - 1, _STEP_PX - 1))
    ahead, behind = np.roll(mean, -_STEP_PX, axis), np.roll(mean, _STEP_PX, axis)
    result = np.asarray(ahead - 2 * mean + behind, np.float32)
    ends: list[slice | list[int]] = [slice(None), slice(None)]
    ends[axis] = [*range(_STEP_PX), *range(-_STEP_PX, 0)]
    result[tuple(ends)] = 0
    return result


def mean_by_group(values: Array, group: Index) -> Array:
    """
    Give each member the mean of its group.

    Parameters
    ----------
    values : ndarray, shape (N,)
        Of each member.
    group : ndarray of int32, shape (N,)
        Not negative, and not much larger than there are groups.

    Returns
    -------
    mean : ndarray, shape (N,)

    """
    total = np.bincount(group, values)
    return np.asarray((total / np.maximum(np.bincount(group), 1))[group], np.float32)
