"""Where Gaussians are added."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.config.mapping import InsertConfig
from bdgs_ros.core.types import DepthImage
from bdgs_ros.mapping.rasterize import Rendered

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]


def far_from_movers(static: Mask, config: InsertConfig) -> Mask:
    """Return the pixels that keep a margin from all that moves, [H, W]."""
    moving = (~static).astype(np.uint8)
    reach = 2 * config.margin_px + 1
    return np.asarray(cv2.dilate(moving, np.ones((reach, reach), np.uint8)) == 0)


def usable_depth(depth_m: DepthImage, config: InsertConfig) -> Mask:
    """
    Return the pixels with a depth in range and off edges, [H, W].

    On edges the sensor mixes two surfaces.
    """
    in_range = (depth_m > config.min_depth) & (depth_m < config.max_depth)
    return in_range & ~depth_edges(depth_m, config.edge)


def depth_edges(depth_m: DepthImage, relative: float) -> Mask:
    """Return pixels whose 3x3 neighbourhood spans more than `relative` times their depth."""
    kernel = np.ones((3, 3), np.uint8)
    far = cv2.dilate(depth_m, kernel)
    near = cv2.erode(np.where(depth_m > 0, depth_m, np.float32(np.inf)), kernel)
    return np.asarray((depth_m > 0) & (far - near > relative * depth_m))


def empty_pixels(static: Rendered, config: InsertConfig) -> Mask:
    """Return where the static map shows next to nothing, [H, W]."""
    return np.asarray(static.silhouette < config.silhouette)


def pixels_in_front(depth_m: DepthImage, static: Rendered, sigma: Array, count: float) -> Mask:
    """
    Return where the camera sees something nearer than the static map, [H, W].

    Parameters
    ----------
    depth_m : ndarray, shape (H, W)
        Measured, metres.
    static : Rendered
        The static map.
    sigma : ndarray, shape (H, W)
        Standard deviation of the measured depth.
    count : float
        How many sigma count as nearer.

    """
    nearer = (depth_m > 0) & (surface_depth(static) - depth_m > count * sigma)
    return np.asarray(nearer & (static.silhouette > 0.5))


def explained(depth_m: DepthImage, everything: Rendered, sigma: Array, count: float) -> Mask:
    """Return where some Gaussian, hidden or not, already lies at the measured depth, [H, W]."""
    close = np.abs(surface_depth(everything) - depth_m) < count * sigma
    return np.asarray(close & (everything.silhouette > 0.5))


def surface_depth(rendered: Rendered) -> DepthImage:
    """Return rendered depth over silhouette, metres; 0 where the map is empty."""
    safe = np.maximum(rendered.silhouette, 1e-6)
    return np.where(rendered.silhouette > 1e-3, rendered.depth / safe, 0).astype(np.float32)
