"""A recording forth and back."""

from __future__ import annotations

import numpy as np
import pytest
from run_fakes import PERIOD_NS, START_NS, FakeSequence, FakeTruth, true_mask, true_pose

from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.loop import LoopedSequence, LoopedTruth, forth_and_back


class Stamped(FakeSequence):
    @property
    def stamps_ns(self):
        return START_NS + PERIOD_NS * np.arange(self.count)


def test_frames_go_forth_and_back_without_repeats():
    assert forth_and_back(4, 12).tolist() == [0, 1, 2, 3, 2, 1, 0, 1, 2, 3, 2, 1]
    assert forth_and_back(2, 4).tolist() == [0, 1, 0, 1]


def test_a_loop_is_a_sequence_whose_time_only_grows():
    sequence = Stamped(5)
    loop = LoopedSequence(sequence, 12)
    frames = list(loop)
    assert len(loop) == len(frames) == 12
    assert [f.stamp_ns for f in frames] == loop.stamps_ns.tolist()
    assert np.all(np.diff(loop.stamps_ns) == PERIOD_NS)
    for place, frame in enumerate(frames):
        assert np.array_equal(frame.color, sequence[loop.source_index(place)].color)


def test_uneven_periods_keep_their_length_on_the_way_back():
    class Uneven(Stamped):
        @property
        def stamps_ns(self):
            return np.array([0, 10, 40], np.int64)

    assert LoopedSequence(Uneven(3), 5).stamps_ns.tolist() == [0, 10, 40, 70, 80]


def test_ground_truth_and_truth_belong_to_the_frames():
    loop = LoopedSequence(Stamped(5), 14)
    poses = loop.ground_truth.poses
    assert [p.stamp_ns for p in poses] == loop.stamps_ns.tolist()
    truth = LoopedTruth(FakeTruth(), loop)
    for place, pose in enumerate(poses):
        source = loop.source_index(place)
        assert np.array_equal(pose.T_world_camera, true_pose(source))
        assert np.array_equal(truth.dynamic(pose.stamp_ns), true_mask(source))


def test_what_cannot_be_looped_is_refused():
    with pytest.raises(DatasetError, match="'fake' with 1 frames cannot be looped to 9"):
        LoopedSequence(Stamped(1), 9)


def test_a_run_can_be_looped(tmp_path):
    from bdgs_ros.core.config import BdgsConfig, with_values
    from bdgs_ros.data.synth import write_recording
    from bdgs_ros.job import Job, run_job

    write_recording(tmp_path / 'in', 'walking_xyz', 3, 8, size=(160, 120), jobs=1)
    config = with_values(BdgsConfig(), {'mapping.iterations': 2, 'mapping.width': 80})
    job = Job(tmp_path / 'in', tmp_path / 'out', config, loop_frames=20, pictures=False)
    figures = {k: v['value'] for k, v in run_job(job)['metrics'].items()}
    assert figures['frames_in'] == 20
    assert figures['coverage'] == 100.0
    assert figures['ate_rmse'] < 5
    assert np.isfinite(figures['dynamic_recall'])  # there was a truth to every frame
