"""Errors over covariances."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.types import StampedPose, TrackingStatus, Trajectory
from bdgs_ros.eval.honesty import WITHIN, honesty_metrics
from bdgs_ros.eval.recorder import FrameRow

COUNT = 400
SIGMA_M = np.array([0.05, 0.01, 0.02])


def trajectories() -> tuple[Trajectory, Trajectory]:
    """A walk round a block, and the same with noise along the axes of a camera that turns."""
    rng = np.random.default_rng(0)
    gt, est = [], []
    for i in range(COUNT):
        angle = 2 * np.pi * i / COUNT
        T = se3.exp(np.array([0, 0, 0, 0.3, 2 * angle - 6, 0.1]))
        T[:3, 3] = 5 * np.cos(angle), 5 * np.sin(angle), np.sin(3 * angle)
        off = np.concatenate([SIGMA_M * rng.normal(size=3), np.zeros(3)])
        gt.append(StampedPose(i * 10**8, T))
        est.append(StampedPose(i * 10**8, T @ se3.exp(off)))
    return Trajectory(tuple(gt)), Trajectory(tuple(est))


def metrics(scale: float) -> dict[str, float]:
    gt, est = trajectories()
    covariance = scale**2 * np.diag([*SIGMA_M**2, 1e-6, 1e-6, 1e-6])
    rows = [
        FrameRow(p.stamp_ns, TrackingStatus.OK, p.T_world_camera, False, 1, 1, {}, covariance)
        for p in est.poses
    ]
    return {m.name: m.value for m in honesty_metrics(gt, est, rows)}


def test_honest_covariances() -> None:
    found = metrics(1.0)
    assert found['nees'] == pytest.approx(3.0, rel=0.15)
    assert found['beyond_3_sigma'] < 2
    for share in WITHIN:
        assert found[f'within_{share}'] == pytest.approx(share, abs=6)


def test_boasting_shows() -> None:
    found = metrics(0.2)
    assert found['nees'] == pytest.approx(75.0, rel=0.15)
    assert found['beyond_3_sigma'] > 80


def test_without_covariances_nothing_is_said() -> None:
    gt, est = trajectories()
    rows = [
        FrameRow(p.stamp_ns, TrackingStatus.OK, p.T_world_camera, False, 1, 1, {})
        for p in est.poses
    ]
    assert honesty_metrics(gt, est, rows) == []
