"""Images to network input and network output to detections: pure functions."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.types import ColorImage, Detection
from bdgs_ros.detection.classes import p_dynamic

Boxes = NDArray[np.float32]  # [N, 4] x0 y0 x1 y1

_PADDING_GREY = 114  # what YOLOv5 was trained with


@dataclass(frozen=True)
class Letterbox:
    """How an image lies in the network's input: `u_input = scale * u_image + offset`."""

    scale: float
    offset_x: int
    offset_y: int


def letterbox(color: ColorImage, height: int, width: int) -> tuple[NDArray[np.float32], Letterbox]:
    """
    Fit an image into the network's input, keeping its proportions.

    Parameters
    ----------
    color : ndarray, shape (H, W, 3), uint8
        RGB.
    height, width : int
        Size of the input in pixels.

    Returns
    -------
    blob : ndarray, shape (1, 3, height, width), float32
        RGB in [0, 1], padded with grey.
    placement : Letterbox
        To bring boxes back.

    """
    scale = min(height / color.shape[0], width / color.shape[1])
    size = (round(color.shape[1] * scale), round(color.shape[0] * scale))
    # Area averages when shrinking: linear would alias by a factor of two and cost detections.
    resized = cv2.resize(color, size, interpolation=cv2.INTER_AREA)
    offset_x, offset_y = (width - size[0]) // 2, (height - size[1]) // 2
    canvas = np.full((height, width, 3), _PADDING_GREY, np.uint8)
    canvas[offset_y : offset_y + size[1], offset_x : offset_x + size[0]] = resized
    blob = np.ascontiguousarray(canvas.transpose(2, 0, 1)[None], dtype=np.float32)
    blob *= 1.0 / 255.0
    return blob, Letterbox(scale, offset_x, offset_y)


def decode(
    output: NDArray[np.float32], score_threshold: float
) -> tuple[Boxes, NDArray[np.float32], NDArray[np.intp]]:
    """
    Pick the candidates out of a YOLOv5 output.

    Parameters
    ----------
    output : ndarray, shape (1, N, 5 + C)
        Centre, size, objectness and class scores, in pixels of the input.
    score_threshold : float
        Candidates whose objectness times class score is below are dropped.

    Returns
    -------
    boxes : ndarray, shape (K, 4)
        Corners x0 y0 x1 y1 in pixels of the input.
    scores : ndarray, shape (K,)
    class_ids : ndarray, shape (K,)

    """
    rows = output[0]
    rows = rows[rows[:, 4] >= score_threshold]
    class_ids = rows[:, 5:].argmax(axis=1)
    scores = rows[:, 4] * rows[np.arange(len(rows)), 5 + class_ids]
    keep = (scores >= score_threshold) & np.isfinite(rows[:, :4]).all(axis=1)
    centre, half = rows[keep, :2], rows[keep, 2:4] / 2
    return np.hstack([centre - half, centre + half]), scores[keep], class_ids[keep]


def iou_matrix(a: Boxes, b: Boxes) -> NDArray[np.float32]:
    """Return the intersection over union of all pairs of boxes, shape (len(a), len(b))."""
    low = np.maximum(a[:, None, :2], b[None, :, :2])
    high = np.minimum(a[:, None, 2:], b[None, :, 2:])
    inter = np.clip(high - low, 0, None).prod(axis=2)
    area_a = np.clip(a[:, 2:] - a[:, :2], 0, None).prod(axis=1)
    area_b = np.clip(b[:, 2:] - b[:, :2], 0, None).prod(axis=1)
    union = area_a[:, None] + area_b[None, :] - inter
    return np.asarray(inter / np.maximum(union, 1e-9), dtype=np.float32)


def non_maximum_suppression(
    boxes: Boxes, scores: NDArray[np.float32], class_ids: NDArray[np.intp], iou_threshold: float
) -> list[int]:
    """Return the indices of the boxes to keep, best first; classes do not suppress each other."""
    order = np.argsort(-scores, kind='stable')
    overlaps = iou_matrix(boxes, boxes) > iou_threshold
    overlaps &= class_ids[:, None] == class_ids[None, :]
    alive = np.ones(len(boxes), bool)
    kept: list[int] = []
    for index in order:
        if alive[index]:
            kept.append(int(index))
            alive &= ~overlaps[index]
            alive[index] = False
    return kept


def to_image(boxes: Boxes, placement: Letterbox, height: int, width: int) -> Boxes:
    """Bring boxes from pixels of the input to pixels of the image, clipped to it."""
    offset = np.array([placement.offset_x, placement.offset_y] * 2, np.float32)
    limit = np.array([width, height] * 2, np.float32)
    return np.asarray(np.clip((boxes - offset) / placement.scale, 0, limit), np.float32)


def detections(
    output: NDArray[np.float32],
    placement: Letterbox,
    shape: tuple[int, int],
    names: Sequence[str],
    score_threshold: float,
    iou_threshold: float,
) -> list[Detection]:
    """
    Turn a YOLOv5 output into detections in the full image, best first.

    Parameters
    ----------
    output : ndarray, shape (1, N, 5 + C)
        As the network gave it.
    placement : Letterbox
        Of the image in the input.
    shape : tuple of int
        (H, W) of the image.
    names : sequence of str, length C
        Of the classes.
    score_threshold, iou_threshold : float
        Of the candidates and of the suppression.

    """
    boxes, scores, class_ids = decode(output, score_threshold)
    kept = non_maximum_suppression(boxes, scores, class_ids, iou_threshold)
    in_image = to_image(boxes[kept], placement, *shape)
    found = []
    for (x0, y0, x1, y1), index in zip(in_image.tolist(), kept, strict=True):
        if x1 - x0 < 1 or y1 - y0 < 1:
            continue
        name, score = names[class_ids[index]], float(scores[index])
        box = (x0, y0, x1, y1)
        found.append(Detection(box, score, int(class_ids[index]), name, p_dynamic(name, score)))
    return found
