"""Small operations on images and masks that several stages need."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.types import DepthImage, Labels, ProbabilityImage, RgbdFrame

Mask = NDArray[np.bool_]

_SAME_SURFACE = 0.03  # of the depth


def metres(counts: NDArray[np.uint16], per_metre: float) -> DepthImage:
    """
    Return the depth that 16-bit counts stand for; 0, and the largest count, are no depth.

    Some drivers write the largest value of the type where they saw nothing (librealsense
    issue 3508): as a depth it would be a wall 65 m away.
    """
    depth_m = counts.astype(np.float32) / np.float32(per_metre)
    depth_m[counts == np.iinfo(np.uint16).max] = 0
    return depth_m


def without_specks(mask: Mask, share: float) -> Mask:
    """Drop connected components smaller than `share` of the image, mask of shape (H, W)."""
    if np.count_nonzero(mask) < share * mask.size:
        return np.zeros_like(mask)
    _, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    large = stats[:, cv2.CC_STAT_AREA] >= share * mask.size
    large[0] = False
    return np.asarray(large[labels])


def opened(mask: Mask, size: int = 3) -> Mask:
    """Remove structures thinner than `size` pixels: the rims that small pose errors leave."""
    kernel = np.ones((size, size), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0)


def thinned(image: NDArray[Any]) -> NDArray[Any]:
    """Return every fourth row and column: to tell a share needs no more."""
    return image[::4, ::4]


def halved(frame: RgbdFrame, width: int) -> RgbdFrame:
    """
    Halve a frame as often as that leaves at least `width` columns.

    A camera of 1280 columns costs tracking and the back end no more than one of 640 then.
    """
    factor = 1
    while frame.camera.width >= 2 * factor * width:
        factor *= 2
    return frame if factor == 1 else shrink_frame(frame, frame.camera.width // factor)


def fitted(labels: Labels, frame: RgbdFrame) -> Labels:
    """Return labels at the size of a frame that was halved."""
    if labels.p_dynamic.shape == frame.camera.shape:
        return labels
    return replace(labels, p_dynamic=shrink_labels(labels.p_dynamic, frame.camera.shape))


def shrink_frame(frame: RgbdFrame, width: int) -> RgbdFrame:
    """Bring a frame to a width that is not larger: colour averaged, depth per surface."""
    camera = frame.camera.scaled(width / frame.camera.width)
    size = (camera.width, camera.height)
    color = cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA)
    depth_m = sample_depth(frame.depth_m, camera.shape)
    return RgbdFrame(
        frame.stamp_ns, np.asarray(color, np.uint8), depth_m, camera, frame.depth_delay_ns
    )


def shrink_labels(p_dynamic: ProbabilityImage, shape: tuple[int, int]) -> ProbabilityImage:
    """Bring labels to a shape that is not larger: the maximum counts, or small movers get lost."""
    ratio = max(1, round(p_dynamic.shape[1] / shape[1]))
    spread = cv2.dilate(p_dynamic, np.ones((ratio, ratio), np.uint8))
    small = cv2.resize(spread, shape[::-1], interpolation=cv2.INTER_NEAREST)
    return np.asarray(small, np.uint8)


def sample_depth(depth_m: DepthImage, shape: tuple[int, int]) -> DepthImage:
    """
    Shrink a depth image without mixing surfaces and without bias.

    Each block gives the mean of its valid depths that lie on the surface of their lower median.
    A single one of them would do for edges, but is off by half a pixel on slanted surfaces.
    """
    blocks = _blocks(depth_m, shape)
    median = _lower_median(blocks) if len(blocks) != 4 else _lower_median_of_four(blocks)
    same = (blocks > 0) & (np.abs(blocks - median) <= _SAME_SURFACE * median)
    count = np.maximum(np.count_nonzero(same, axis=0), 1)
    return np.asarray((blocks * same).sum(axis=0) / count, np.float32)


def _blocks(depth_m: DepthImage, shape: tuple[int, int]) -> DepthImage:
    """Return the pixels about the centre of each pixel of the smaller image, [B, H, W]."""
    rows, columns = (
        _block_indices(large, small) for large, small in zip(depth_m.shape, shape, strict=True)
    )
    down, right = len(rows), len(columns)
    if depth_m.shape == (down * shape[0], right * shape[1]):  # slices do, and are faster
        parts = [depth_m[i::down, j::right] for i in range(down) for j in range(right)]
    else:
        parts = [depth_m[np.ix_(row, column)] for row in rows for column in columns]
    return np.stack(parts)


def _block_indices(large: int, small: int) -> NDArray[np.intp]:
    """Return along one axis which pixels lie about the centre of each wider one, [b, small]."""
    ratio = large / small
    count = max(1, round(ratio))
    first = np.rint((np.arange(small) + 0.5) * ratio - count / 2).astype(np.intp)
    first = np.clip(first, 0, large - count)
    return np.asarray(first + np.arange(count)[:, None], np.intp)


def _lower_median(blocks: DepthImage) -> DepthImage:
    """Return the lower median of the valid depths of each block, [B, H, W] to [H, W]."""
    ordered = np.sort(blocks, axis=0)
    valid = np.count_nonzero(blocks, axis=0)
    middle = len(blocks) - valid + np.maximum(valid - 1, 0) // 2
    rank = np.minimum(middle, len(blocks) - 1)[None]
    return np.asarray(np.take_along_axis(ordered, rank, 0)[0])


def _lower_median_of_four(blocks: DepthImage) -> DepthImage:
    """Do as `_lower_median` with the five comparisons that sort four numbers: ten times faster."""
    a, b, c, d = blocks
    low, high = np.minimum(a, b), np.maximum(a, b)
    low2, high2 = np.minimum(c, d), np.maximum(c, d)
    least, most = np.minimum(low, low2), np.maximum(high, high2)
    inner = np.maximum(low, low2), np.minimum(high, high2)
    second, third = np.minimum(*inner), np.maximum(*inner)
    return np.asarray(np.where(least > 0, second, np.where(third > 0, third, most)))
