"""PSNR, SSIM and depth error on the valid pixels."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.eval import rendering


@pytest.fixture
def images():
    rng = np.random.default_rng(0)
    truth = rng.uniform(0.2, 0.8, (24, 32, 3))
    return truth + rng.normal(0.0, 0.05, truth.shape), truth


def slow_ssim(x, y, valid):
    """Return the definition, one window at a time."""
    offsets = np.arange(-5, 6)
    kernel = np.exp(-(offsets**2) / (2 * 1.5**2))
    scores = []
    height, width = valid.shape
    for v, u in zip(*np.nonzero(valid), strict=True):
        rows = [r for r in v + offsets if 0 <= r < height]
        cols = [c for c in u + offsets if 0 <= c < width]
        w = np.outer(kernel[[r - v + 5 for r in rows]], kernel[[c - u + 5 for c in cols]])
        w = (w * valid[np.ix_(rows, cols)])[..., None]
        w = w / w.sum()
        a, b = x[np.ix_(rows, cols)], y[np.ix_(rows, cols)]
        ma, mb = (w * a).sum((0, 1)), (w * b).sum((0, 1))
        va, vb = (w * (a - ma) ** 2).sum((0, 1)), (w * (b - mb) ** 2).sum((0, 1))
        cov = (w * (a - ma) * (b - mb)).sum((0, 1))
        c1, c2 = 0.01**2, 0.03**2
        scores.append(
            (2 * ma * mb + c1) * (2 * cov + c2) / ((ma**2 + mb**2 + c1) * (va + vb + c2))
        )
    return np.mean(scores)


def test_psnr_of_a_known_error():
    truth = np.full((4, 5, 3), 0.5)
    assert rendering.psnr(truth + 0.1, truth) == pytest.approx(20.0)
    assert rendering.psnr(truth, truth) == pytest.approx(58.9, abs=0.1)


def test_eight_bits_and_floats_agree():
    truth = np.full((4, 5, 3), 102, np.uint8)
    assert rendering.psnr(np.full((4, 5, 3), 0.5), truth) == pytest.approx(20.0)


def test_masked_pixels_do_not_count(images):
    image, truth = images
    valid = np.ones(truth.shape[:2], bool)
    valid[5:15, 8:20] = False
    spoiled = image.copy()
    spoiled[~valid] = 1.0
    assert rendering.psnr(spoiled, truth, valid) == rendering.psnr(image, truth, valid)
    assert rendering.ssim(spoiled, truth, valid) == pytest.approx(
        rendering.ssim(image, truth, valid), abs=1e-12
    )
    assert rendering.psnr(spoiled, truth) < rendering.psnr(image, truth) - 3


@pytest.mark.parametrize('masked', [False, True])
def test_ssim_agrees_with_its_definition(images, masked):
    image, truth = images
    valid = np.ones(truth.shape[:2], bool)
    if masked:
        valid[3:9, 10:30] = False
    assert rendering.ssim(image, truth, valid) == pytest.approx(
        slow_ssim(image, truth, valid), abs=1e-5
    )
    assert rendering.ssim(truth, truth, valid) == pytest.approx(1.0)


def test_nothing_valid_is_not_a_number(images):
    image, truth = images
    nothing = np.zeros(truth.shape[:2], bool)
    assert np.isnan(rendering.psnr(image, truth, nothing))
    assert np.isnan(rendering.ssim(image, truth, nothing))


def test_exposure_fit_recovers_gain_and_offset(images):
    _, truth = images
    darker = truth * 0.6 + 0.05
    valid = np.ones(truth.shape[:2], bool)
    valid[:5] = False
    darker[:5] = 0.0
    fitted = rendering.fit_exposure(darker, truth, valid)
    assert rendering.psnr(darker, truth, valid) < 20
    assert np.allclose(fitted[valid], truth[valid])


def test_depth_error_ignores_holes():
    truth = np.array([[1.0, 2.0, 0.0]])
    assert rendering.depth_l1(np.array([[1.1, 0.0, 3.0]]), truth) == pytest.approx(0.1)
    assert np.isnan(rendering.depth_l1(np.zeros((1, 3)), truth))


def test_shapes_must_agree(images):
    image, truth = images
    with pytest.raises(EvaluationError, match=r'\(24, 32, 3\) and \(23, 32, 3\)'):
        rendering.psnr(image, truth[1:])
    with pytest.raises(EvaluationError, match='image and mask'):
        rendering.ssim(image, truth, np.ones((2, 2), bool))
