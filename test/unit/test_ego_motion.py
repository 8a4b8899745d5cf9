"""The small odometry of detection: what it believes of an alignment."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.detection import GeometricConfig
from bdgs_ros.core.types import Pose, RgbdFrame
from bdgs_ros.detection.ego_motion import DirectEgoMotion
from bdgs_ros.tracking.align import AlignResult

CAMERA = PinholeCamera(40, 30, 40.0, 40.0, 19.5, 14.5)


class Oracle:
    """An aligner that knows the truth; a frame's grey value is its number."""

    def __init__(self, poses: list[Pose], wrong: int = -1) -> None:
        self._poses, self._wrong = poses, wrong

    def pyramid(self, color: np.ndarray, *_: object) -> int:
        return int(color[0, 0, 0])

    def align(self, reference: int, current: int, guess: Pose) -> AlignResult:
        T = se3.inverse(self._poses[current]) @ self._poses[reference]
        if current == self._wrong:
            T = se3.exp(np.array([0.3, 0, 0, 0, 0, 0])) @ T
        shares = {'inlier_ratio': 0.9, 'texture': 0.9, 'coverage': 0.9, 'overlap': 1.0}
        residuals = {'depth_m': 2.0, 'median_intensity': 0.0, 'median_depth_sigma': 0.0}
        return AlignResult(
            T,
            np.eye(6),
            **shares,
            **residuals,
            iterations=1,
            converged=True,
            gain=1.0,
            bias=0.0,
            depth_pattern=np.zeros(3),
        )


def odometry(poses: list[Pose], rate_hz: float, wrong: int = -1) -> list[Pose | None]:
    """Run over frames of one grey each."""
    ego = DirectEgoMotion(GeometricConfig(width=40))
    ego._aligner = Oracle(poses, wrong)  # type: ignore[assignment]
    found = []
    for i in range(len(poses)):
        grey = np.full((30, 40, 3), i, np.uint8)
        frame = RgbdFrame(round(i * 1e9 / rate_hz), grey, np.ones((30, 40), np.float32), CAMERA)
        found.append(ego.update(frame, np.zeros((30, 40), np.uint8)))
    return found


def turning(deg_per_s: float, rate_hz: float, count: int = 40) -> list[Pose]:
    """A camera that turns evenly, from the first frame on."""
    step = np.deg2rad(deg_per_s) / rate_hz
    return [se3.exp(np.array([0, 0, 0, 0, i * step, 0])) for i in range(count)]


@pytest.mark.parametrize(('deg_per_s', 'rate_hz'), [(60, 30), (120, 30), (40, 60), (20, 90)])
def test_a_start_in_the_middle_of_a_turn(deg_per_s: float, rate_hz: float) -> None:
    poses = turning(deg_per_s, rate_hz)
    for true, found in zip(poses, odometry(poses, rate_hz), strict=True):
        assert found is not None
        np.testing.assert_allclose(found, true, atol=1e-9)


def test_a_jump_is_not_believed_and_the_next_frame_is() -> None:
    poses = turning(30, 30)
    found = odometry(poses, 30, wrong=20)
    assert found[20] is not None
    np.testing.assert_allclose(found[20], poses[20], atol=1e-6)
    np.testing.assert_allclose(found[21], poses[21], atol=1e-9)
