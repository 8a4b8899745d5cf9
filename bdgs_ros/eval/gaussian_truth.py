"""
What is true about each Gaussian of a map at the time of a frame, on synthetic recordings.

The static world of that time is known exactly. Map and camera pose are the estimated ones: they
fit each other, so the error of the trajectory as a whole is not counted as an error of the map.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from itertools import product

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import DepthImage, Pose

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_NEAR_M, _NEAR_PER_M = 0.03, 0.005  # up to this much + this * z^2 off a surface is on it
_OFF_M, _OFF_PER_M = 0.04, 0.01  # farther in front than this is on no surface; between: unknown
_REACH_PX = 2  # a centre may lie on the surface of any pixel so near its own
_MIN_Z_M = 0.05


class TrueState(IntEnum):
    """What a Gaussian lies on."""

    UNKNOWN = 0
    """Behind the surface, out of view, or too near to one to tell."""
    STATIC = 1
    """On a surface of the static world of that time."""
    DYNAMIC = 2
    """In front of all of it: on something that moves, or where something was that left."""


@dataclass(frozen=True)
class Projection:
    """Centres of Gaussians in an image."""

    row: NDArray[np.int64]
    """[N] nearest pixel; 0 where not inside"""
    column: NDArray[np.int64]
    z: Array
    """[N] metres along the optical axis"""
    inside: Mask
    """[N] in front of the camera and within the image"""


def project(means: Array, T_world_camera: Pose, camera: PinholeCamera) -> Projection:
    """Project centres, [N, 3] in world, into a camera."""
    T = se3.inverse(T_world_camera).astype(np.float32)
    points = means @ T[:3, :3].T + T[:3, 3]
    z = points[:, 2]
    front = z > _MIN_Z_M
    safe = np.where(front, z, 1)
    column = np.rint(camera.fx * points[:, 0] / safe + camera.cx)
    row = np.rint(camera.fy * points[:, 1] / safe + camera.cy)
    inside = front & (row >= 0) & (row < camera.height) & (column >= 0) & (column < camera.width)
    pixel = np.where(inside, np.stack([row, column]), 0).astype(np.int64)
    return Projection(pixel[0], pixel[1], np.asarray(z, np.float32), np.asarray(inside))


def true_states(at: Projection, static_depth_m: DepthImage) -> NDArray[np.uint8]:
    """
    Compare Gaussians with the static world.

    Parameters
    ----------
    at : Projection
        Of N centres.
    static_depth_m : ndarray, shape (H, W)
        Of the static world of the frame's time, without anything that moves; 0 = unknown.

    Returns
    -------
    states : ndarray of uint8, shape (N,)
        `TrueState` of each.

    """
    nearest = np.full(len(at.z), np.inf, np.float32)  # distance to the nearest surface
    front = np.full(len(at.z), np.inf, np.float32)  # depth of the frontmost surface
    height, width = static_depth_m.shape
    around = range(-_REACH_PX, _REACH_PX + 1)
    for down, right in product(around, around):
        row = np.clip(at.row + down, 0, height - 1)
        column = np.clip(at.column + right, 0, width - 1)
        depth = static_depth_m[row, column]
        depth = np.where(depth > 0, depth, np.float32(np.inf))
        nearest = np.minimum(nearest, np.abs(depth - at.z))
        front = np.minimum(front, depth)
    states = np.full(len(at.z), TrueState.UNKNOWN, np.uint8)
    states[at.inside & (at.z < front - _off(at.z)) & np.isfinite(front)] = TrueState.DYNAMIC
    states[at.inside & (nearest < near_surface(at.z))] = TrueState.STATIC
    return states


def near_surface(z: Array) -> Array:
    """Return how far from a surface, in metres, a Gaussian at depth z, [N], still lies on it."""
    return np.asarray(_NEAR_M + _NEAR_PER_M * z**2, np.float32)


def _off(z: Array) -> Array:
    return np.asarray(_OFF_M + _OFF_PER_M * z**2, np.float32)


@dataclass(frozen=True)
class Sight:
    """Which Gaussians a camera looks at, by the depth that it measured."""

    visible: Mask
    """[N] nothing nearer hides the place: the camera sees it, or through it"""
    met: Mask
    """[N] the camera measured a surface there"""


def sight(at: Projection, depth_m: DepthImage) -> Sight:
    """
    Tell which Gaussians are not hidden.

    Parameters
    ----------
    at : Projection
        Of N centres.
    depth_m : ndarray, shape (H, W)
        As measured, metres; where it is 0 nothing is known and nothing counts as seen.

    """
    measured = depth_m[at.row, at.column]
    beyond = measured - at.z
    tolerance = near_surface(at.z)
    known = at.inside & (measured > 0)
    visible = known & (beyond > -tolerance)
    return Sight(np.asarray(visible), np.asarray(visible & (beyond < tolerance)))
