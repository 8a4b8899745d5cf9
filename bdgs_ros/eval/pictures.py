"""Tiled and animated pictures: input, dynamic probability, rendered static map side by side."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.files import write_aside
from bdgs_ros.core.types import ColorImage, ProbabilityImage
from bdgs_ros.eval.posterior import PosteriorSample
from bdgs_ros.eval.scores import View

TITLES = ('input', 'dynamic probability', 'static map, rendered')
POSTERIOR_TITLES = ('input', 'prior: labels', 'posterior of all Gaussians', 'static map, rendered')
_OVERLAY = np.array([255.0, 60.0, 30.0])
_HEADER_PX = 26
_GAP_PX = 4


def overlay_probability(color: ColorImage, p_dynamic: ProbabilityImage) -> ColorImage:
    """Tint an image, shape (H, W, 3), with red where P(dynamic) is high, and grey it elsewhere."""
    grey = color.mean(axis=2, keepdims=True) * 0.75 + 40.0
    alpha = (p_dynamic.astype(np.float32) / 255.0)[..., None]
    tinted = 0.35 * color + 0.65 * _OVERLAY
    return np.asarray(np.clip((1.0 - alpha) * grey + alpha * tinted, 0, 255), dtype=np.uint8)


def panel(view: View, width: int) -> ColorImage:
    """Return input, overlay and render of one view beside each other, each `width` wide."""
    sample = view.sample
    render = np.clip(view.color * 255.0 + 0.5, 0, 255).astype(np.uint8)
    overlay = overlay_probability(sample.frame.color, sample.p_dynamic)
    height = round(width * sample.frame.camera.height / sample.frame.camera.width)
    images = [
        np.asarray(cv2.resize(image, (width, height), interpolation=cv2.INTER_AREA), np.uint8)
        for image in (sample.frame.color, overlay, render)
    ]
    return _beside(images)


def _beside(images: Sequence[ColorImage]) -> ColorImage:
    gap = np.full((len(images[0]), _GAP_PX, 3), 255, np.uint8)
    parts = [part for image in images for part in (gap, image)]
    return np.hstack(parts[1:])


def write_tiles(path: Path, views: Sequence[View], rows: int = 6, width: int = 320) -> None:
    """
    Write a picture with one row for each of `rows` evenly spaced views.

    Raises
    ------
    EvaluationError
        If there are no views, or the picture cannot be encoded.

    """
    chosen = _evenly(views, rows)
    _write_rows(path, [panel(view, width) for view in chosen], width, TITLES)


def write_posterior(path: Path, samples: Sequence[PosteriorSample]) -> None:
    """
    Write a picture with one row per sample: input, prior, posterior of the map, static map.

    Raises
    ------
    EvaluationError
        If there are no samples, or the picture cannot be encoded.

    """
    if not samples:
        raise EvaluationError('no keyframe was kept: there is no posterior to picture')
    width = samples[0].color.shape[1]
    _write_rows(path, [_posterior_panel(sample) for sample in samples], width, POSTERIOR_TITLES)


def _posterior_panel(sample: PosteriorSample) -> ColorImage:
    shown = sample.color.copy()
    text, font = f'{sample.time_s:.1f} s', cv2.FONT_HERSHEY_SIMPLEX
    for color, thickness in (((0, 0, 0), 3), ((255, 255, 255), 1)):
        cv2.putText(shown, text, (6, 18), font, 0.5, color, thickness, cv2.LINE_AA)
    overlays = [overlay_probability(sample.color, p) for p in (sample.prior, sample.posterior)]
    return _beside([shown, *overlays, sample.static])


def _write_rows(
    path: Path, panels: Sequence[ColorImage], width: int, titles: Sequence[str]
) -> None:
    parts: list[ColorImage] = [_header(panels[0].shape[1], width, titles)]
    for image in panels:
        parts += [image, np.full((_GAP_PX, image.shape[1], 3), 255, np.uint8)]
    _write_image(path, np.vstack(parts[:-1]))


def write_animation(
    path: Path, views: Sequence[View], width: int = 240, frames_per_second: float = 8.0
) -> None:
    """
    Write an animated .gif with one frame per view.

    Raises
    ------
    EvaluationError
        If there are no views.

    """
    from PIL import Image

    panels = [panel(view, width) for view in _evenly(views, len(views) or 1)]
    header = _header(panels[0].shape[1], width, TITLES)
    images = [Image.fromarray(np.vstack([header, image])) for image in panels]
    mosaic = Image.fromarray(np.vstack(panels[:: max(1, len(panels) // 4)]))
    palette = mosaic.quantize(256, method=Image.Quantize.FASTOCTREE)  # keeps small bright things
    frames = [image.quantize(palette=palette, dither=Image.Dither.NONE) for image in images]
    write_aside(
        path,
        lambda aside: frames[0].save(
            aside,
            save_all=True,
            append_images=frames[1:],
            duration=round(1000.0 / frames_per_second),
            loop=0,
            optimize=False,
        ),
    )


def _evenly(views: Sequence[View], count: int) -> list[View]:
    if not views:
        raise EvaluationError('no frame with a pose was kept: there is nothing to picture')
    index = np.unique(np.linspace(0, len(views) - 1, min(count, len(views))).round().astype(int))
    return [views[i] for i in index]


def _header(total_width: int, width: int, titles: Sequence[str]) -> ColorImage:
    header: NDArray[Any] = np.full((_HEADER_PX, total_width, 3), 255, np.uint8)
    for column, title in enumerate(titles):
        origin = (column * (width + _GAP_PX) + 4, _HEADER_PX - 9)
        font = cv2.FONT_HERSHEY_SIMPLEX
        cv2.putText(header, title, origin, font, 0.45, (11, 11, 11), 1, cv2.LINE_AA)
    return np.asarray(header, dtype=np.uint8)


def _write_image(path: Path, image: ColorImage) -> None:
    def write(aside: Path) -> None:
        if not cv2.imwrite(str(aside), cv2.cvtColor(image, cv2.COLOR_RGB2BGR)):
            raise EvaluationError(f"cannot write the picture '{path}'")

    write_aside(path, write)
