"""
Image pyramids for alignment, in readable form; `src/aligner.cpp` builds the same ones.

Depth is kept as its inverse: the noise of structured light and stereo (sigma_z = k z^2) is then
the same everywhere, and planes are linear in the image, so that averaging and interpolation are
exact on them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Plane = NDArray[np.float32]

_NEAREST_M = 0.05
_FARTHEST_M = 100.0


@dataclass(frozen=True)
class Level:
    """One resolution of an image; planes have shape (height, width)."""

    width: int
    height: int
    intrinsics: tuple[float, float, float, float]
    """fx fy cx cy, pixels."""
    grey: Plane
    gx: Plane
    gy: Plane
    inverse_depth: Plane
    """1/m, 0 = invalid."""
    smooth: Plane
    """Inverse depth where its 3x3 window is one surface, else 0."""
    dx: Plane
    dy: Plane
    p_static: Plane


@dataclass(frozen=True)
class Pyramid:
    """Levels, finest first."""

    levels: tuple[Level, ...]
    block: int
    sweep: NDArray[np.float64]
    """Shape (6,): motion of the camera while the image was read out, (rho, phi), its frame."""

    def __len__(self) -> int:
        """Return the number of levels."""
        return len(self.levels)

    def level(self, index: int) -> Level:
        """Return one level, 0 the finest."""
        return self.levels[index]


def build_pyramid(
    image: NDArray[np.uint8],
    depth_m: Plane,
    p_dynamic: NDArray[np.uint8] | None,
    width: int,
    height: int,
    fx: float,
    fy: float,
    cx: float,
    cy: float,
    block: int,
    n_levels: int,
    depth_noise: float,
    sweep: NDArray[np.float64],
) -> Pyramid:
    """
    Build all levels of one image; the finest averages `block` x `block` input pixels.

    Parameters
    ----------
    image : ndarray, shape (height, width) or (height, width, 3), uint8
        Grey or RGB.
    depth_m : ndarray, shape (height, width), float32
        Metres; 0 or NaN = invalid.
    p_dynamic : ndarray, shape (height, width), uint8, optional
        P(dynamic) x 255.
    width, height, fx, fy, cx, cy
        The camera of the input.
    block : int
        Power of two.
    n_levels : int
        Each half as wide as the one before.
    depth_noise : float
        Standard deviation of inverse depth, 1/m.
    sweep : ndarray, shape (6,)
        Motion of the camera from the first row's readout to the last's, (rho, phi).

    """
    grey = _average(_to_grey(image), block)
    inverse_depth = _invert(depth_m)
    static = _static(p_dynamic, (height, width), block)
    for _ in range(block.bit_length() - 1):
        inverse_depth = _halve_depth(inverse_depth, depth_noise)
    levels = []
    for index in range(n_levels):
        if index > 0:
            grey, static = _average(grey, 2), _average(static, 2)
            inverse_depth = _halve_depth(inverse_depth, depth_noise)
        scale = 1.0 / (block * 2**index)
        camera = (fx * scale, fy * scale, (cx + 0.5) * scale - 0.5, (cy + 0.5) * scale - 0.5)
        levels.append(_make_level(grey, inverse_depth, static, camera, depth_noise))
    return Pyramid(tuple(levels), block, np.asarray(sweep, np.float64))


def with_dynamic(
    pyramid: Pyramid,
    p_dynamic: NDArray[np.uint8],
    width: int,
    height: int,
    sweep: NDArray[np.float64],
) -> Pyramid:
    """Return the same images with another mask and another motion during the readout."""
    static = _static(p_dynamic, (height, width), pyramid.block)
    levels = []
    for index, level in enumerate(pyramid.levels):
        static = static if index == 0 else _average(static, 2)
        levels.append(Level(**{**level.__dict__, 'p_static': static}))
    return Pyramid(tuple(levels), pyramid.block, np.asarray(sweep, np.float64))


def _to_grey(image: NDArray[np.uint8]) -> Plane:
    values = image.astype(np.float32) / 255.0
    if values.ndim == 3:
        values = values @ np.array([0.299, 0.587, 0.114], np.float32)
    return values


def _static(p_dynamic: NDArray[np.uint8] | None, shape: tuple[int, int], block: int) -> Plane:
    if p_dynamic is None:
        return _average(np.ones(shape, np.float32), block)
    return 1.0 - _average(p_dynamic.astype(np.float32) / 255.0, block)


def _invert(depth_m: Plane) -> Plane:
    good = (depth_m > _NEAREST_M) & (depth_m < _FARTHEST_M)
    return np.where(good, 1.0 / np.where(good, depth_m, 1.0), 0.0).astype(np.float32)


def _blocks(plane: Plane, k: int) -> Plane:
    """Group k x k pixels, shape (height // k, width // k, k * k); the odd rest is cut."""
    h, w = plane.shape[0] // k, plane.shape[1] // k
    grouped = plane[: h * k, : w * k].reshape(h, k, w, k).transpose(0, 2, 1, 3)
    return grouped.reshape(h, w, k * k)


def _average(plane: Plane, k: int) -> Plane:
    return np.asarray(_blocks(plane, k).mean(axis=2, dtype=np.float32))


def discontinuity(inverse_depth: Plane, depth_noise: float) -> Plane:
    """Return the step of inverse depth, in 1/m, that parts two surfaces."""
    return np.float32(0.03) * inverse_depth + np.float32(4.0 * depth_noise)


def _halve_depth(inverse_depth: Plane, depth_noise: float) -> Plane:
    """Average what lies on the nearest surface of 2 x 2 pixels, so that no depths are mixed."""
    four = _blocks(inverse_depth, 2)
    top = four.max(axis=2, keepdims=True)
    same = four >= np.maximum(top - discontinuity(top, depth_noise), 1e-6)
    mean = (four * same).sum(axis=2) / np.maximum(same.sum(axis=2), 1)
    return np.asarray(mean, np.float32)


def _make_level(
    grey: Plane,
    inverse_depth: Plane,
    p_static: Plane,
    intrinsics: tuple[float, float, float, float],
    depth_noise: float,
) -> Level:
    height, width = grey.shape
    gx, gy = np.zeros_like(grey), np.zeros_like(grey)
    gx[1:-1, 1:-1] = 0.5 * (grey[1:-1, 2:] - grey[1:-1, :-2])
    gy[1:-1, 1:-1] = 0.5 * (grey[2:, 1:-1] - grey[:-2, 1:-1])
    smooth, dx, dy = _depth_gradient(inverse_depth, depth_noise)
    return Level(width, height, intrinsics, grey, gx, gy, inverse_depth, smooth, dx, dy, p_static)


def _depth_gradient(inverse_depth: Plane, depth_noise: float) -> tuple[Plane, Plane, Plane]:
    """Return inverse depth where a 3x3 window is one surface, and its Sobel gradient there."""
    h, w = inverse_depth.shape
    window = np.stack(
        [inverse_depth[j : h - 2 + j, i : w - 2 + i] for j in range(3) for i in range(3)]
    )
    low, top, centre = window.min(axis=0), window.max(axis=0), window[4]
    one = (low > 0) & (top - low < 2 * discontinuity(centre, depth_noise))
    a, b, c, d, _, f, g, m, n = window
    planes = [np.zeros_like(inverse_depth) for _ in range(3)]
    planes[0][1:-1, 1:-1] = one * centre
    planes[1][1:-1, 1:-1] = one * 0.125 * (c - a + 2 * (f - d) + n - g)
    planes[2][1:-1, 1:-1] = one * 0.125 * (g - a + 2 * (m - b) + n - c)
    return planes[0], planes[1], planes[2]
