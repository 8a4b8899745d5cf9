"""A run's rows, samples, figures and files."""

from __future__ import annotations

import json
import logging

import numpy as np
import pytest
from run_fakes import FakeSequence, FakeSlam, FakeTruth

from bdgs_ros.core.types import StampedPose, TrackingStatus, Trajectory
from bdgs_ros.data.trajectory_io import read_trajectory
from bdgs_ros.eval.recorder import Recorder
from bdgs_ros.runner import LabelObserver, run_sequence, write_results


@pytest.fixture
def run():
    sequence, slam = FakeSequence(12), FakeSlam(lost=(5, 6))
    labels = LabelObserver(FakeTruth())
    return sequence, slam, run_sequence(sequence, slam, [labels]), labels


def test_every_frame_has_a_row_and_lost_ones_no_pose(run):
    sequence, _, result, _ = run
    assert len(result.rows) == 12
    assert sum(r.status is TrackingStatus.LOST for r in result.rows) == 2
    stamps = {p.stamp_ns for p in result.trajectory.poses}
    assert stamps == {sequence[i].stamp_ns for i in range(12) if i not in (5, 6)}


def test_a_final_trajectory_from_elsewhere_is_saved_and_scored(run, tmp_path):
    sequence, _, result, _ = run
    off = np.eye(4)
    off[:3, 3] = 0.0, 0.0, 0.1
    poses = result.trajectory.poses
    final = Trajectory(
        tuple(
            StampedPose(p.stamp_ns, p.T_world_camera @ off if i % 2 else p.T_world_camera)
            for i, p in enumerate(poses)
        )
    )
    metrics = write_results(
        tmp_path, result, ground_truth=sequence.ground_truth, final=final, with_pictures=False
    )['metrics']
    assert len(read_trajectory(tmp_path / 'trajectory_final.txt')) == len(poses)
    assert metrics['ate_final_rmse']['value'] > metrics['ate_rmse']['value'] + 1.0  # cm


def test_mapping_is_timed_on_keyframes_alone(run):
    result = run[2]
    assert [('mapping' in r.times_ms) for r in result.rows] == [r.is_keyframe for r in result.rows]
    for row in result.rows:
        parts = sum(v for k, v in row.times_ms.items() if k != 'frame')
        assert parts <= row.times_ms['frame']


def test_stages_are_put_back_after_an_error():
    slam = FakeSlam()
    before = (slam.detection, slam.tracker, slam.mapper)

    def broken():
        yield FakeSequence()[0]
        raise RuntimeError('the recording ends early')

    with pytest.raises(RuntimeError):
        run_sequence(broken(), slam)
    assert (slam.detection, slam.tracker, slam.mapper) == before


def test_samples_stay_even_and_few():
    sequence, slam, recorder = FakeSequence(100), FakeSlam(), Recorder(max_samples=10)
    result = run_sequence(sequence, slam, recorder=recorder)
    stamps = np.array([s.frame.stamp_ns for s in result.samples])
    assert 5 <= len(stamps) <= 10
    assert len(set(np.diff(stamps))) == 1


def test_results_are_complete(run, tmp_path):
    sequence, slam, result, labels = run
    metrics = write_results(
        tmp_path / 'out',
        result,
        slam.mapper,
        name='fake',
        ground_truth=sequence.ground_truth,
        truth=FakeTruth(),
        more=labels.score.metrics(),
    )
    values = {name: entry['value'] for name, entry in metrics['metrics'].items()}
    assert values['ate_rmse'] == pytest.approx(0.0, abs=1e-5)
    assert values['coverage'] == pytest.approx(100 * 10 / 12)
    assert values['dynamic_precision'] == values['dynamic_recall'] == 1.0
    assert values['psnr'] == pytest.approx(40.0, abs=0.1)
    assert values['depth_l1'] == pytest.approx(10.0, abs=1e-3)
    assert values['gaussians'] == 7
    assert values['keyframes'] == 3
    assert metrics['notes'] == []
    assert json.loads((tmp_path / 'out/metrics.json').read_text())['sequence'] == 'fake'
    for name in ('trajectory.txt', 'trajectory_final.txt'):
        stamps = read_trajectory(tmp_path / 'out' / name).stamps_ns.tolist()
        assert stamps == [sequence[i].stamp_ns for i in range(12) if i not in (5, 6)]
    made = {p.name for p in (tmp_path / 'out').iterdir()}
    assert made == {
        'trajectory.txt',
        'trajectory_final.txt',
        'map.ply',
        'metrics.json',
        'tiles.png',
        'animation.gif',
        'trajectory.png',
    }


def test_without_truth_moving_pixels_do_not_count(run, tmp_path):
    _, slam, result, _ = run
    metrics = write_results(tmp_path, result, slam.mapper, with_pictures=False)
    assert metrics['metrics']['psnr']['value'] == pytest.approx(40.0, abs=0.1)
    assert 'psnr_hidden' not in metrics['metrics']
    assert not (tmp_path / 'tiles.png').exists()


def test_a_foreign_ground_truth_is_a_note(run, tmp_path, caplog):
    _, slam, result, _ = run
    foreign = Trajectory(tuple(StampedPose(i * 10**9, np.eye(4)) for i in range(5)))
    with caplog.at_level(logging.WARNING):
        metrics = write_results(
            tmp_path, result, slam.mapper, ground_truth=foreign, with_pictures=False
        )
    assert 'ate_rmse' not in metrics['metrics']
    assert '0 of 10 estimated poses' in metrics['notes'][0]
    assert (tmp_path / 'trajectory.txt').exists()


def test_a_run_that_never_tracked_still_reports(tmp_path):
    sequence, slam = FakeSequence(4), FakeSlam(lost=(0, 1, 2, 3))
    result = run_sequence(sequence, slam)
    metrics = write_results(tmp_path, result, slam.mapper, ground_truth=sequence.ground_truth)
    assert metrics['metrics']['coverage']['value'] == 0.0
    assert metrics['metrics']['frames_lost']['value'] == 4
