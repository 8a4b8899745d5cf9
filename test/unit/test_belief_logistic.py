"""Weights are found again in data made with them; offsets, limits and refusals hold."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.belief.filter import sigmoid
from bdgs_ros.belief.logistic import (
    FREE,
    POSITIVE,
    Examples,
    fit,
    joined,
    log_loss_and_gradient,
)
from bdgs_ros.core.errors import EvaluationError

TRUE_WEIGHTS = np.array([3.0, -1.5, 0.4])


def generated(rows: int = 40_000, seed: int = 0) -> Examples:
    rng = np.random.default_rng(seed)
    features = rng.random((rows, 3), np.float32)
    features[:, 2] = 1
    offset = rng.normal(-1, 1, rows).astype(np.float32)
    p = sigmoid((offset + features @ TRUE_WEIGHTS).astype(np.float32))
    return Examples(features, offset, rng.random(rows) < p)


def test_weights_are_found_again_beside_the_offset() -> None:
    weights = fit(generated(), [FREE] * 3, shrinkage=1e-7)
    np.testing.assert_allclose(weights, TRUE_WEIGHTS, atol=0.15)


def test_units_of_a_feature_do_not_matter() -> None:
    examples = generated(4000)
    scale = np.array([100.0, 0.01, 1.0], np.float32)
    scaled = Examples(examples.features * scale, examples.offset, examples.truth)
    weights = fit(examples, [FREE] * 3, 1e-2)
    np.testing.assert_allclose(fit(scaled, [FREE] * 3, 1e-2) * scale, weights, atol=1e-3)


def test_limits_hold_and_a_feature_can_be_left_out() -> None:
    weights = fit(generated(4000), [FREE, POSITIVE, (0.0, 0.0)], 1e-6)
    assert weights[1] == 0  # the truth is negative
    assert weights[2] == 0
    assert weights[0] > 0.5


def test_shrinkage_draws_weights_to_zero() -> None:
    examples = generated(4000)
    lengths = [np.linalg.norm(fit(examples, [FREE] * 3, s)) for s in (1e-6, 1e-2, 10.0)]
    assert lengths[0] > lengths[1] > lengths[2]
    assert lengths[2] < 0.1


def test_a_feature_that_never_occurs_has_no_weight() -> None:
    examples = generated(1000)
    examples.features[:, 1] = 0
    assert fit(examples, [FREE] * 3, 1e-4)[1] == 0


def test_the_gradient_is_that_of_the_loss() -> None:
    examples, weights, step = generated(300), np.array([0.5, -0.2, 1.0]), 1e-5
    _, gradient = log_loss_and_gradient(examples, weights)
    for i in range(3):
        ahead, behind = weights.copy(), weights.copy()
        ahead[i] += step
        behind[i] -= step
        slope = log_loss_and_gradient(examples, ahead)[0]
        slope -= log_loss_and_gradient(examples, behind)[0]
        assert gradient[i] == pytest.approx(slope / (2 * step), rel=1e-4)


def test_parts_are_the_same_as_the_whole() -> None:
    whole = generated(1000)
    parts = [whole.choose(np.arange(1000) < 300), whole.choose(np.arange(300, 1000))]
    weights = np.array([1.0, 2.0, 3.0])
    assert len(joined(parts)) == 1000
    np.testing.assert_array_equal(joined(parts).log_odds(weights), whole.log_odds(weights))


@pytest.mark.parametrize('truth', [True, False])
def test_one_kind_of_examples_is_not_enough(truth: bool) -> None:
    one_kind = Examples(np.ones((5, 1), np.float32), np.zeros(5, np.float32), np.full(5, truth))
    with pytest.raises(EvaluationError, match='of 5 examples are dynamic'):
        fit(one_kind, [FREE], 1e-3)


def test_arrays_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(ValueError, match=r'\(5, 1\), \(4,\)'):
        Examples(np.ones((5, 1), np.float32), np.zeros(4, np.float32), np.ones(5, bool))
