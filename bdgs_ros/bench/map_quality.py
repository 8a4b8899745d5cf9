"""
How good is the map that a run made: while it ran, after it, and after refinement.

Frames are scored one at a time and read again from the recording when they are needed a second
time, so that a long run takes no more memory than a short one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.types import (
    DYNAMIC_THRESHOLD,
    Labels,
    Pose,
    RgbdFrame,
    TrackingResult,
    TrackingStatus,
)
from bdgs_ros.eval import rendering, scores
from bdgs_ros.eval.recorder import Sample

AFTER_STRIDE = 5  # of the frames that were no keyframes, as scored after the run
LIVE_STRIDE = 10  # likewise while it goes on: every second one of those
_PICTURED = 4
_MARGIN_PX = 7  # around what the detection stage labels
_MOVES = 0.5  # prior of a class above which its whole boxes are left out

Mask = NDArray[np.bool_]
Scores = dict[str, float]


class Frames(Protocol):
    """A recording that can be read at any place."""

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame."""


@dataclass(frozen=True)
class ScoredFrame:
    """A frame that was no keyframe: enough to render and score it again."""

    index: int
    """Place in the recording as it was run."""
    T_world_camera: Pose
    shape: tuple[int, int]
    _called: NDArray[np.uint8] = field(repr=False)
    _boxed: NDArray[np.uint8] = field(repr=False)

    @classmethod
    def of(cls, index: int, tracking: TrackingResult, labels: Labels) -> ScoredFrame:
        """Keep pose and masks, 80 kB for 640x480."""
        called = tracking.p_dynamic >= DYNAMIC_THRESHOLD
        boxed = near_detections(labels)
        shape = (called.shape[0], called.shape[1])
        pose = tracking.T_world_camera.copy()
        return cls(index, pose, shape, np.packbits(called), np.packbits(boxed))

    def sample(self, frame: RgbdFrame) -> Sample:
        """Return the frame with what was known of it."""
        p_dynamic = np.where(self._unpack(self._called), 255, 0).astype(np.uint8)
        return Sample(frame, self.T_world_camera, p_dynamic, False)

    @property
    def outside_boxes(self) -> Mask:
        """Pixels away from everything that the detection stage found; the map has no say."""
        return ~self._unpack(self._boxed)

    def _unpack(self, bits: NDArray[np.uint8]) -> Mask:
        count = self.shape[0] * self.shape[1]
        return np.unpackbits(bits, count=count).reshape(self.shape).astype(bool)


def near_detections(labels: Labels) -> Mask:
    """
    Return the whole boxes of what can move, and what is labelled with a margin, shape (H, W).

    A mask that does not know the map: what tracking calls dynamic because it stands before the
    map may be an error of the map.
    """
    reach = 2 * _MARGIN_PX + 1
    labelled = (labels.p_dynamic >= DYNAMIC_THRESHOLD).astype(np.uint8)
    mask = cv2.dilate(labelled, np.ones((reach, reach), np.uint8)) > 0
    for detection in labels.detections:
        if detection.p_dynamic >= _MOVES:
            x0, y0, x1, y1 = (max(0, round(value)) for value in detection.box_xyxy)
            mask[y0 : y1 + 1, x0 : x1 + 1] = True
    return np.asarray(mask)


@dataclass
class Scorer:
    """Compare renders with what is known to be true."""

    truth: scores.Truth | None = None
    perceptual: scores.Perceptual | None = None

    def score(self, view: scores.View, frame: ScoredFrame) -> Scores:
        """Return the scores of one render; `psnr_boxes` only where truth is not known."""
        found = scores.score_view(view, self.truth, perceptual=self.perceptual)
        if self.truth is None:
            color = view.sample.frame.color
            found['psnr_boxes'] = rendering.psnr(view.photo, color, frame.outside_boxes)
            found['counted'] = 100.0 * float(view.sample.static.mean())
        return found


class LastLabels:
    """Stand in front of the detection stage and remember what it said last."""

    def __init__(self, stage: Any) -> None:
        self._stage = stage
        self.labels: Labels | None = None

    def process(self, frame: RgbdFrame) -> Labels:
        """Pass the frame on."""
        labels: Labels = self._stage.process(frame)
        self.labels = labels
        return labels

    def __getattr__(self, name: str) -> Any:
        """Be the stage in everything else."""
        return getattr(self._stage, name)


@dataclass
class LiveScores:
    """
    Watch a run: score the map as it is when a frame comes, which is what subscribers see.

    Of the frames that have a pose and were no keyframes every tenth is scored at once, and every
    fifth kept to be scored after the run.
    """

    renderer: scores.Renderer
    """The mapper itself, not a timed one."""
    detection: LastLabels
    scorer: Scorer
    keep_frames: bool = True
    """Whether the frames are needed after the run; they take memory."""
    live: list[Scores] = field(default_factory=list)
    live_at: list[int] = field(default_factory=list)
    """Place of each of them in the recording."""
    frames: list[ScoredFrame] = field(default_factory=list)
    _index: int = -1
    _between: int = -1

    def __call__(self, frame: RgbdFrame, tracking: TrackingResult) -> None:
        """Take the outcome of one frame."""
        self._index += 1
        if tracking.is_keyframe or tracking.status is not TrackingStatus.OK:
            return
        self._between += 1
        if self._between % AFTER_STRIDE or self.detection.labels is None:
            return
        scored = ScoredFrame.of(self._index, tracking, self.detection.labels)
        if self.keep_frames:
            self.frames.append(scored)
        if self._between % LIVE_STRIDE == 0:
            view = scores.render_view(scored.sample(frame), self.renderer)
            self.live.append(self.scorer.score(view, scored))
            self.live_at.append(self._index)


@dataclass(frozen=True)
class AfterScores:
    """The scores of all frames, and a few views to look at."""

    per_frame: list[Scores]
    pictured: list[scores.View]


def score_after(
    frames: Sequence[ScoredFrame], recording: Frames, renderer: scores.Renderer, scorer: Scorer
) -> AfterScores:
    """Render and score frames again with the map as it is now."""
    pictured = _evenly(len(frames))
    found = AfterScores([], [])
    for place, (frame, view) in enumerate(_views(frames, recording, renderer)):
        found.per_frame.append(scorer.score(view, frame))
        if place in pictured:
            found.pictured.append(view)
    return found


def _views(
    frames: Sequence[ScoredFrame], recording: Frames, renderer: scores.Renderer
) -> Iterator[tuple[ScoredFrame, scores.View]]:
    for frame in frames:
        yield frame, scores.render_view(frame.sample(recording[frame.index]), renderer)


def _evenly(count: int) -> set[int]:
    return (
        set(np.linspace(0, count - 1, _PICTURED).round().astype(int).tolist()) if count else set()
    )


_COLUMNS = {
    'psnr': 'psnr_db',
    'psnr_exposure_fit': 'psnr_fit_db',
    'psnr_seen': 'psnr_seen_db',
    'psnr_hidden': 'psnr_hidden_db',
    'psnr_boxes': 'psnr_boxes_db',
    'psnr_map': 'psnr_map_db',
    'ssim': 'ssim',
    'lpips': 'lpips',
    'depth_l1': 'depth_l1_cm',
    'seen': 'seen_percent',
    'counted': 'counted_percent',
}


def columns(stage: str, found: Sequence[Mapping[str, float]]) -> dict[str, float | int]:
    """Return the means as columns `<stage>_<score>`, NaN where nothing is known."""
    row: dict[str, float | int] = {}
    for name, column in _COLUMNS.items():
        values = [s[name] for s in found if np.isfinite(s.get(name, np.nan))]
        if values:
            row[f'{stage}_{column}'] = float(np.mean(values))
    return {**row, f'{stage}_views': len(found)}
