"""ATE and RPE: exact cases, and evo as the oracle."""

from __future__ import annotations

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bdgs_ros.core import se3
from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.types import StampedPose, Trajectory
from bdgs_ros.eval import trajectory

PERIOD_NS = 33_333_333
START_NS = 1_548_339_819_000_000_000


def make_trajectory(rng: np.random.Generator, count: int, start_ns: int = START_NS) -> Trajectory:
    pose, poses = np.eye(4), []
    for i in range(count):
        poses.append(StampedPose(start_ns + i * PERIOD_NS, pose))
        pose = pose @ se3.exp(rng.normal(0.0, 0.02, 6) + np.array([0.01, 0, 0.005, 0, 0.02, 0]))
    return Trajectory(tuple(poses))


def disturbed(rng: np.random.Generator, truth: Trajectory, shift_ns: int = 0) -> Trajectory:
    """Return the truth in another world, with noise on every pose."""
    T_est_gt = se3.exp(np.array([1.0, -2.0, 0.5, 0.7, -1.1, 2.0]))
    return Trajectory(
        tuple(
            StampedPose(
                p.stamp_ns + shift_ns,
                T_est_gt @ p.T_world_camera @ se3.exp(rng.normal(0.0, 0.01, 6)),
            )
            for p in truth.poses
        )
    )


def to_evo(t: Trajectory):
    from evo.core.trajectory import PoseTrajectory3D

    return PoseTrajectory3D(poses_se3=list(t.matrices), timestamps=t.stamps_ns * 1e-9)


def test_a_rigid_motion_of_the_truth_has_no_error():
    truth = make_trajectory(np.random.default_rng(0), 40)
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.3, -2.0, 1.0]))
    moved = Trajectory(tuple(StampedPose(p.stamp_ns, T @ p.T_world_camera) for p in truth.poses))
    result = trajectory.ate(truth, moved)
    assert result.statistics.max < 1e-9
    assert np.allclose(result.T_gt_est @ T, np.eye(4), atol=1e-9)
    assert trajectory.rpe_frames(truth, moved).translation.max < 1e-9


def test_scale_is_not_taken_out():
    points = np.array([[-1.0, 0, 0], [1, 0, 0], [0, 1, 0], [0, -1, 0]])
    truth, est = (
        Trajectory(
            tuple(
                StampedPose(i * PERIOD_NS, se3.from_rotation_translation(np.eye(3), s * p))
                for i, p in enumerate(points)
            )
        )
        for s in (1.0, 2.0)
    )
    assert trajectory.ate(truth, est).statistics.rmse == pytest.approx(1.0)


def test_alignment_never_mirrors():
    rng = np.random.default_rng(1)
    points = rng.normal(size=(30, 3))
    T = trajectory.align(points, points * np.array([1.0, 1.0, -1.0]))
    assert np.linalg.det(T[:3, :3]) == pytest.approx(1.0)
    assert np.allclose(T[:3, :3] @ T[:3, :3].T, np.eye(3), atol=1e-12)


def test_a_camera_at_rest_is_aligned_by_its_position():
    truth = Trajectory(tuple(StampedPose(i * PERIOD_NS, np.eye(4)) for i in range(5)))
    T = se3.exp(np.array([1.0, 2.0, 3.0, 0.0, 0.0, 0.0]))
    est = Trajectory(tuple(StampedPose(i * PERIOD_NS, T) for i in range(5)))
    assert trajectory.ate(truth, est).statistics.max < 1e-12


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('shift_ns', [0, 4_000_000, -4_000_000])
def test_ate_agrees_with_evo(seed, shift_ns):
    metrics = pytest.importorskip('evo.core.metrics')
    sync = pytest.importorskip('evo.core.sync')
    rng = np.random.default_rng(seed)
    truth = make_trajectory(rng, 120)
    est = disturbed(rng, Trajectory(truth.poses[5:100]), shift_ns)
    ours = trajectory.ate(truth, est)
    evo_gt, evo_est = sync.associate_trajectories(to_evo(truth), to_evo(est), max_diff=0.02)
    evo_est.align(evo_gt)
    ape = metrics.APE(metrics.PoseRelation.translation_part)
    ape.process_data((evo_gt, evo_est))
    theirs = ape.get_all_statistics()
    assert ours.pairs == evo_est.num_poses
    for name, value in theirs.items():
        if name != 'sse':
            assert getattr(ours.statistics, name) == pytest.approx(value, abs=1e-6), name


@pytest.mark.parametrize('step', [1, 30])
def test_rpe_agrees_with_evo(step):
    metrics = pytest.importorskip('evo.core.metrics')
    rng = np.random.default_rng(7)
    truth = make_trajectory(rng, 90)
    est = disturbed(rng, truth)
    ours = trajectory.rpe_frames(truth, est, step)
    for relation, errors in (
        (metrics.PoseRelation.translation_part, ours.translation),
        (metrics.PoseRelation.rotation_angle_deg, ours.rotation),
    ):
        rpe = metrics.RPE(relation, delta=step, delta_unit=metrics.Unit.frames, all_pairs=True)
        rpe.process_data((to_evo(truth), to_evo(est)))
        for name, value in rpe.get_all_statistics().items():
            if name != 'sse':
                assert getattr(errors, name) == pytest.approx(value, abs=1e-6), name


def test_one_second_is_thirty_frames_at_thirty_hertz():
    rng = np.random.default_rng(8)
    truth = make_trajectory(rng, 70)
    est = disturbed(rng, truth)
    per_second = trajectory.rpe_seconds(truth, est)
    frames = trajectory.rpe_frames(truth, est, 30)
    assert (per_second.pairs, per_second.translation) == (frames.pairs, frames.translation)


def test_coverage_counts_the_frames_that_are_missing():
    rng = np.random.default_rng(2)
    truth = make_trajectory(rng, 100)
    est = disturbed(rng, Trajectory(truth.poses[:20] + truth.poses[45:]))
    assert trajectory.ate(truth, est).coverage_percent == pytest.approx(75.0)
    assert trajectory.ate(truth, est, frames_expected=150).coverage_percent == 50.0
    with pytest.raises(EvaluationError, match=r'75 poses .* only 10 frames'):
        trajectory.ate(truth, est, frames_expected=10)


def test_frames_without_ground_truth_are_not_compared():
    truth = make_trajectory(np.random.default_rng(3), 10)
    est = disturbed(np.random.default_rng(3), make_trajectory(np.random.default_rng(3), 30))
    assert trajectory.ate(truth, est).pairs == 10


def test_trajectories_of_other_times_are_refused_with_both_spans():
    rng = np.random.default_rng(4)
    truth = make_trajectory(rng, 10)
    other = make_trajectory(rng, 10, START_NS + 10**12)
    with pytest.raises(EvaluationError, match=r'0 of 10 .* 20 ms.*1548340819\.000'):
        trajectory.ate(truth, other)


def test_empty_and_unsorted_are_refused():
    truth = make_trajectory(np.random.default_rng(5), 10)
    with pytest.raises(EvaluationError, match='estimate has no poses'):
        trajectory.ate(truth, Trajectory())
    with pytest.raises(EvaluationError, match='ground truth goes back in time at pose 1 of 10'):
        trajectory.ate(Trajectory(truth.poses[::-1]), truth)


def test_rotation_error_is_in_degrees():
    truth = make_trajectory(np.random.default_rng(6), 10)
    turn = se3.from_rotation_translation(
        Rotation.from_rotvec([0, 0, np.radians(2.0)]).as_matrix(), np.zeros(3)
    )
    pose, poses = np.eye(4), []
    for i, p in enumerate(truth.poses):
        if i:
            step = se3.inverse(truth.poses[i - 1].T_world_camera) @ p.T_world_camera
            pose = pose @ step @ turn
        poses.append(StampedPose(p.stamp_ns, pose))
    result = trajectory.rpe_frames(truth, Trajectory(tuple(poses)))
    assert result.rotation.min == pytest.approx(2.0) == result.rotation.max
