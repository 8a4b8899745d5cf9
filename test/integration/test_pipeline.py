"""The whole method without ROS: accurate, repeatable, and at home on real recordings."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.core.types import StampedPose, TrackingStatus, Trajectory
from bdgs_ros.data.bag_recording import BagSequence
from bdgs_ros.data.layouts import open_sequence
from bdgs_ros.eval.trajectory import ate
from bdgs_ros.pipeline import BdgsSlam

SETTINGS = {'mapping.width': 160, 'mapping.iterations': 8, 'mapping.threads': 1}


def run(sequence: object, settings: dict[str, object], frames: int) -> Trajectory:
    slam = BdgsSlam(with_values(BdgsConfig(), settings))
    results = [slam.process(sequence[i]).tracking for i in range(frames)]
    assert all(r.status is TrackingStatus.OK for r in results)
    return Trajectory(tuple(StampedPose(r.stamp_ns, r.T_world_camera) for r in results))


def test_walkers_do_not_disturb_the_trajectory(bag: Path) -> None:
    sequence = BagSequence(bag)
    trajectory = run(sequence, SETTINGS, len(sequence))
    result = ate(sequence.ground_truth, trajectory, frames_expected=len(sequence))
    assert result.statistics.rmse < 0.005
    assert len(trajectory) == len(sequence)


def test_same_input_and_seed_give_the_same_trajectory(bag: Path) -> None:
    sequence = BagSequence(bag)
    first, second = (run(sequence, SETTINGS, 12) for _ in range(2))
    np.testing.assert_array_equal(first.matrices, second.matrices)


@pytest.mark.parametrize('switch', ['belief.enabled', 'belief.multi_view', 'mapping.enabled'])
def test_switches_of_table_6_keep_tracking(bag: Path, switch: str) -> None:
    sequence = BagSequence(bag)
    trajectory = run(sequence, {**SETTINGS, switch: False}, 12)
    assert ate(sequence.ground_truth, trajectory).statistics.rmse < 0.01


@pytest.mark.recording
@pytest.mark.parametrize(
    ('name', 'limit_m'),
    [('rgbd_bonn_crowd_part', 0.03), ('rgbd_dataset_freiburg1_rpy_part', 0.03)],
)
def test_the_start_of_real_recordings(shared_dir: Path, name: str, limit_m: float) -> None:
    sequence = open_sequence(shared_dir / 'data' / name)
    settings = {'mapping.iterations': 10, 'mapping.threads': 1}
    trajectory = run(sequence, settings, 60)
    assert ate(sequence.ground_truth, trajectory).statistics.rmse < limit_m
