"""The posterior of the map as it was during a run, once for each second, for a picture."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import ColorImage, Pose, ProbabilityImage, RgbdFrame, TrackingResult

_WIDTH = 320
_MAX_ROWS = 20


class PosteriorRenderer(Protocol):
    """Whoever can show the map; see `bdgs_ros.mapping.mapper.Mapper`."""

    def render(self, T_world_camera: Pose, camera: PinholeCamera) -> Any:
        """Render what is believed to be static."""

    def render_everything(self, T_world_camera: Pose, camera: PinholeCamera) -> Any:
        """Render also what is hidden."""

    def final_pose(self, stamp_ns: int, T_world_camera: Pose) -> Pose:
        """Return a pose with what mapping found out after tracking gave it."""


@dataclass(frozen=True)
class PosteriorSample:
    """What was seen and believed at one keyframe; images of one small size."""

    time_s: float
    """Since the first keyframe."""
    color: ColorImage
    prior: ProbabilityImage
    """P(dynamic) x 255 by detection and tracking, before the map has had its say."""
    posterior: ProbabilityImage
    """P(dynamic) x 255 of all Gaussians, also those that are not rendered."""
    static: ColorImage
    """The static map, rendered."""


class PosteriorWatch:
    """
    Observer that keeps, for every second, the keyframe nearest to it.

    The map is rendered at once: afterwards it believes something else. Of long recordings every
    second, fourth, ... second is kept, so that there are never more than twenty samples.
    """

    def __init__(self, renderer: PosteriorRenderer) -> None:
        self._renderer = renderer
        self._start_ns: int | None = None
        self._stride = 1
        self._nearest: dict[int, PosteriorSample] = {}

    @property
    def samples(self) -> list[PosteriorSample]:
        """What was kept, in order of time."""
        return [self._nearest[second] for second in sorted(self._nearest)]

    def __call__(self, frame: RgbdFrame, tracking: TrackingResult) -> None:
        """Take the outcome of one frame; only keyframes change the map."""
        if not tracking.is_keyframe:
            return
        if self._start_ns is None:
            self._start_ns = frame.stamp_ns
        time_s = (frame.stamp_ns - self._start_ns) * 1e-9
        second = round(time_s)
        kept = self._nearest.get(second)
        nearer = kept is None or abs(time_s - second) < abs(kept.time_s - second)
        if second % self._stride or not nearer:
            return
        self._nearest[second] = self._sample(time_s, frame, tracking)
        if len(self._nearest) > _MAX_ROWS:
            self._stride *= 2
            self._nearest = {s: v for s, v in self._nearest.items() if s % self._stride == 0}

    def _sample(
        self, time_s: float, frame: RgbdFrame, tracking: TrackingResult
    ) -> PosteriorSample:
        camera = frame.camera.scaled(min(1.0, _WIDTH / frame.camera.width))
        size = (camera.width, camera.height)
        pose = self._renderer.final_pose(frame.stamp_ns, tracking.T_world_camera)
        everything = self._renderer.render_everything(pose, camera)
        posterior = everything.p_dynamic / np.maximum(everything.silhouette, np.float32(0.5))
        return PosteriorSample(
            time_s,
            np.asarray(cv2.resize(frame.color, size, interpolation=cv2.INTER_AREA), np.uint8),
            np.asarray(cv2.resize(tracking.p_dynamic, size, interpolation=cv2.INTER_AREA)),
            _eight_bits(posterior),
            _eight_bits(self._renderer.render(pose, camera).color),
        )


def _eight_bits(image: NDArray[np.float32]) -> NDArray[np.uint8]:
    return np.asarray(np.clip(image * 255 + 0.5, 0, 255), np.uint8)
