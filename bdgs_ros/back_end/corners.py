"""
Corners of a keyframe, followed into another keyframe whose pose is about known.

ORB positions are good to half a pixel at best; patches that Lucas and Kanade's method follows
(Bouguet's pyramids) are good to a tenth where the view did not turn much, and that is what
neighbouring keyframes need.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.back_end import BundleConfig
from bdgs_ros.core.types import Keyframe, Pose

Array = NDArray[np.float64]

_SMALL = 0.5  # scale of depth and mask as they are kept
_WINDOW_PX = 15
_SETTLED = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 10, 0.03)  # rounds, px
_LEVELS = 1  # of the pyramid above the image: the start is good to a few pixels
_APART_PX = 14  # corners of one image
_QUALITY = 0.01  # of the best corner
_MARGIN_PX = 15  # from what moves
_RIM_PX = 12  # of the image
_EDGE = 0.06  # of the depth: corners on larger steps belong to no surface
_LEAST_M = 0.3
_RETURN_PX = 0.7  # followed there and back again, a corner must arrive within this
_SURPRISE_PX = 20.0  # from where the pose predicts it


@dataclass(frozen=True)
class View:
    """What the back end keeps of a keyframe."""

    stamp_ns: int
    camera: PinholeCamera
    grey: NDArray[np.uint8]
    """Shape (H, W): contrast made equal everywhere, so that exposure does not matter."""
    depth_m: NDArray[np.float16]
    """Shape (H/2, W/2): as measured."""
    p_dynamic: NDArray[np.uint8]
    """Shape (H/2, W/2): x 255."""
    twist: Array
    """Shape (6,): the camera's velocity (rho, phi) in its own frame, m/s and rad/s."""

    @classmethod
    def of(cls, keyframe: Keyframe, twist: Array) -> View:
        """Prepare a keyframe."""
        frame = keyframe.frame
        grey = cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)
        size = (round(frame.camera.width * _SMALL), round(frame.camera.height * _SMALL))

        def small(image: NDArray[Any]) -> NDArray[Any]:
            return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST))

        return cls(
            frame.stamp_ns,
            frame.camera,
            np.asarray(cv2.createCLAHE(3.0, (8, 8)).apply(grey), np.uint8),
            small(frame.depth_m).astype(np.float16),
            small(keyframe.p_dynamic).astype(np.uint8),
            twist,
        )

    def at(self, pixels: Array) -> tuple[Array, Array]:
        """Return inverse depth (0 where unknown) and P(static) at pixels, each of shape (N,)."""
        height, width = self.depth_m.shape
        columns, rows = np.clip(
            (pixels * _SMALL + 0.25).astype(int).T, 0, [[width - 1], [height - 1]]
        )
        depth = self.depth_m[rows, columns].astype(np.float64)
        known = np.isfinite(depth) & (depth > _LEAST_M)
        inverse = np.where(known, 1 / np.where(known, depth, 1), 0)
        return inverse, 1 - self.p_dynamic[rows, columns] / 255


@dataclass(frozen=True)
class Corners:
    """Corners of one view that have depth and do not move."""

    view: View
    pixels: Array
    """Shape (N, 2)."""
    inverse_depth: Array
    """Shape (N,), 1/m as measured."""
    p_static: Array
    """Shape (N,)."""


@dataclass(frozen=True)
class Shared:
    """Corners of one view that were found in another."""

    tangents: Array
    """Shape (N, 2): of the rays in the view that they come from."""
    inverse_depth: Array
    """Shape (N,), 1/m."""
    tangents_other: Array
    """Shape (N, 2): of the rays on which the other view shows them."""
    inverse_depth_other: Array
    """Shape (N,), 1/m; 0 where the other view has no depth."""
    rows: Array
    """Shape (N, 2): row over height, minus a half, in the one and the other view."""
    p_static: Array
    """Shape (N,): both at once."""

    def __len__(self) -> int:
        """Return the number of corners."""
        return len(self.tangents)


def find_corners(view: View, config: BundleConfig) -> Corners:
    """Return the best corners on surfaces that do not move."""
    size = (view.camera.width, view.camera.height)
    still = (view.p_dynamic < 255 * config.max_dynamic).astype(np.uint8)
    depth = np.nan_to_num(view.depth_m.astype(np.float32))
    kernel = np.ones((3, 3), np.uint8)
    near, far = cv2.erode(depth, kernel), cv2.dilate(depth, kernel)
    flat = (near > _LEAST_M) & (far - near < _EDGE * far)
    margin = np.ones((round(_MARGIN_PX * _SMALL) | 1,) * 2, np.uint8)
    usable = flat & (cv2.erode(still, margin) > 0)
    mask = cv2.resize(usable.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
    found = cv2.goodFeaturesToTrack(view.grey, config.corners, _QUALITY, _APART_PX, mask=mask)
    pixels = np.zeros((0, 2)) if found is None else found.reshape(-1, 2).astype(np.float64)
    inverse, p_static = view.at(pixels)
    known = inverse > 0
    return Corners(view, pixels[known], inverse[known], p_static[known])


def overlap(corners: Corners, other: View, T_other_one: Pose) -> float:
    """Return which share of the corners another view should show."""
    if not len(corners.pixels):
        return 0.0
    return float(_predict(corners, other, T_other_one)[1].mean())


def follow(corners: Corners, other: View, T_other_one: Pose) -> Shared:
    """
    Find the corners in another view.

    Parameters
    ----------
    corners : Corners
        Of the one view.
    other : View
        Of the same camera.
    T_other_one : ndarray, shape (4, 4)
        Good to about `_SURPRISE_PX` pixels.

    Returns
    -------
    shared : Shared
        Those found there, and found back from there.

    """
    predicted, inside = _predict(corners, other, T_other_one)
    rows = np.flatnonzero(inside)
    start = corners.pixels[rows].astype(np.float32)
    there, found = _track(corners.view.grey, other.grey, start, predicted[rows])
    # The way back starts as far off as the way there did, so that it is a check.
    back, returned = _track(other.grey, corners.view.grey, there, start + predicted[rows] - there)
    good = found & returned & (np.linalg.norm(back - start, axis=1) < _RETURN_PX)
    good &= np.linalg.norm(there - predicted[rows], axis=1) < _SURPRISE_PX
    return _shared(corners, other, rows[good], there[good].astype(np.float64))


def _shared(corners: Corners, other: View, rows: NDArray[np.intp], there: Array) -> Shared:
    height = other.camera.height
    inverse_other, p_static_other = other.at(there)
    return Shared(
        corners.view.camera.tangents(corners.pixels[rows]),
        corners.inverse_depth[rows],
        other.camera.tangents(there),
        inverse_other,
        np.stack([corners.pixels[rows, 1], there[:, 1]], axis=1) / height - 0.5,
        corners.p_static[rows] * p_static_other,
    )


def _predict(corners: Corners, other: View, T_other_one: Pose) -> tuple[Array, NDArray[np.bool_]]:
    """Return where corners should be, shape (N, 2), and whether that is inside, shape (N,)."""
    tangents = corners.view.camera.tangents(corners.pixels)
    rays = np.column_stack([tangents, np.ones(len(tangents))])
    points = rays / corners.inverse_depth[:, None] @ T_other_one[:3, :3].T + T_other_one[:3, 3]
    ahead = points[:, 2] > _LEAST_M / 2
    points[~ahead, 2] = 1
    pixels = other.camera.project(points)
    limit = np.array([other.camera.width, other.camera.height]) - _RIM_PX
    inside = ahead & (pixels > _RIM_PX).all(axis=1) & (pixels < limit).all(axis=1)
    return pixels, np.asarray(inside)


def _track(
    one: NDArray[np.uint8], other: NDArray[np.uint8], pixels: NDArray[np.float32], start: Array
) -> tuple[NDArray[np.float32], NDArray[np.bool_]]:
    if not len(pixels):
        return np.zeros((0, 2), np.float32), np.zeros(0, bool)
    found, status, _ = cv2.calcOpticalFlowPyrLK(
        one,
        other,
        np.ascontiguousarray(pixels).reshape(-1, 1, 2),
        np.ascontiguousarray(start, np.float32).reshape(-1, 1, 2),
        winSize=(_WINDOW_PX, _WINDOW_PX),
        maxLevel=_LEVELS,
        criteria=_SETTLED,
        flags=cv2.OPTFLOW_USE_INITIAL_FLOW,
    )
    return np.asarray(found.reshape(-1, 2), np.float32), np.asarray(status.ravel() > 0)
