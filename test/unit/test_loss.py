"""The test for loss: what the images leave open."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.config.tracking import LossConfig
from bdgs_ros.tracking.align import AlignResult
from bdgs_ros.tracking.loss import LossTest
from bdgs_ros.tracking.starts import Estimate


def aligned(
    inliers: float = 0.9, sigma_m: float = 0.01, sigma_rad: float = 0.002, depth_m: float = 2.0
) -> AlignResult:
    covariance = np.diag([1e-6, 1e-6, sigma_m**2, 1e-8, sigma_rad**2, 1e-8])
    return AlignResult(
        T_current_reference=se3.identity(), covariance=covariance, inlier_ratio=inliers,
        texture=0.7, coverage=0.7, overlap=0.9, depth_m=depth_m, median_intensity=0.01,
        median_depth_sigma=0.5, iterations=5, converged=True, gain=1.0, bias=0.0,
        depth_pattern=np.zeros(3),
    )  # fmt: skip


@pytest.mark.parametrize(
    'quality', [aligned(), aligned(inliers=0.5), aligned(sigma_m=0.4, depth_m=12.0)]
)
def test_a_good_frame_is_believed(quality: AlignResult) -> None:
    assert LossTest(LossConfig()).objection(quality) == ''


@pytest.mark.parametrize(
    ('quality', 'words'),
    [
        (aligned(inliers=0.15), '15 % inliers'),
        (aligned(sigma_m=0.4), 'position open to 0.40 m at a depth of 2.0 m'),
        (aligned(sigma_m=0.06, depth_m=0.4), 'position open to 0.06 m'),
        (aligned(sigma_rad=0.2), 'direction open to 11 deg'),
    ],
)
def test_each_limit_objects_in_words(quality: AlignResult, words: str) -> None:
    assert words in LossTest(LossConfig()).objection(quality)


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


@pytest.mark.parametrize(
    ('keyframe', 'model', 'off', 'words'),
    [
        (0.4, 0.7, [0.12, 0, 0, 0, 0, 0], '12 cm and 0.0 deg apart, with 40 and 70 % inliers'),
        (0.4, 0.7, [0, 0, 0, 0, 0.06, 0], '0 cm and 3.4 deg apart'),
        (0.4, 0.95, [0.12, 0, 0, 0, 0, 0], ''),  # the map fits: the keyframe was misled
        (0.9, 0.7, [0.12, 0, 0, 0, 0, 0], ''),
        (0.4, 0.7, [0.02, 0, 0, 0, 0, 0], ''),
    ],
)
def test_where_neither_fits_keyframe_and_map_have_to_agree(
    keyframe: float, model: float, off: list[float], words: str
) -> None:
    coarse = Estimate(se3.identity(), aligned(keyframe))
    fine = Estimate(se3.exp(np.array(off)), aligned(model))
    found = LossTest(LossConfig()).contradiction(coarse, fine)
    assert words in found if words else found == ''


def test_one_estimate_does_not_contradict_itself() -> None:
    only = Estimate(se3.identity(), aligned(0.4))
    assert LossTest(LossConfig()).contradiction(only, only) == ''
