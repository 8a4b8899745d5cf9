"""
How an image darkens towards its corners, learned from pairs of keyframes.

A wall that is bright in the middle of one image and dark at the rim of another cannot be one
colour in the map. The falloff is a property of the lens, so a few numbers hold for all images:
`falloff = exp(a rho^2 + b rho^4)` with rho the tangent of the angle to the optical axis, after
the even polynomials that lens calibration uses (Kannala and Brandt, 2006, for geometry; Engel et
al., "A photometrically calibrated benchmark for monocular visual odometry", 2016, for why).
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property, lru_cache
from typing import Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import ColorImage, DepthImage, Pose

Array = NDArray[np.float32]
Matrix = NDArray[np.float64]

_ROUNDS = 4  # of reweighting
_TOLERANCE = 0.05  # of log brightness: differences beyond count less
_SAME_SURFACE = 0.03  # of the depth
_DARK, _SATURATED = 0.05, 0.95  # outside, the sensor does not answer in proportion
_MIN_PIXELS, _MAX_PIXELS = 300, 4000
_PRIOR = 0.1  # information that there is no falloff
_KNOWN = 100.0  # information in a falloff that an earlier run found
_BRIGHTEST, _DARKEST = 0.1, -1.2  # of log falloff: no lens does more


class RgbdImage(Protocol):
    """What brightness is taken from; see `bdgs_ros.mapping.keyframes.Level`."""

    @property
    def camera(self) -> PinholeCamera:
        """Rectified."""

    @property
    def image(self) -> ColorImage:
        """Shape (H, W, 3)."""

    @property
    def depth_m(self) -> DepthImage:
        """Shape (H, W)."""

    @property
    def static(self) -> NDArray[np.bool_]:
        """Shape (H, W), False where something moves."""


class Vignette:
    """The falloff of one camera; starts as none and learns with each pair of images."""

    def __init__(self, a: float = 0.0, b: float = 0.0) -> None:
        self.coefficients = (a, b)
        known = _KNOWN if a or b else _PRIOR
        self._information = known * np.eye(2)
        self._evidence = self._information @ np.array([a, b])

    def falloff(self, camera: PinholeCamera) -> Array:
        """Return the share of light that reaches each pixel, [H, W], 1 on the optical axis."""
        return _falloff(camera, self.coefficients)

    def scale(self, camera: PinholeCamera) -> Array:
        """Return what brings eight-bit colours to [0, 1] without falloff, [H, W, 3]."""
        return _scale(camera, self.coefficients)

    def learn(self, one: Photo, other: Photo) -> None:
        """Take the brightness of what two images both show; changes `coefficients`."""
        found = _compare(one, other)
        if found is None:
            return
        information, evidence = found
        self._information += information
        self._evidence += evidence
        a, b = np.linalg.solve(self._information, self._evidence)
        self.coefficients = (float(a), float(b))


@dataclass(frozen=True)
class Photo:
    """An image with depth and pose, as brightness is compared."""

    camera: PinholeCamera
    brightness: Array
    """[H, W] in [0, 1]"""
    depth_m: DepthImage
    usable: NDArray[np.bool_]
    """[H, W]"""
    T_world_camera: Pose

    @classmethod
    def of(cls, image: RgbdImage, T_world_camera: Pose) -> Photo:
        """Take an image apart; what moves, is too dark or too bright is not used."""
        channels = cv2.split(image.image)  # numpy is slow over a last axis of three
        usable = np.minimum.reduce(channels) > 255 * _DARK
        usable &= np.maximum.reduce(channels) < 255 * _SATURATED
        return cls(
            image.camera,
            np.add.reduce(channels, dtype=np.float32) / np.float32(3 * 255),
            image.depth_m,
            image.static & usable & (image.depth_m > 0),
            T_world_camera,
        )

    @cached_property
    def samples(self) -> tuple[NDArray[np.int64], Array]:
        """Some usable pixels (v, u), [n, 2], and their points in the camera's frame, [n, 3]."""
        chosen = np.flatnonzero(self.usable)
        at = np.unravel_index(chosen[:: 1 + len(chosen) // _MAX_PIXELS], self.usable.shape)
        return np.stack(at, axis=1), self.depth_m[at][:, None] * self.camera.rays()[at]


@lru_cache(maxsize=16)
def _falloff(camera: PinholeCamera, coefficients: tuple[float, float]) -> Array:
    x = (np.arange(camera.width) - camera.cx) / camera.fx
    y = (np.arange(camera.height) - camera.cy) / camera.fy
    rho2 = ((y * y)[:, None] + x * x).astype(np.float32)
    a, b = (np.float32(value) for value in coefficients)
    image: Array = np.exp(np.clip((a + b * rho2) * rho2, _DARKEST, _BRIGHTEST))
    image.setflags(write=False)
    return image


@lru_cache(maxsize=8)
def _scale(camera: PinholeCamera, coefficients: tuple[float, float]) -> Array:
    # three channels, because numpy broadcasts over a last axis of three seven times slower
    scale = np.float32(1 / 255) / _falloff(camera, coefficients)
    image: Array = np.repeat(scale[..., None], 3, axis=2)
    image.setflags(write=False)
    return image


def _compare(one: Photo, other: Photo) -> tuple[Matrix, Matrix] | None:
    """
    Return information matrix and vector of (a, b) per pixel of a pair; None if too little shows.

    The difference of log brightness is that of the falloffs plus that of the exposures, which
    is one number for the pair and drops out when means are taken off.
    """
    pixel, rays = _correspondences(one, other)
    if len(pixel) < _MIN_PIXELS:
        return None
    bright = one.brightness[tuple(rays.T)], _sample(other.brightness, pixel)
    difference = np.log(bright[0]) - np.log(bright[1])
    rho2 = _rho2(one.camera, rays[:, ::-1]), _rho2(other.camera, pixel)
    design = np.stack([rho2[0] - rho2[1], rho2[0] ** 2 - rho2[1] ** 2], axis=1)
    weight = np.ones(len(difference))
    solution = np.zeros(2)
    for _ in range(_ROUNDS):
        share = weight / weight.sum()
        X, y = design - share @ design, difference - share @ difference
        information = (X * share[:, None]).T @ X
        solution = np.linalg.solve(information + 1e-6 * np.eye(2), X.T @ (share * y))
        weight = 1 / (1 + ((y - X @ solution) / _TOLERANCE) ** 2)
    noise = _TOLERANCE**2
    return information / noise, X.T @ (share * y) / noise


def _correspondences(one: Photo, other: Photo) -> tuple[Matrix, NDArray[np.int64]]:
    """Return where pixels of `one` lie in `other`, [n, 2] (u, v), and which they are (v, u)."""
    index, points_one = one.samples
    T_other_one = np.linalg.inv(other.T_world_camera) @ one.T_world_camera
    points = points_one @ T_other_one[:3, :3].T + T_other_one[:3, 3]
    front = points[:, 2] > 0.1
    points, index = points[front], index[front]
    pixel = other.camera.project(points)
    height, width = other.camera.shape
    inside = ((pixel > 0) & (pixel < [width - 1, height - 1])).all(axis=1)
    pixel, points, index = pixel[inside], points[inside], index[inside]
    nearest = np.rint(pixel).astype(np.int64)
    depth = other.depth_m[nearest[:, 1], nearest[:, 0]]
    same = np.abs(depth - points[:, 2]) < _SAME_SURFACE * points[:, 2]
    same &= other.usable[nearest[:, 1], nearest[:, 0]]
    return pixel[same], index[same]


def _sample(image: Array, pixel: Matrix) -> Matrix:
    at = pixel.astype(np.float32)
    sampled = cv2.remap(image, at[:, None, 0], at[:, None, 1], cv2.INTER_LINEAR)
    return np.maximum(np.asarray(sampled[:, 0], np.float64), 1e-3)


def _rho2(camera: PinholeCamera, pixel: NDArray[np.floating | np.integer]) -> Matrix:
    return np.asarray((camera.tangents(pixel) ** 2).sum(axis=1))
