"""
Boxes cut to the objects in them with depth.

A box around a person shows mostly what is behind the person. The person is the depth layer that
fills the middle of the box and is rarer just outside of it; contrast of the two depth histograms
finds that layer, also when another person or a chair stands before it. The layer's pixels in the
box are the object; holes in the depth close to it belong to it too (a person nearer than half a
metre has no depth at all to a structured-light camera).
"""

from __future__ import annotations

from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.config.detection import CutConfig
from bdgs_ros.core.types import DepthImage, Detection, ProbabilityImage

Mask = NDArray[np.uint8]  # 0 or 1
Bins = NDArray[np.uint8]  # depth bin per pixel, 0 = no depth
Box = tuple[int, int, int, int]  # x0 y0 x1 y1, integer pixels of the coarse grid

_BINS = 96
_NEAREST_M, _FARTHEST_M = 0.25, 12.0
_BIN_RATIO = np.log(_FARTHEST_M / _NEAREST_M) / (_BINS - 2)
_BIN_DEPTH_M = _NEAREST_M * np.exp((np.arange(_BINS) - 0.5) * _BIN_RATIO)
_SMOOTHING = np.array([1, 2, 3, 2, 1]) / 9.0
_MIN_DEPTH_SHARE = 0.08  # less valid depth in the middle of a box: no layer can be found


def depth_bins(depth_m: DepthImage) -> Bins:
    """Return the logarithmic depth bin of every pixel, 1 to 95; 0 where depth is invalid."""
    with np.errstate(divide='ignore'):
        value = np.log(depth_m * (1.0 / _NEAREST_M)) * (1.0 / _BIN_RATIO) + 1.0
    return np.asarray(np.where(depth_m > 0, np.clip(value, 1, _BINS - 1), 0), dtype=np.uint8)


def dynamic_prior_image(
    detections: Sequence[Detection], depth_m: DepthImage, config: CutConfig
) -> ProbabilityImage:
    """
    Paint each detection's P(dynamic) over the pixels of its object.

    Parameters
    ----------
    detections : sequence of Detection
        In pixels of the depth image.
    depth_m : ndarray, shape (H, W), float32
        Metres, 0 where invalid.
    config : CutConfig
        How boxes are cut.

    Returns
    -------
    p_dynamic : ndarray, shape (H, W), uint8
        P x 255; 0 where there is no object. Objects that overlap: the larger value.

    """
    movers = [d for d in detections if d.p_dynamic > 0]
    if not movers:
        return np.zeros(depth_m.shape, np.uint8)
    step = config.stride
    bins = depth_bins(depth_m[step // 2 :: step, step // 2 :: step])
    coarse = np.zeros(bins.shape, np.uint8)
    for detection in movers:
        box = _coarse_box(detection, bins.shape, step, config.margin)
        value = round(255 * detection.p_dynamic)
        window = coarse[box[1] : box[3], box[0] : box[2]]
        mask = cut_box(bins, box, config, detection.depth_m)
        np.maximum(window, mask * np.uint8(value), out=window)
    return _enlarge(coarse, depth_m.shape, config.dilate)


def object_depths(
    detections: Sequence[Detection], depth_m: DepthImage, config: CutConfig
) -> list[float | None]:
    """
    Return the median depth of each detection's object, metres; None where it has no depth.

    Parameters
    ----------
    detections : sequence of Detection
        In pixels of the depth image.
    depth_m : ndarray, shape (H, W), float32
        Metres, 0 where invalid.
    config : CutConfig
        How boxes are cut.

    """
    if not detections:
        return []
    step = config.stride
    coarse_m = depth_m[step // 2 :: step, step // 2 :: step]
    bins = depth_bins(coarse_m)
    return [
        _object_depth(coarse_m, bins, _coarse_box(d, bins.shape, step, 0.0), config)
        for d in detections
    ]


def _object_depth(depth_m: DepthImage, bins: Bins, box: Box, config: CutConfig) -> float | None:
    inside = depth_m[box[1] : box[3], box[0] : box[2]]
    known = inside[(cut_box(bins, box, config) > 0) & (inside > 0)]
    return float(np.median(known)) if known.size else None


def cut_box(
    bins: Bins, box: Box, config: CutConfig, between_m: tuple[float, float] | None = None
) -> Mask:
    """
    Return which pixels of a box are the object, shape of the box.

    Parameters
    ----------
    bins : ndarray, shape (h, w), uint8
        Depth bins of the whole image.
    box : tuple of int
        x0 y0 x1 y1 inside the image.
    config : CutConfig
        Extent of an object in depth.
    between_m : tuple of float, optional
        Between which depths its middle is, where that is known before.

    """
    x0, y0, x1, y1 = box
    window = bins[y0:y1, x0:x1]
    holes = (window == 0).astype(np.uint8)
    nearest, farthest = between_m or (0.0, np.inf)
    contrast = _depth_contrast(bins, box)
    if contrast is None:  # nothing in the middle has depth: very near, or seen against the sun
        return np.asarray(holes if nearest < config.near else np.zeros_like(holes))
    outside = (nearest > _BIN_DEPTH_M) | (farthest < _BIN_DEPTH_M)
    contrast[outside] = np.minimum(contrast[outside], 0.0)  # background stays background
    if contrast.max() <= 0:  # somebody who was there is not any more
        return np.zeros_like(holes)
    layer, peak = _depth_layer(contrast, config)
    mask = _without_specks(layer[window])
    if _BIN_DEPTH_M[peak] < config.near:
        return np.asarray(mask | _touching(holes, mask))
    return np.asarray(mask | (_close(mask) & holes))


def _depth_contrast(bins: Bins, box: Box) -> NDArray[np.float64] | None:
    """Histogram of the middle of the box minus that around it; None without depth inside."""
    x0, y0, x1, y1 = box
    w, h = x1 - x0, y1 - y0
    middle = bins[y0 + h // 8 : y1 - h // 8, x0 + w // 5 : x1 - w // 5]
    inside = _histogram(middle)
    valid = inside.sum()
    if valid < max(4.0, _MIN_DEPTH_SHARE * middle.size):
        return None
    # Around means left, right and above: below a person is the floor the person stands on.
    rim = max(2, w // 3)
    outer = bins[max(0, y0 - rim) : y1, max(0, x0 - rim) : x1 + rim]
    around = _histogram(outer) - _histogram(bins[y0:y1, x0:x1])
    # A rim cut off by the image border is too small to stand for the background.
    around /= max(float(around.sum()), 0.1 * w * h, 1.0)
    smooth = np.convolve(inside / valid - around, _SMOOTHING, mode='same')
    return np.asarray(smooth)


def _histogram(bins: Bins) -> NDArray[np.float64]:
    counts = np.bincount(bins.ravel(), minlength=_BINS)[:_BINS].astype(np.float64)
    counts[0] = 0
    return counts


def _depth_layer(contrast: NDArray[np.float64], config: CutConfig) -> tuple[Mask, int]:
    """Return which bins belong to the object, shape (96,), and the one it is mostly in."""
    peak = int(contrast.argmax())
    nearest = _BIN_DEPTH_M[peak] - config.near_tolerance
    farthest = _BIN_DEPTH_M[peak] + config.far_tolerance
    reach = (nearest < _BIN_DEPTH_M) & (farthest > _BIN_DEPTH_M)
    layer = reach & (contrast > -0.1 * contrast[peak])
    layer[0] = False
    return layer.astype(np.uint8), peak


def _without_specks(mask: Mask) -> Mask:
    """Drop what is not connected to something of a fiftieth of the box."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=4)
    keep = stats[:, cv2.CC_STAT_AREA] >= max(4.0, mask.size / 50)
    keep[0] = False
    if count <= 1:
        return mask
    return np.asarray(keep[labels], dtype=np.uint8)


def _touching(holes: Mask, mask: Mask) -> Mask:
    """Return the connected holes that touch the mask."""
    count, labels = cv2.connectedComponents(holes, connectivity=4)
    touched = np.zeros(count, bool)
    touched[labels[cv2.dilate(mask, np.ones((3, 3), np.uint8)) > 0]] = True
    touched[0] = False
    return np.asarray(touched[labels], dtype=np.uint8)


def _close(mask: Mask) -> Mask:
    """Fill gaps as wide as the shadow that a structured-light projector leaves."""
    size = 2 * max(1, min(mask.shape) // 10) + 1
    kernel = np.ones((size, size), np.uint8)
    padded = cv2.copyMakeBorder(mask, size, size, size, size, cv2.BORDER_CONSTANT, value=0)
    closed = cv2.erode(cv2.dilate(padded, kernel), np.ones((size // 2, size // 2), np.uint8))
    return np.asarray(closed[size:-size, size:-size], dtype=np.uint8)


def _coarse_box(detection: Detection, shape: tuple[int, ...], step: int, margin: float) -> Box:
    x0, y0, x1, y1 = detection.box_xyxy
    dx, dy = margin * (x1 - x0), margin * (y1 - y0)
    left = int(np.clip((x0 - dx) / step, 0, shape[1] - 2))
    top = int(np.clip((y0 - dy) / step, 0, shape[0] - 2))
    right = int(np.clip(np.ceil((x1 + dx) / step), left + 2, shape[1]))
    # Not downwards: below the feet is the floor, at the depth of the feet.
    bottom = int(np.clip(np.ceil(y1 / step), top + 2, shape[0]))
    return left, top, right, bottom


def _enlarge(coarse: ProbabilityImage, shape: tuple[int, ...], dilate: int) -> ProbabilityImage:
    full = cv2.resize(coarse, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)
    if dilate:
        full = cv2.dilate(full, np.ones((2 * dilate + 1, 2 * dilate + 1), np.uint8))
    return np.asarray(full, dtype=np.uint8)
