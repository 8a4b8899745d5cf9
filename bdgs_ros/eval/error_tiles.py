"""A picture that shows where a map is wrong: input, render, error, depth side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.files import write_aside
from bdgs_ros.core.types import ColorImage
from bdgs_ros.eval.scores import Truth, View

_GAP_PX = 4
_MAX_ERROR = 0.25  # brightest in the heat map, of 1
_UNCOUNTED = 90  # grey of pixels that are not scored


def write_error_tiles(
    path: Path,
    views: Sequence[View],
    truth: Truth | None = None,
    width: int = 320,
    max_depth_m: float = 6.0,
) -> None:
    """
    Write one row per view: input, render, absolute error (bright = 0.25 or more), rendered depth.

    Parameters
    ----------
    path : Path
        A picture file.
    views : sequence of View
        At least one.
    truth : Truth, optional
        The error is against the true static view; without it against the input, and pixels
        called dynamic are grey.
    width : int
        Of each image in pixels.
    max_depth_m : float
        Farthest colour of the depth image; nothing known is black.

    Raises
    ------
    EvaluationError
        If there is no view, or the picture cannot be written.

    """
    if not views:
        raise EvaluationError('no view to picture: no frame was tracked that was no keyframe')
    rows = [_row(view, truth, width, max_depth_m) for view in views]
    gap = np.full((_GAP_PX, rows[0].shape[1], 3), 255, np.uint8)
    image = np.vstack([part for row in rows for part in (row, gap)][:-1])

    def write(aside: Path) -> None:
        if not cv2.imwrite(str(aside), image[..., ::-1]):
            raise EvaluationError(f"cannot write the picture '{path}'")

    write_aside(path, write)


def _row(view: View, truth: Truth | None, width: int, max_depth_m: float) -> ColorImage:
    frame = view.sample.frame
    shown = view.photo if truth is None else view.color
    render = np.clip(shown * 255.0 + 0.5, 0, 255).astype(np.uint8)
    target = frame.color if truth is None else truth.static_color(frame.stamp_ns)
    error = np.abs(shown - target.astype(np.float32) / 255.0).mean(axis=2) / _MAX_ERROR
    heat = _colored(error, cv2.COLORMAP_INFERNO)
    if truth is None:
        heat[~view.sample.static] = _UNCOUNTED
    depth = _colored(view.depth_m / max_depth_m, cv2.COLORMAP_TURBO)
    depth[view.depth_m <= 0] = 0
    height = round(width * frame.camera.height / frame.camera.width)
    gap = np.full((height, _GAP_PX, 3), 255, np.uint8)
    parts: list[NDArray[Any]] = []
    for image in (frame.color, render, heat, depth):
        parts += [cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), gap]
    return np.asarray(np.hstack(parts[:-1]), np.uint8)


def _colored(values: NDArray[Any], colormap: int) -> ColorImage:
    grey = np.clip(255.0 * values, 0, 255).astype(np.uint8)
    return np.ascontiguousarray(cv2.applyColorMap(grey, colormap)[..., ::-1])
