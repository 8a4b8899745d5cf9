"""The velocity at a keyframe: from both sides, steady, and blind to the jump of a correction."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.back_end.velocity import velocity_at
from bdgs_ros.core import se3

FRAME_NS = 33_000_000
TURN = np.array([0.1, 0, 0, 0, 1.0, 0])


def turning(acceleration: float, count: int = 9) -> list[tuple[int, np.ndarray]]:
    """Turn about one axis; frame 4 is the keyframe, where the rate is that of `TURN`."""
    times = (np.arange(count) - 4) * FRAME_NS * 1e-9
    angles = TURN[4] * times + acceleration * times**2 / 2
    poses = [se3.exp(np.array([0, 0, 0, 0, angle, 0])) for angle in angles]
    return [(i * FRAME_NS, pose) for i, pose in enumerate(poses)]


def test_a_steady_motion_is_measured_from_either_side() -> None:
    poses = [(i * FRAME_NS, se3.exp(i * FRAME_NS * 1e-9 * TURN)) for i in range(9)]
    for stamp_ns in (0, 4 * FRAME_NS, 8 * FRAME_NS):
        assert velocity_at(stamp_ns, poses) == pytest.approx(TURN, abs=0.05)


def test_frames_on_both_sides_tell_the_velocity_of_a_camera_that_speeds_up() -> None:
    tracked = turning(8.0)
    assert velocity_at(4 * FRAME_NS, tracked)[4] == pytest.approx(1.0, abs=0.05)
    late = velocity_at(4 * FRAME_NS, tracked[:5])[4]
    assert 0.6 < late < 0.95  # what comes is not known yet


def test_the_correction_after_a_keyframe_is_no_motion() -> None:
    jump = se3.exp(np.array([0.02, 0, 0, 0, 0.02, 0]))
    tracked = [(s, T if i <= 4 else jump @ T) for i, (s, T) in enumerate(turning(0.0))]
    assert velocity_at(4 * FRAME_NS, tracked)[4] == pytest.approx(1.0, abs=0.02)


def test_nothing_is_known_of_the_first_frame_or_after_a_gap() -> None:
    assert not velocity_at(0, [(0, np.eye(4))]).any()
    assert not velocity_at(FRAME_NS, [(-2_000_000_000, np.eye(4)), (FRAME_NS, np.eye(4))]).any()
