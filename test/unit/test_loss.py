"""The test for loss: limits, and what was usual before."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.config.tracking import LossConfig
from bdgs_ros.tracking.align import AlignResult
from bdgs_ros.tracking.loss import LossTest


def aligned(
    inliers: float = 0.9, coverage: float = 0.7, gain: float = 1.0, sigma_m: float = 0.01
) -> AlignResult:
    covariance = np.diag([1e-6, 1e-6, sigma_m**2, 1e-8, 1e-8, 1e-8])
    return AlignResult(
        se3.identity(), covariance, inliers, coverage, 0.9, 0.01, 0.5, 5, True, gain, 0.0,
        np.zeros(3),
    )  # fmt: skip


def usual(ratio: float) -> LossTest:
    test = LossTest(LossConfig())
    for _ in range(10):
        test.accept(aligned(ratio))
    return test


def test_a_good_frame_is_believed() -> None:
    assert usual(0.9).objection(aligned(0.85)) == ''
    assert LossTest(LossConfig()).objection(aligned(0.55)) == ''


@pytest.mark.parametrize(
    ('quality', 'word'),
    [
        (aligned(inliers=0.45), '45 % inliers'),
        (aligned(inliers=0.6), 'fell from 90 to 60 %'),
        (aligned(coverage=0.03), '3.0 % of the image'),
        (aligned(gain=0.05), 'gain 0.05'),
        (aligned(gain=-0.8), 'gain -0.80'),
        (aligned(gain=3.5), 'gain 3.50'),
        (aligned(sigma_m=0.4), '0.40 m'),
    ],
)
def test_each_limit_objects_in_words(quality: AlignResult, word: str) -> None:
    assert word in usual(0.9).objection(quality)


def test_what_is_usual_decides_what_is_too_little() -> None:
    """A noisy sensor agrees less with every map; that is no loss."""
    assert usual(0.9).objection(aligned(0.6))
    assert not usual(0.65).objection(aligned(0.6))


def test_a_turn_that_blurs_excuses_a_little() -> None:
    test = usual(0.9)
    assert test.objection(aligned(inliers=0.6))
    test.turn_rad_s = 2.0
    assert test.objection(aligned(inliers=0.6)) == ''
    assert test.objection(aligned(inliers=0.4))  # the limit for all frames stands
    high = LossTest(LossConfig(inlier_ratio=0.1))
    for _ in range(10):
        high.accept(aligned(0.9))
    high.turn_rad_s = 100.0
    assert high.objection(aligned(inliers=0.45))


def test_doubtful_is_what_only_the_frames_before_speak_against() -> None:
    test = usual(0.9)
    assert test.is_doubtful(aligned(inliers=0.6))
    for wrong in (aligned(0.45), aligned(coverage=0.03), aligned(gain=5), aligned(sigma_m=0.4)):
        assert not test.is_doubtful(wrong)


def test_sure_is_as_good_as_before_the_loss() -> None:
    test = usual(0.9)
    assert test.is_sure(aligned(0.85))
    assert not test.is_sure(aligned(0.75))
    test.reset()
    assert test.is_sure(aligned(0.75))


@pytest.mark.parametrize(
    ('depth', 'dynamic', 'expected'),
    [(0.5, 0.0, True), (0.02, 0.0, False), (0.0, 0.0, False), (1.0, 1.0, False), (1.0, 0.5, True)],
)
def test_frames_that_nothing_can_be_aligned_to(
    depth: float, dynamic: float, expected: bool
) -> None:
    """Shares of the width that have depth, and that move."""
    depth_m = np.full((100, 400), np.nan, np.float32)
    depth_m[:, : round(400 * depth)] = 2.0
    p_dynamic = np.zeros((100, 400), np.uint8)
    p_dynamic[:, : round(400 * dynamic)] = 255
    assert LossTest(LossConfig()).can_be_aligned_to(depth_m, p_dynamic) is expected
