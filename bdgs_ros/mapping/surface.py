"""The surface under each pixel of a depth image: inverse depth, normal, and whether it is flat."""

from __future__ import annotations

from dataclasses import dataclass
from importlib import import_module
from types import ModuleType

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import DepthImage

Array = NDArray[np.float32]
Double = NDArray[np.float64]
Mask = NDArray[np.bool_]

_kernels: ModuleType | None
try:
    _kernels = import_module('bdgs_ros._surface')
except ImportError:
    _kernels = None

_MIN_SHARE = 0.4  # of a window's pixels that must have a depth


@dataclass(frozen=True)
class Surface:
    """Planes through the pixels of one depth image, in its camera's frame."""

    normals: Array
    """[H, W, 3] of unit length, towards the camera; 0 where no plane fits"""
    inverse_depth: Array
    """[H, W] of the plane at the pixel where one fits, else as measured; 1/m, 0 = unknown"""
    flat: Mask
    """[H, W] whether a plane fits, and was asked for"""


def fit_surface(
    depth_m: DepthImage,
    usable: Mask,
    wanted: Mask,
    camera: PinholeCamera,
    largest: int,
    tolerance: Array,
) -> Surface:
    """
    Fit a plane around every wanted pixel, in the largest window in which one fits.

    A plane n.X = d has inverse depth 1/z = (n.r) / d at the ray r = (x, y, 1), which is affine
    in (x, y): an ordinary least-squares problem whose sums are box filters.

    Parameters
    ----------
    depth_m : ndarray, shape (H, W)
        Metres; 0 = unknown.
    usable : ndarray of bool, shape (H, W)
        Which pixels take part: not those on edges.
    wanted : ndarray of bool, shape (H, W)
        Which pixels planes are asked for.
    camera : PinholeCamera
        Of `depth_m`.
    largest : int
        Radius of the first windows in px; it is halved twice where no plane fits.
    tolerance : ndarray, shape (H, W)
        Root mean square distance in metres from the plane that still counts as flat.

    """
    usable = usable & (depth_m > 0)
    measured = np.where(usable, 1 / np.maximum(depth_m, 1e-3), 0).astype(np.float32)
    limit = np.asarray(tolerance * measured**2, np.float32)  # d(1/z) = dz / z^2
    radii = sorted({max(1, largest >> i) for i in range(3)}, reverse=True)
    fit = _fit_slowly if _kernels is None else _fit_natively
    return fit(measured, wanted, camera, radii, limit)


def _fit_natively(
    measured: Array, wanted: Mask, camera: PinholeCamera, radii: list[int], limit: Array
) -> Surface:
    assert _kernels is not None
    found = Surface(
        np.zeros((*measured.shape, 3), np.float32), measured.copy(), np.zeros(measured.shape, bool)
    )
    _kernels.fit_planes(
        *(measured, camera.rays(), limit, wanted, camera.fx, radii),
        *(found.normals, found.inverse_depth, found.flat),
    )
    return found


def _fit_slowly(
    measured: Array, wanted: Mask, camera: PinholeCamera, radii: list[int], limit: Array
) -> Surface:
    usable = measured > 0
    normals = np.zeros((*measured.shape, 3))
    inverse_depth = measured.copy()
    flat = np.zeros(measured.shape, bool)
    for radius in radii:
        plane, at_pixel, rms, share = _fit_window(measured, usable, camera, radius)
        fits = wanted & usable & ~flat & (share >= _MIN_SHARE) & (rms < limit)
        fits &= np.abs(at_pixel - measured) < 2 * limit
        normals[fits] = -np.stack(plane, axis=2)[fits]
        inverse_depth[fits] = at_pixel[fits]
        flat |= fits
    length = np.maximum(np.linalg.norm(normals, axis=2, keepdims=True), 1e-12)
    return Surface((normals / length).astype(np.float32), inverse_depth, flat)


def _fit_window(
    inverse_depth: Array, usable: Mask, camera: PinholeCamera, radius: int
) -> tuple[tuple[Double, Double, Double], Double, Double, Double]:
    """
    Fit 1/z = p.(x, y, 1) around every pixel.

    Returns, each of shape (H, W): the three of p; 1/z of the plane at the pixel; the root mean
    square residual in 1/m; the share of the window that took part.
    """
    x, y = cv2.split(camera.rays().astype(np.float64))[:2]
    w, q = usable.astype(np.float64), inverse_depth.astype(np.float64)
    wx, wy, wq = w * x, w * y, w * q
    terms = (w, wx, wy, wq, wx * x, wx * y, wy * y, wq * x, wq * y, wq * q)
    size = (2 * radius + 1, 2 * radius + 1)
    sums: list[Double] = [
        np.asarray(cv2.boxFilter(a, -1, size, borderType=cv2.BORDER_CONSTANT), np.float64)
        for a in terms
    ]
    share = sums[0]
    once = np.reciprocal(np.maximum(share, 1e-6))
    mx, my, mq, mxx, mxy, myy, mqx, mqy, mqq = (a * once for a in sums[1:])
    sxx, sxy, syy = mxx - mx * mx, mxy - mx * my, myy - my * my
    sqx, sqy, sqq = mqx - mq * mx, mqy - mq * my, mqq - mq * mq
    # A full window has this variance along each axis; far less means one direction is unseen.
    spread = radius * (radius + 1) / (3 * camera.fx**2)
    once = np.reciprocal(np.maximum(sxx * syy - sxy * sxy, (0.05 * spread) ** 2))
    a = (syy * sqx - sxy * sqy) * once
    b = (sxx * sqy - sxy * sqx) * once
    c = mq - a * mx - b * my
    residual = np.sqrt(np.maximum(sqq - a * sqx - b * sqy, 0.0), dtype=np.float64)
    return (a, b, c), a * x + b * y + c, residual, share
