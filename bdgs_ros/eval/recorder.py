"""What is kept of a run while it goes on: a row per frame, and some frames for pictures."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.types import (
    DYNAMIC_THRESHOLD,
    Pose,
    ProbabilityImage,
    RgbdFrame,
    StampedPose,
    TrackingResult,
    TrackingStatus,
    Trajectory,
)
from bdgs_ros.eval.metric import Metric


@dataclass(frozen=True)
class FrameRow:
    """One frame of the run; `times_ms` has an entry for each part that ran."""

    stamp_ns: int
    status: TrackingStatus
    T_world_camera: Pose
    is_keyframe: bool
    inlier_ratio: float
    overlap: float
    times_ms: Mapping[str, float]
    covariance: NDArray[np.float64] | None = None
    """Shape (6, 6), of the camera's tangent; None where nobody said it."""


@dataclass(frozen=True)
class Sample:
    """A frame kept for scores and pictures."""

    frame: RgbdFrame
    T_world_camera: Pose
    p_dynamic: ProbabilityImage
    is_keyframe: bool

    @property
    def static(self) -> NDArray[np.bool_]:
        """Which pixels the run did not call dynamic, shape (H, W)."""
        return np.asarray(self.p_dynamic < DYNAMIC_THRESHOLD)


@dataclass(frozen=True)
class RunResult:
    """All that a run left behind, apart from the map."""

    rows: tuple[FrameRow, ...]
    samples: tuple[Sample, ...]
    seconds: float | None = None
    """That the run took, reading included and what observers did left out; None if unknown."""

    @property
    def trajectory(self) -> Trajectory:
        """The poses of all frames that were tracked; lost frames have none."""
        return Trajectory(
            tuple(
                StampedPose(row.stamp_ns, row.T_world_camera)
                for row in self.rows
                if row.status is TrackingStatus.OK
            )
        )

    def count_metrics(self) -> list[Metric]:
        """Return how many frames came, were tracked, lost, and became keyframes."""
        lost = sum(row.status is TrackingStatus.LOST for row in self.rows)
        return [
            Metric('frames_in', len(self.rows)),
            Metric('frames_lost', lost),
            Metric('keyframes', sum(row.is_keyframe for row in self.rows)),
        ]

    def time_metrics(self) -> list[Metric]:
        """Return median and 95th percentile of each part over the frames in which it ran."""
        parts = dict.fromkeys(part for row in self.rows for part in row.times_ms)
        metrics = []
        for part in parts:
            times = [row.times_ms[part] for row in self.rows if part in row.times_ms]
            median, p95 = np.percentile(times, [50, 95])
            metrics += [
                Metric(f'{part}_median', float(median), 'ms'),
                Metric(f'{part}_p95', float(p95), 'ms'),
            ]
        if self.seconds:
            metrics.append(Metric('frames_per_s', len(self.rows) / self.seconds, 'Hz'))
        return metrics


@dataclass
class Recorder:
    """
    Collect the rows and an even choice of samples from a run of unknown length.

    Whenever `max_samples` is exceeded every second sample is dropped and the stride doubles, so
    the samples stay evenly spaced and memory bounded (2.5 MB per sample of 640x480). With
    `max_samples` 0 there are none.
    """

    max_samples: int = 40
    rows: list[FrameRow] = field(default_factory=list)
    samples: list[Sample] = field(default_factory=list)
    _stride: int = 1

    def add(
        self, frame: RgbdFrame, tracking: TrackingResult, times_ms: Mapping[str, float]
    ) -> None:
        """Take the outcome of one frame."""
        if self.max_samples and len(self.rows) % self._stride == 0:
            self._sample(frame, tracking)
        self.rows.append(
            FrameRow(
                tracking.stamp_ns,
                tracking.status,
                tracking.T_world_camera.copy(),
                tracking.is_keyframe,
                tracking.inlier_ratio,
                tracking.overlap,
                dict(times_ms),
                tracking.covariance.copy(),
            )
        )

    def give_up(self) -> None:
        """Count all frames so far as lost: the world that they were in is no more."""
        lost = TrackingStatus.LOST
        self.rows = [replace(row, status=lost, is_keyframe=False) for row in self.rows]
        nowhere = np.full((4, 4), np.nan)
        self.samples = [replace(sample, T_world_camera=nowhere) for sample in self.samples]

    def _sample(self, frame: RgbdFrame, tracking: TrackingResult) -> None:
        pose = tracking.T_world_camera.copy()
        if tracking.status is not TrackingStatus.OK:
            pose = np.full((4, 4), np.nan)
        self.samples.append(Sample(frame, pose, tracking.p_dynamic, tracking.is_keyframe))
        if len(self.samples) > self.max_samples:
            self.samples = self.samples[::2]
            self._stride *= 2

    def result(self, seconds: float | None = None) -> RunResult:
        """
        Return what has been collected so far; samples without a pose are left out.

        Parameters
        ----------
        seconds : float, optional
            See `RunResult`.

        """
        kept = tuple(s for s in self.samples if np.isfinite(s.T_world_camera).all())
        return RunResult(tuple(self.rows), kept, seconds)
