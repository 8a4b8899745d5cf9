"""The figures of a run: trajectory, labels and renders against what is known to be true."""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.types import (
    ColorImage,
    DepthImage,
    Pose,
    RgbdFrame,
    Trajectory,
)
from bdgs_ros.eval import rendering, trajectory
from bdgs_ros.eval.metric import Metric
from bdgs_ros.eval.recorder import Sample

_LOGGER = logging.getLogger(__name__)
Perceptual = Callable[[NDArray[Any], NDArray[Any], NDArray[np.bool_] | None], float]
_SEEN = 0.5  # silhouette above which the map says something about a pixel


class Render(Protocol):
    """A view of the static map; see `bdgs_ros.mapping`."""

    @property
    def color(self) -> NDArray[np.float32]:
        """Shape (H, W, 3), in [0, 1]."""

    @property
    def depth(self) -> NDArray[np.float32]:
        """Shape (H, W), metres times accumulated opacity."""

    @property
    def silhouette(self) -> NDArray[np.float32]:
        """Shape (H, W), accumulated opacity in [0, 1]."""


class Renderer(Protocol):
    """Whoever can show the static map."""

    def render(self, T_world_camera: Pose, camera: PinholeCamera) -> Render:
        """Show the static map from a pose."""

    def as_photograph(self, rendered: Any, camera: PinholeCamera, stamp_ns: int) -> Render:
        """Return a render as the camera would show it then, with the errors that it has."""

    def final_pose(self, stamp_ns: int, T_world_camera: Pose) -> Pose:
        """Return a pose with what mapping found out after tracking gave it."""


class Truth(Protocol):
    """What a synthetic recording knows about each of its frames."""

    def dynamic(self, stamp_ns: int) -> NDArray[np.bool_]:
        """Return the true mask of moving things, shape (H, W)."""

    def static_color(self, stamp_ns: int) -> ColorImage:
        """Return the view without anything that moves."""

    def static_depth(self, stamp_ns: int) -> DepthImage:
        """Return the depth without anything that moves."""


@dataclass(frozen=True)
class View:
    """A sample with its render."""

    sample: Sample
    color: NDArray[np.float32]
    """As the map has it."""
    photo: NDArray[np.float32]
    """As the camera would show it, by the exposure of the keyframes around."""
    depth_m: NDArray[np.float32]
    """Expected depth as the map has it; 0 where the map is empty."""
    photo_depth_m: NDArray[np.float32]
    """The same as the depth sensor would measure it."""
    silhouette: NDArray[np.float32]


def render_view(sample: Sample, renderer: Renderer) -> View:
    """Render the static map, as it is now, at what is now known to be the pose of a sample."""
    frame = sample.frame
    pose = renderer.final_pose(frame.stamp_ns, sample.T_world_camera)
    render = renderer.render(pose, frame.camera)
    photo = renderer.as_photograph(render, frame.camera, frame.stamp_ns)
    return View(
        sample,
        render.color,
        photo.color,
        _surface_depth(render),
        _surface_depth(photo),
        render.silhouette,
    )


def _surface_depth(render: Render) -> NDArray[np.float32]:
    seen = render.silhouette > _SEEN
    depth_m = np.where(seen, render.depth / np.maximum(render.silhouette, _SEEN), 0.0)
    return np.asarray(depth_m, np.float32)


def render_samples(samples: Sequence[Sample], renderer: Renderer) -> list[View]:
    """Render the final static map at the final pose of every sample."""
    return [render_view(sample, renderer) for sample in samples]


def trajectory_metrics(
    gt: Trajectory,
    est: Trajectory,
    frames_expected: int | None = None,
    max_difference_s: float = trajectory.MAX_DIFFERENCE_S,
) -> list[Metric]:
    """
    Return ATE, coverage, and RPE per frame and, where it is long enough, per second.

    Raises
    ------
    EvaluationError
        If the trajectories cannot be compared.

    """
    limit_s = max_difference_s
    metrics = trajectory.ate(gt, est, limit_s, frames_expected).metrics()
    metrics += trajectory.rpe_frames(gt, est, 1, limit_s).metrics('frame')
    try:
        metrics += trajectory.rpe_seconds(gt, est, 1.0, limit_s).metrics('second')
    except EvaluationError:
        _LOGGER.info('shorter than a second: no drift per second')
    return metrics


def render_metrics(views: Sequence[View], truth: Truth | None = None) -> list[Metric]:
    """
    Score the static map: against the true static view, or the input with moving pixels left out.

    Keyframes, which the map was fitted to, are left out as long as other frames remain. Where
    truth is known, `psnr_hidden` scores only the pixels that something moving covered, and
    `psnr_rest` the others of the same views.

    Parameters
    ----------
    views : sequence of View
        Renders at estimated poses.
    truth : Truth, optional
        Without it, pixels that the run called dynamic do not count.

    Returns
    -------
    metrics : list of Metric
        Means over the views; empty without views.

    """
    chosen = [v for v in views if not v.sample.is_keyframe] or list(views)
    if not chosen:
        return []
    return mean_scores([score_view(view, truth) for view in chosen])


def score_view(
    view: View,
    truth: Truth | None = None,
    static: NDArray[np.bool_] | None = None,
    perceptual: Perceptual | None = None,
) -> dict[str, float]:
    """
    Score one render; `render_metrics` is the mean of these.

    Parameters
    ----------
    view : View
        Render and frame.
    truth : Truth, optional
        Its static view is what the render is compared with; without it, the frame itself.
    static : ndarray of bool, shape (H, W), optional
        Pixels that count where truth is not known; by default those not called dynamic.
    perceptual : callable, optional
        Distance of image and truth over valid pixels, for the score `lpips`.

    Returns
    -------
    scores : dict
        The keys of `render_metrics`, in the units named there; NaN where nothing is known.

    """
    if truth is not None:
        return _against_truth(view, truth, perceptual)
    counted = view.sample.static if static is None else static
    frame: RgbdFrame = view.sample.frame
    shown = view.photo, view.photo_depth_m
    scores = _scores(view, shown, (frame.color, frame.depth_m), counted, perceptual)
    return {**scores, 'psnr_map': rendering.psnr(view.color, frame.color, counted)}


def mean_scores(scores: Sequence[Mapping[str, float]]) -> list[Metric]:
    """Return the mean of each score over the views in which it is known, and how many views."""
    if not scores:
        return []
    metrics = [
        Metric(name, _mean([score[name] for score in scores]), unit)
        for name, unit in _UNITS.items()
        if name in scores[0]
    ]
    return [*metrics, Metric('views_scored', len(scores))]


_UNITS = {
    'psnr': 'dB',
    'psnr_exposure_fit': 'dB',
    'psnr_seen': 'dB',
    'psnr_hidden': 'dB',
    'psnr_rest': 'dB',
    'psnr_map': 'dB',
    'ssim': '',
    'lpips': '',
    'depth_l1': 'cm',
    'seen': '%',
}


def _against_truth(view: View, truth: Truth, perceptual: Perceptual | None) -> dict[str, float]:
    stamp_ns = view.sample.frame.stamp_ns
    hidden = np.asarray(truth.dynamic(stamp_ns), dtype=bool)
    wanted = truth.static_color(stamp_ns), truth.static_depth(stamp_ns)
    everything = np.ones(hidden.shape, dtype=bool)
    shown = view.color, view.depth_m
    scores = _scores(view, shown, wanted, everything, perceptual)
    rest = ~hidden & hidden.any()  # views in which nothing moves are in neither
    scores['psnr_hidden'] = rendering.psnr(view.color, wanted[0], hidden)
    scores['psnr_rest'] = rendering.psnr(view.color, wanted[0], rest)
    return scores


def _scores(
    view: View,
    images: tuple[NDArray[np.float32], NDArray[np.float32]],
    wanted: tuple[ColorImage, DepthImage],
    valid: NDArray[np.bool_],
    perceptual: Perceptual | None,
) -> dict[str, float]:
    (shown, shown_depth_m), (color, depth) = images, wanted
    fitted = rendering.fit_exposure(shown, color, valid)
    seen = view.silhouette > _SEEN
    scores = {
        'psnr': rendering.psnr(shown, color, valid),
        'psnr_exposure_fit': rendering.psnr(fitted, color, valid),
        'psnr_seen': rendering.psnr(shown, color, valid & seen),
        'ssim': rendering.ssim(shown, color, valid),
        'depth_l1': 100.0 * rendering.depth_l1(shown_depth_m, depth, valid),
        'seen': 100.0 * float(np.mean(seen)),
    }
    if perceptual is not None:
        scores['lpips'] = perceptual(shown, color, valid)
    return scores


def _mean(values: Sequence[float]) -> float:
    known = [v for v in values if np.isfinite(v)]
    return float(np.mean(known)) if known else float('nan')
