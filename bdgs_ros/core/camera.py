"""The pinhole camera: intrinsics, projection, scaling and rectification."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.errors import DatasetError

PLUMB_BOB, RATIONAL, FISHEYE = 'plumb_bob', 'rational_polynomial', 'equidistant'
DISTORTIONS = {PLUMB_BOB: (4, 5), RATIONAL: (8, 12, 14), FISHEYE: (4,)}
"""
How many coefficients each model may have: k1 k2 p1 p2 k3, then k4 k5 k6 and those of a thin prism
and a tilted sensor, as OpenCV orders them; k1 to k4 of `cv2.fisheye`.
"""


_OUTSIDE = -1.0  # of any image


@dataclass(frozen=True)
class PinholeCamera:
    """
    Intrinsics at one resolution.

    The centre of the top left pixel has image coordinates (0, 0), as in OpenCV and ROS.
    `distortion` is what the model of that name has in ROS, see `DISTORTIONS`; all zero for a
    rectified image.
    """

    width: int
    height: int
    fx: float
    fy: float
    cx: float
    cy: float
    distortion: tuple[float, ...] = (0.0, 0.0, 0.0, 0.0, 0.0)
    distortion_model: str = PLUMB_BOB

    @property
    def matrix(self) -> NDArray[np.float64]:
        """The intrinsic matrix, shape (3, 3)."""
        return np.array([[self.fx, 0, self.cx], [0, self.fy, self.cy], [0, 0, 1.0]])

    @property
    def shape(self) -> tuple[int, int]:
        """The image shape (H, W)."""
        return self.height, self.width

    @property
    def is_rectified(self) -> bool:
        """Whether the image has no lens distortion left."""
        return not any(self.distortion)

    def rectified(self) -> PinholeCamera:
        """Return the same camera without distortion."""
        return replace(self, distortion=(0.0,) * 5, distortion_model=PLUMB_BOB)

    def scaled(self, factor: float) -> PinholeCamera:
        """Return the camera of the image resized by `factor`; pixel areas, not centres, scale."""
        return replace(
            self,
            width=round(self.width * factor),
            height=round(self.height * factor),
            fx=self.fx * factor,
            fy=self.fy * factor,
            cx=(self.cx + 0.5) * factor - 0.5,
            cy=(self.cy + 0.5) * factor - 0.5,
        )

    def rays(self) -> NDArray[np.float32]:
        """Return the viewing rays with z = 1, shape (H, W, 3)."""
        return _rays(self)

    def unproject(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """
        Lift a depth image to points in the camera's optical frame.

        Parameters
        ----------
        depth_m : ndarray, shape (H, W), float32
            Depth along z in metres; 0 where invalid.

        Returns
        -------
        points_camera : ndarray, shape (H, W, 3), float32
            Metres; (0, 0, 0) where depth is invalid.

        Raises
        ------
        ValueError
            If `depth_m` does not have the camera's height and width.

        """
        if depth_m.shape != self.shape:
            raise ValueError(f'depth_m: expected shape {self.shape}, received {depth_m.shape}')
        return self.rays() * depth_m[..., None]

    def tangents(self, pixels: NDArray[np.floating | np.integer]) -> NDArray[np.float64]:
        """Return (x, y) of the viewing rays with z = 1 through pixels (u, v), shape (N, 2)."""
        return (pixels - [self.cx, self.cy]) / [self.fx, self.fy]

    def project(self, points_camera: NDArray[np.floating]) -> NDArray[np.float64]:
        """Project points, shape (N, 3), with z > 0 to image coordinates (u, v), shape (N, 2)."""
        z = points_camera[:, 2]
        u = self.fx * points_camera[:, 0] / z + self.cx
        v = self.fy * points_camera[:, 1] / z + self.cy
        return np.stack([u, v], axis=1)


@lru_cache(maxsize=16)
def _rays(camera: PinholeCamera) -> NDArray[np.float32]:
    u = (np.arange(camera.width) - camera.cx) / camera.fx
    v = (np.arange(camera.height) - camera.cy) / camera.fy
    uu, vv = np.meshgrid(u, v)
    rays = np.stack([uu, vv, np.ones_like(uu)], axis=-1).astype(np.float32)
    rays.setflags(write=False)
    return rays


def _look_up(camera: PinholeCamera, kind: int) -> tuple[NDArray[Any], NDArray[Any]]:
    """Return where in the distorted image each pixel of the rectified one is, as OpenCV does."""
    size, matrix = (camera.width, camera.height), camera.matrix
    is_fisheye = camera.distortion_model == FISHEYE
    make = cv2.fisheye.initUndistortRectifyMap if is_fisheye else cv2.initUndistortRectifyMap
    return make(matrix, np.array(camera.distortion), np.eye(3), matrix, size, kind)


class Rectifier:
    """
    Remove lens distortion from colour (bilinear) and depth (nearest, so no depths are mixed).

    Both images must come from one camera: depth registered to colour, as TUM, BONN and the usual
    ROS drivers publish it.
    """

    def __init__(self, camera: PinholeCamera) -> None:
        self._source = camera
        self.camera = camera.rectified()
        self._maps = None if camera.is_rectified else self._build_maps()

    def _build_maps(self) -> tuple[NDArray[np.int16], NDArray[np.uint16], NDArray[np.int16]]:
        fixed, fraction = _look_up(self._source, cv2.CV_16SC2)
        nearest = np.stack(_look_up(self._source, cv2.CV_32FC1), axis=-1)
        return (
            np.asarray(fixed, dtype=np.int16),
            np.asarray(fraction, dtype=np.uint16),
            np.rint(np.clip(np.nan_to_num(nearest, nan=_OUTSIDE), _OUTSIDE, 1 << 14)).astype(
                np.int16
            ),
        )

    def color(self, image: NDArray[np.uint8]) -> NDArray[np.uint8]:
        """Rectify a colour image, shape (H, W, 3)."""
        self._check('color', image.shape[:2])
        if self._maps is None:
            return image
        fixed, fraction, _ = self._maps
        return np.asarray(
            cv2.remap(image, fixed, fraction, cv2.INTER_LINEAR, borderMode=cv2.BORDER_REPLICATE),
            dtype=np.uint8,
        )

    def depth(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        """Rectify a depth image, shape (H, W); 0 where the source has no pixel."""
        self._check('depth', depth_m.shape)
        if self._maps is None:
            return depth_m
        empty = np.empty((0, 0), np.uint16)
        return np.asarray(
            cv2.remap(depth_m, self._maps[2], empty, cv2.INTER_NEAREST), dtype=np.float32
        )

    def _check(self, name: str, shape: tuple[int, ...]) -> None:
        if shape != self._source.shape:
            raise DatasetError(
                f'{name} image has shape {shape}, but the camera says {self._source.shape}; '
                'check camera_info or camera.yaml'
            )
