"""The motion predictor: screw motions are exact, jumps are heard, certainty fades with time."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.config.tracking import MotionConfig
from bdgs_ros.tracking.motion import MotionPredictor

PERIOD_NS = 33_000_000
VELOCITY = np.array([0.4, -0.1, 0.2, 0.3, 0.5, -0.2])
NOISE = np.diag([1e-6] * 6)


def pose_at(frame: int) -> np.ndarray:
    """Return the camera on a screw that starts somewhere."""
    start = se3.exp(np.array([1.0, 2.0, -0.5, 0.3, -0.8, 0.1]))
    return start @ se3.exp(VELOCITY * frame * PERIOD_NS * 1e-9)


def follow(predictor: MotionPredictor, frames: int, sigma: float = 0.0) -> None:
    rng = np.random.default_rng(3)
    for frame in range(frames):
        error = se3.exp(sigma * rng.standard_normal(6))
        predictor.update(frame * PERIOD_NS, pose_at(frame) @ error, NOISE + sigma**2 * np.eye(6))


def error_of(predictor: MotionPredictor, frame: int) -> np.ndarray:
    predicted, _ = predictor.predict(frame * PERIOD_NS)
    return se3.log(se3.inverse(pose_at(frame)) @ predicted)


def test_a_screw_motion_is_predicted_exactly() -> None:
    predictor = MotionPredictor(MotionConfig())
    follow(predictor, 30)
    assert np.abs(error_of(predictor, 30)).max() < 1e-6
    assert np.abs(error_of(predictor, 33)).max() < 1e-5


def test_noisy_poses_predict_about_as_well_as_they_are_measured() -> None:
    predictor = MotionPredictor(MotionConfig(acceleration_sigma=0.1))
    follow(predictor, 60, sigma=0.002)
    assert np.linalg.norm(error_of(predictor, 60)[:3]) < 0.006


def test_prediction_beats_the_last_pose() -> None:
    on, off = MotionPredictor(MotionConfig()), MotionPredictor(MotionConfig(model='none'))
    for predictor in (on, off):
        follow(predictor, 20, sigma=0.001)
    assert np.linalg.norm(error_of(on, 20)) < 0.5 * np.linalg.norm(error_of(off, 20))


def test_switched_off_it_returns_the_last_pose() -> None:
    predictor = MotionPredictor(MotionConfig(model='none'))
    follow(predictor, 10)
    predicted, _ = predictor.predict(10 * PERIOD_NS)
    assert np.allclose(predicted, pose_at(9), atol=1e-3)


def test_plain_velocity_repeats_the_last_motion() -> None:
    predictor = MotionPredictor(MotionConfig(model='velocity'))
    follow(predictor, 2)
    assert (
        np.abs(error_of(predictor, 2)).max() < 1e-9
    )  # two poses are enough, where a filter learns
    kalman = MotionPredictor(MotionConfig())
    follow(kalman, 2)
    assert np.abs(error_of(kalman, 2)).max() > 1e-6


def test_plain_velocity_carries_the_noise_of_two_poses() -> None:
    predictor = MotionPredictor(MotionConfig(model='velocity'))
    follow(predictor, 30)
    _, covariance = predictor.predict(30 * PERIOD_NS)
    # x + (x - y) has 4 + 1 times the noise of one pose; acceleration adds to it
    assert np.diag(covariance)[0] > 5 * NOISE[0, 0]


def test_covariance_grows_with_time_and_prediction_changes_nothing() -> None:
    predictor = MotionPredictor(MotionConfig())
    follow(predictor, 10)
    traces = [np.trace(predictor.predict((9 + k) * PERIOD_NS)[1]) for k in (1, 2, 5, 10)]
    assert traces == sorted(traces) and traces[0] > 0
    assert np.trace(predictor.predict(10 * PERIOD_NS)[1]) == traces[0]


def test_a_jump_starts_the_velocity_anew() -> None:
    predictor = MotionPredictor(MotionConfig())
    follow(predictor, 20)
    jump = pose_at(20) @ se3.exp(np.array([2.0, 0, 0, 0, 0, 0]))
    predictor.update(20 * PERIOD_NS, jump, NOISE)
    predicted, _ = predictor.predict(21 * PERIOD_NS)
    assert np.allclose(predicted, jump, atol=1e-9)


def test_it_recovers_the_velocity_after_a_jump() -> None:
    predictor = MotionPredictor(MotionConfig())
    follow(predictor, 5)
    predictor.update(5 * PERIOD_NS, se3.exp(np.array([5.0, 0, 0, 0, 0, 0])), NOISE)
    for frame in range(6, 30):
        predictor.update(frame * PERIOD_NS, pose_at(frame), NOISE)
    assert np.abs(error_of(predictor, 30)).max() < 1e-5


@pytest.mark.parametrize('stamp_ns', [9 * PERIOD_NS, 3 * PERIOD_NS])
def test_time_must_go_on(stamp_ns: int) -> None:
    predictor = MotionPredictor(MotionConfig())
    follow(predictor, 10)
    with pytest.raises(ValueError, match='later than 297000000'):
        predictor.predict(stamp_ns)
    with pytest.raises(ValueError, match='reset'):
        predictor.update(stamp_ns, se3.identity(), NOISE)
    predictor.reset()
    predictor.update(stamp_ns, se3.identity(), NOISE)


def test_before_the_first_pose_the_prediction_is_the_origin() -> None:
    predicted, covariance = MotionPredictor(MotionConfig()).predict(5)
    assert np.array_equal(predicted, se3.identity()) and covariance.shape == (6, 6)


def test_adjoint_moves_a_tangent_to_the_other_side() -> None:
    T = se3.exp(np.array([0.3, -0.2, 0.5, 0.4, 0.1, -0.6]))
    xi = np.array([0.01, 0.02, -0.01, 0.03, -0.02, 0.01])
    assert np.allclose(T @ se3.exp(xi), se3.exp(se3.adjoint(T) @ xi) @ T)


def test_an_unseen_camera_does_not_run_away() -> None:
    predictor = MotionPredictor(MotionConfig(coast_s=0.2))
    follow(predictor, 20)
    far = [predictor.predict((19 + k) * PERIOD_NS)[0] for k in (6, 30, 300)]
    assert np.allclose(far[1], far[2])
    travelled = np.linalg.norm(se3.log(se3.inverse(pose_at(19)) @ far[2])[:3])
    assert travelled == pytest.approx(0.2 * np.linalg.norm(VELOCITY[:3]), rel=0.01)


@pytest.mark.parametrize('off', [0.0, 0.05, 2.0])  # as expected, beside it, outside the gate
def test_to_ask_what_the_velocity_would_be_changes_nothing(off: float) -> None:
    asked, other = MotionPredictor(MotionConfig()), MotionPredictor(MotionConfig())
    push = se3.exp(np.array([off, 0, 0, 0, 0, 0]))
    for predictor in (asked, other):
        follow(predictor, 10)
    would_be = asked.velocity_with(10 * PERIOD_NS, pose_at(10) @ push, NOISE)
    for predictor in (asked, other):
        predictor.update(10 * PERIOD_NS, pose_at(10) @ push, NOISE)
    assert np.array_equal(asked.velocity, would_be)
    (pose, spread), (same, same_spread) = (p.predict(11 * PERIOD_NS) for p in (asked, other))
    assert np.array_equal(pose, same)
    assert np.array_equal(spread, same_spread)
