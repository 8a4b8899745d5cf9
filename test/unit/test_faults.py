"""Faulty recordings: what is covered, where they jump, and what truth they carry."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import RgbdFrame, StampedPose, Trajectory
from bdgs_ros.data import faults

CAMERA = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5)
PERIOD_NS = 33_000_000


class Straight:
    """A camera that moves 1 cm per frame; its images are numbered by their brightness."""

    name = 'straight'
    camera = CAMERA

    def __init__(self, count: int) -> None:
        self.stamps_ns = 10**9 + PERIOD_NS * np.arange(count)
        poses = [
            StampedPose(int(s), se3.exp(np.array([0.01 * i, 0, 0, 0, 0, 0])))
            for i, s in enumerate(self.stamps_ns)
        ]
        self.ground_truth = Trajectory(tuple(poses))

    def __len__(self) -> int:
        return len(self.stamps_ns)

    def __getitem__(self, index: int) -> RgbdFrame:
        color = np.full((24, 32, 3), index, np.uint8)
        depth_m = np.full((24, 32), 2.0, np.float32)
        return RgbdFrame(int(self.stamps_ns[index]), color, depth_m, CAMERA)


@pytest.mark.parametrize(
    ('cover', 'depth_m'), [(faults.black, 0.0), (faults.grey, 0.0), (faults.wall, 1.5)]
)
def test_a_cover_hides_the_view_for_its_time_and_no_longer(cover, depth_m: float) -> None:
    faulty = faults.covered(Straight(90), 30, 1.0, cover)
    frames = list(faulty)
    hidden = [i for i, frame in enumerate(frames) if frame.color.std() > 0]
    assert hidden == list(faulty.covered)
    assert len(hidden) * PERIOD_NS == pytest.approx(1e9, abs=PERIOD_NS)
    assert np.median(frames[31].depth_m) == pytest.approx(depth_m, abs=0.01)
    assert np.array_equal(faulty[31].color, frames[31].color)
    assert frames[29].color[0, 0, 0] == 29 and frames[-1].color[0, 0, 0] == 89


def test_a_jump_is_far_enough_and_goes_back_to_what_was_seen() -> None:
    sequence = Straight(150)
    jump = faults.choose_jump(sequence.ground_truth, sequence.stamps_ns, distance_m=0.3)
    assert (jump.at, jump.to) == (149, 45)
    assert jump.distance_m == pytest.approx(1.04)
    faulty = faults.jumped(sequence, jump)
    assert faulty[jump.at].color[0, 0, 0] == 149
    assert faulty[jump.at + 1].color[0, 0, 0] == 45
    assert np.all(np.diff(faulty.stamps_ns) == PERIOD_NS)
    truth = faulty.ground_truth
    assert truth is not None and len(truth) == len(faulty)
    assert truth.positions[jump.at + 1, 0] == pytest.approx(0.45)


def test_a_camera_that_hardly_moves_jumps_as_far_as_it_can() -> None:
    sequence = Straight(120)
    jump = faults.choose_jump(sequence.ground_truth, sequence.stamps_ns, distance_m=50.0)
    assert jump.distance_m == pytest.approx(0.74)


def test_a_short_recording_cannot_jump() -> None:
    sequence = Straight(60)
    with pytest.raises(DatasetError, match='60 frames are too few'):
        faults.choose_jump(sequence.ground_truth, sequence.stamps_ns)


def test_where_depth_alone_is_lost_the_colour_stays() -> None:
    faulty = faults.covered(Straight(90), 30, 1.0, faults.blind)
    without = [i for i, frame in enumerate(faulty) if not frame.depth_m.any()]
    assert without == list(faulty.covered)
    assert all((faulty[i].color == i).all() for i in without)
