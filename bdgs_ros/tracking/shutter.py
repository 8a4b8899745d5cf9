"""
Images as a camera would have taken them that exposes all rows at once.

A rolling shutter reads one row after the other. While the camera turns, what it shows is bent:
by 12 pixels between the middle and the rim when it turns by 90 degrees a second and reads out in
30 ms. Tracking takes that into account point by point (`align_numpy`); the map wants images.
"""

from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import ProbabilityImage, RgbdFrame

_LEAST_PX = 0.1  # smaller bends are left alone
_KNOT_PX = 16
_PASSES = 3  # a pixel's row is known only once the pixel is


def straightened(
    frame: RgbdFrame, p_dynamic: ProbabilityImage, sweep: NDArray[np.float64]
) -> tuple[RgbdFrame, ProbabilityImage]:
    """
    Return a frame and its mask as seen in the middle of the readout.

    Only the turning is undone: how far a point moves in the image when the camera moves along
    depends on its depth, and is less than a pixel at walking speed.

    Parameters
    ----------
    frame : RgbdFrame
        Rectified.
    p_dynamic : ndarray, shape (H, W), uint8
        P(dynamic) x 255 of it.
    sweep : ndarray, shape (6,)
        Motion of the camera from the first row's readout to the last's, (rho, phi), in its frame.

    """
    camera = frame.camera
    if 0.5 * max(camera.fx, camera.fy) * np.linalg.norm(sweep[3:]) < _LEAST_PX:
        return frame, p_dynamic
    u, v = _where_to_look(camera, sweep[3:])
    color = cv2.remap(frame.color, u, v, cv2.INTER_LINEAR)
    depth_m = cv2.remap(frame.depth_m, u, v, cv2.INTER_NEAREST)
    moving = cv2.remap(p_dynamic, u, v, cv2.INTER_NEAREST)
    new = replace(
        frame, color=np.asarray(color, np.uint8), depth_m=np.asarray(depth_m, np.float32)
    )
    return new, np.asarray(moving, np.uint8)


def _where_to_look(
    camera: PinholeCamera, turn: NDArray[np.float64]
) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """
    Return the pixel (u, v) of the rolling image for every pixel, each of shape (H, W).

    How far it lies from the pixel itself varies slowly, and is interpolated between knots.
    """
    columns, rows = _knots(camera.width), _knots(camera.height)
    x = (columns - camera.cx) / camera.fx
    y = ((rows - camera.cy) / camera.fy)[:, None]
    v = rows[:, None]
    for _ in range(_PASSES):
        share = (v + 0.5) / camera.height - 0.5
        z = 1 - share * (turn[0] * y - turn[1] * x)
        u = camera.fx * (x - share * (turn[1] - turn[2] * y)) / z + camera.cx
        v = camera.fy * (y - share * (turn[2] * x - turn[0])) / z + camera.cy
    down, across = _interpolation(rows, camera.height), _interpolation(columns, camera.width)
    u_off, v_off = (
        down @ off.astype(np.float32) @ across.T for off in (u - columns, v - rows[:, None])
    )
    u_off += np.arange(camera.width, dtype=np.float32)
    v_off += np.arange(camera.height, dtype=np.float32)[:, None]
    return u_off, v_off


def _knots(length: int) -> NDArray[np.float64]:
    """Return pixels from the first to the last, about `_KNOT_PX` apart."""
    return np.linspace(0, length - 1, 2 + (length - 1) // _KNOT_PX)


def _interpolation(knots: NDArray[np.float64], length: int) -> NDArray[np.float32]:
    """Return the matrix that interpolates values at knots linearly at all pixels, [L, K]."""
    pixels = np.arange(length)
    return np.array([np.interp(pixels, knots, one) for one in np.eye(len(knots))], np.float32).T
