"""Stand-ins for recording and pipeline, so that the harness is tested without the method."""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import (
    Labels,
    RgbdFrame,
    StampedPose,
    TrackingResult,
    TrackingStatus,
    Trajectory,
)
from bdgs_ros.mapping.history import History

CAMERA = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5)
PERIOD_NS = 33_333_333
START_NS = 1_700_000_000_000_000_000


def true_pose(i: int) -> np.ndarray:
    return se3.exp(np.array([0.02 * i, 0.1 * np.sin(i / 3), 0.01 * i, 0.0, 0.01 * i, 0.0]))


def true_mask(i: int) -> np.ndarray:
    mask = np.zeros(CAMERA.shape, bool)
    mask[5:15, i % 20 : i % 20 + 8] = True
    return mask


def static_color() -> np.ndarray:
    v, u = np.mgrid[: CAMERA.height, : CAMERA.width]
    return np.stack([u * 7, v * 9, u + v], axis=-1).astype(np.uint8)


@dataclass
class FakeSequence:
    """A camera that drifts past a wall while a grey block crosses the view."""

    count: int = 12
    name: str = 'fake'
    ground_truth: Trajectory | None = None

    def __post_init__(self) -> None:
        self.ground_truth = Trajectory(
            tuple(StampedPose(START_NS + i * PERIOD_NS, true_pose(i)) for i in range(self.count))
        )

    def __len__(self) -> int:
        return self.count

    def __getitem__(self, i: int) -> RgbdFrame:
        if not 0 <= i < self.count:
            raise IndexError(i)
        color = static_color()
        color[true_mask(i)] = 128
        depth = np.full(CAMERA.shape, 2.0, np.float32)
        return RgbdFrame(START_NS + i * PERIOD_NS, color, depth, CAMERA)


class FakeTruth:
    def dynamic(self, stamp_ns: int) -> np.ndarray:
        return true_mask(round((stamp_ns - START_NS) / PERIOD_NS))

    def static_color(self, stamp_ns: int) -> np.ndarray:
        return static_color()

    def static_depth(self, stamp_ns: int) -> np.ndarray:
        return np.full(CAMERA.shape, 2.0, np.float32)


@dataclass
class FakeRender:
    color: np.ndarray
    depth: np.ndarray
    silhouette: np.ndarray


@dataclass
class FakeMapper:
    """Shows the true wall, one grey level off."""

    def process(self, keyframe: Any) -> None:
        return None

    def render(self, T_world_camera: np.ndarray, camera: PinholeCamera) -> FakeRender:
        color = static_color().astype(np.float32) / 255.0 + 0.01
        return FakeRender(
            color, np.full(camera.shape, 2.1, np.float32), np.ones(camera.shape, np.float32)
        )

    history: History = field(default_factory=History)

    def as_photograph(
        self, rendered: FakeRender, camera: PinholeCamera, stamp_ns: int
    ) -> FakeRender:
        return rendered

    def final_pose(self, stamp_ns: int, T_world_camera: np.ndarray) -> np.ndarray:
        return T_world_camera

    def final_trajectory(self, online: Trajectory) -> Trajectory:
        return online

    def save(self, path: Path, *, keyframes: bool = True) -> None:
        path.write_bytes(b'ply\nformat binary_little_endian 1.0\nelement vertex 7\nend_header\n')


class FakeStage:
    def process(self, *_: Any) -> None:
        return None


@dataclass
class FakeOutcome:
    tracking: TrackingResult
    gave_up: bool = False


@dataclass
class FakeSlam:
    """Knows the truth; loses frames `lost`, makes every fourth frame a keyframe."""

    lost: tuple[int, ...] = ()
    detection: Any = field(default_factory=FakeStage)
    tracker: Any = field(default_factory=FakeStage)
    back_end: Any = field(default_factory=FakeStage)
    mapper: Any = field(default_factory=FakeMapper)
    _count: int = 0

    def process(self, frame: RgbdFrame) -> FakeOutcome:
        i = self._count
        self._count += 1
        labels = Labels(frame.stamp_ns, np.where(true_mask(i), 255, 0).astype(np.uint8))
        self.detection.process(frame)
        self.tracker.process(frame, labels)
        is_keyframe = i % 4 == 0
        if is_keyframe:
            self.mapper.process(frame)
        status = TrackingStatus.LOST if i in self.lost else TrackingStatus.OK
        return FakeOutcome(
            TrackingResult(
                frame.stamp_ns,
                status,
                se3.inverse(true_pose(0)) @ true_pose(i),
                np.eye(6),
                is_keyframe,
                labels.p_dynamic,
            )
        )
