"""
Objects that the network misses for a frame or two, held where they should be by now.

A simple stand-in for object tracks: boxes of one class that overlap are one object, objects move
with constant velocity in the image, and an unseen one fades.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.config.detection import HoldConfig
from bdgs_ros.core.types import Detection
from bdgs_ros.detection.classes import p_dynamic
from bdgs_ros.detection.postprocess import iou_matrix

Box = NDArray[np.float64]  # x0 y0 x1 y1 in pixels


@dataclass(frozen=True)
class _Object:
    detection: Detection
    box: Box
    velocity: Box
    """Pixels per frame, of each corner."""
    missed: int = 0

    def advanced(self) -> _Object:
        return replace(self, box=self.box + self.velocity)


class BoxHold:
    """
    Fills missed detections.

    Parameters
    ----------
    config : HoldConfig
        How long, and what makes two boxes one object.

    """

    def __init__(self, config: HoldConfig) -> None:
        self._config = config
        self._objects: list[_Object] = []

    def reset(self) -> None:
        """Forget all objects."""
        self._objects = []

    def update(self, found: list[Detection], shape: tuple[int, int]) -> list[Detection]:
        """
        Take the detections of the next frame; return them and those that are held.

        Parameters
        ----------
        found : list of Detection
            Of this frame.
        shape : tuple of int
            (H, W) of the image; objects that leave it are let go.

        """
        predicted = [o.advanced() for o in self._objects]
        partner = self._match(predicted, found)
        seen = [self._seen(d, predicted, partner.get(i)) for i, d in enumerate(found)]
        taken = set(partner.values())
        held = [
            replace(o, missed=o.missed + 1)
            for k, o in enumerate(predicted)
            if k not in taken and self._worth_holding(o, shape)
        ]
        self._objects = seen + held
        return found + [self._faded(o, shape) for o in held]

    def coast(self, shape: tuple[int, int]) -> list[Detection]:
        """Return the objects one frame on, for a frame on which the network did not run."""
        self._objects = [o.advanced() for o in self._objects]
        return [self._faded(o, shape) for o in self._objects if _visible(o.box, shape) > 0]

    def _match(self, predicted: list[_Object], found: list[Detection]) -> dict[int, int]:
        """Pair detections with predictions, best overlap first: index found -> predicted."""
        if not predicted or not found:
            return {}
        new = np.array([d.box_xyxy for d in found], np.float32)
        old = np.array([o.box for o in predicted], np.float32)
        iou = iou_matrix(new, old)
        other = [[d.class_id != o.detection.class_id for o in predicted] for d in found]
        iou[np.array(other)] = 0.0
        pairs: dict[int, int] = {}
        while iou.max() > self._config.iou:
            i, k = np.unravel_index(int(iou.argmax()), iou.shape)
            pairs[int(i)] = int(k)
            iou[i, :] = iou[:, k] = 0.0
        return pairs

    def _seen(self, detection: Detection, predicted: list[_Object], k: int | None) -> _Object:
        box = np.array(detection.box_xyxy)
        if k is None:
            return _Object(detection, box, np.zeros(4))
        # The prediction's error corrects the velocity by half: boxes jitter by some pixels.
        velocity = predicted[k].velocity + 0.5 * (box - predicted[k].box) / (
            predicted[k].missed + 1
        )
        return _Object(detection, box, velocity)

    def _worth_holding(self, item: _Object, shape: tuple[int, int]) -> bool:
        certain = item.detection.score >= self._config.min_score and item.detection.p_dynamic > 0
        return certain and item.missed < self._config.frames and _visible(item.box, shape) > 0.3

    def _faded(self, item: _Object, shape: tuple[int, int]) -> Detection:
        score = item.detection.score * self._config.decay**item.missed
        limit = [shape[1], shape[0], shape[1], shape[0]]
        x0, y0, x1, y1 = np.clip(item.box, 0, limit).tolist()
        return replace(
            item.detection,
            box_xyxy=(x0, y0, x1, y1),
            score=score,
            p_dynamic=p_dynamic(item.detection.class_name, score),
        )


def _visible(box: Box, shape: tuple[int, int]) -> float:
    """Return the share of a box inside the image; 0 for an inverted box."""
    size = np.clip(box[2:] - box[:2], 0, None)
    inside = np.clip(np.minimum(box[2:], shape[::-1]) - np.maximum(box[:2], 0), 0, None)
    return float(inside.prod() / max(size.prod(), 1e-9))
