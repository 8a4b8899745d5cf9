"""
Register one depth image to another by depth alone: the last centimetre before they are compared.

The comparison of the geometric prior is between depths, so the pose that matters is the one in
which the depths agree. Odometry from colour is not quite that: it drifts, and many cameras take
depth some milliseconds before or after colour, which is several pixels when the camera turns
fast. Where depth leaves the pose open (sliding along a wall) the comparison does not care either;
there the odometry's pose is kept.

Residuals are in inverse depth, in which planes are affine over the image and the noise of a
structured-light camera is the same everywhere.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import DepthImage, Pose

Floats = NDArray[np.float32]

_KERNEL = np.ones((3, 3), np.uint8)
_EDGE = 0.06  # relative change of inverse depth over three pixels that is no surface any more
_PRIOR_SIGMA = np.array([0.03, 0.03, 0.03, 0.03, 0.03, 0.03])  # of the odometry, m and rad
_SCALES = (8.0, 4.0, 3.0)  # of the robust kernel, in sigma, one per iteration
_POINT_SHARE = 0.2  # points count as if this share of them were independent


@dataclass(frozen=True)
class InverseDepth:
    """An inverse depth image that others can be registered to; `value` 0 where unusable."""

    camera: PinholeCamera
    value: Floats
    gradient_u: Floats
    gradient_v: Floats

    @classmethod
    def of(cls, depth_m: DepthImage, camera: PinholeCamera) -> InverseDepth:
        """Differentiate a depth image, shape (h, w); edges and holes become unusable."""
        with np.errstate(divide='ignore'):
            value = np.where(depth_m > 0, 1.0 / depth_m, 0).astype(np.float32)
        high, low = cv2.dilate(value, _KERNEL), cv2.erode(value, _KERNEL)
        smooth = (low > 0) & (high - low < _EDGE * value)
        gradient_u = cv2.Sobel(value, cv2.CV_32F, 1, 0, scale=1 / 8)
        gradient_v = cv2.Sobel(value, cv2.CV_32F, 0, 1, scale=1 / 8)
        usable = np.where(smooth, value, 0)
        return cls(camera, usable, np.asarray(gradient_u), np.asarray(gradient_v))


def align_depth(
    points_camera: Floats, reference: InverseDepth, T_ref_camera: Pose, depth_noise: float
) -> Pose:
    """
    Refine a pose so that points lie on the surfaces of an earlier depth image.

    Parameters
    ----------
    points_camera : ndarray, shape (N, 3), float32
        Points of the current frame in metres, z > 0.
    reference : InverseDepth
        Of the earlier frame.
    T_ref_camera : ndarray, shape (4, 4)
        From odometry.
    depth_noise : float
        sigma_z = depth_noise z^2, which is sigma of inverse depth in 1/m.

    Returns
    -------
    T_ref_camera : ndarray, shape (4, 4)
        Gauss-Newton with Geman-McClure weights, held to the start by the odometry's uncertainty.

    """
    pose, way = T_ref_camera, np.zeros(6)
    information = np.diag(_PRIOR_SIGMA**-2.0)
    for scale in _SCALES:
        residual, jacobian = _linearise(points_camera, reference, pose)
        sigma = scale * depth_noise
        weight = _POINT_SHARE / depth_noise**2 / (1.0 + (residual / sigma) ** 2) ** 2
        weighted = jacobian * weight[:, None]
        hessian = (weighted.T @ jacobian).astype(np.float64) + information
        slope = (weighted.T @ residual).astype(np.float64)
        step = np.asarray(-np.linalg.solve(hessian, slope + information @ way), np.float64)
        pose, way = se3.exp(step) @ pose, way + step  # small motions add up
    return pose


def _linearise(points: Floats, reference: InverseDepth, pose: Pose) -> tuple[Floats, Floats]:
    """Return residuals (K,) and Jacobians (K, 6) by a left perturbation of the points in view."""
    camera = reference.camera
    moved = points @ pose[:3, :3].T.astype(np.float32) + pose[:3, 3].astype(np.float32)
    inverse_z = 1.0 / np.maximum(moved[:, 2], 0.05)
    u = camera.fx * moved[:, 0] * inverse_z + camera.cx
    v = camera.fy * moved[:, 1] * inverse_z + camera.cy
    column, row = np.rint(u).astype(np.intp), np.rint(v).astype(np.intp)
    inside = (column >= 0) & (column < camera.width) & (row >= 0) & (row < camera.height)
    index = np.where(inside, row * camera.width + column, 0)
    keep = inside & (reference.value.ravel()[index] > 0) & (moved[:, 2] > 0.1)
    index, moved, inverse_z = index[keep], moved[keep], inverse_z[keep]
    du, dv = reference.gradient_u.ravel()[index], reference.gradient_v.ravel()[index]
    # The nearest pixel plus its gradient: bilinear would mix surfaces.
    seen = reference.value.ravel()[index] + du * (u[keep] - column[keep])
    seen += dv * (v[keep] - row[keep])
    x, y, z = moved.T
    jacobian = np.empty((len(moved), 6), np.float32)
    a, b = du * camera.fx * inverse_z, dv * camera.fy * inverse_z
    c = (inverse_z - a * x - b * y) * inverse_z
    jacobian[:, 0], jacobian[:, 1], jacobian[:, 2] = a, b, c
    jacobian[:, 3], jacobian[:, 4], jacobian[:, 5] = y * c - z * b, z * a - x * c, x * b - y * a
    return np.asarray(seen - inverse_z, np.float32), jacobian
