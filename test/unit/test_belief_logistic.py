"""Weights are found again in data made with them; clamps, limits and refusals hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.belief import filter as bayes
from bdgs_ros.belief.logistic import (
    FREE,
    POSITIVE,
    Clamps,
    Examples,
    fit,
    joined,
    log_loss_and_gradient,
)
from bdgs_ros.core.errors import EvaluationError

TRUE_WEIGHTS = np.array([3.0, -1.5, 0.4])
CLAMPS = Clamps(memory=1.0, known=2.0)
OPEN = Clamps(memory=50.0, known=50.0)


def generated(rows: int = 40_000, clamps: Clamps = CLAMPS, seed: int = 0) -> Examples:
    rng = np.random.default_rng(seed)

    def features() -> np.ndarray:
        return rng.random((rows, 3), np.float32)

    examples = Examples(
        start=rng.normal(-0.5, 0.5, rows).astype(np.float32),
        fade=rng.random(rows, np.float32),
        memory=features(),
        views=2 * features(),
        newest=features(),
        truth=np.zeros(rows, bool),
    )
    p = bayes.sigmoid(examples.log_odds(TRUE_WEIGHTS, clamps))
    return replace(examples, truth=rng.random(rows) < p)


@pytest.mark.parametrize('clamps', [CLAMPS, OPEN])
def test_weights_are_found_again_behind_the_clamps(clamps: Clamps) -> None:
    weights = fit(generated(clamps=clamps), [FREE] * 3, 1e-7, clamps)
    np.testing.assert_allclose(weights, TRUE_WEIGHTS, atol=0.2)


def test_log_odds_are_those_of_the_filter() -> None:
    """Compare with Eq. 4 and the updates of `belief.filter`, one after the other."""
    examples, decay_rate, elapsed_s = generated(100), 0.5, 1.2
    faded = np.full(100, np.exp(-decay_rate * elapsed_s), np.float32)
    examples = replace(examples, fade=faded)
    w = TRUE_WEIGHTS.astype(np.float32)
    birth = bayes.sigmoid(np.clip(examples.start + examples.memory @ w, -1, 1))
    base = bayes.logit(bayes.predict(birth, decay_rate, elapsed_s))
    known = bayes.sigmoid(np.clip(base + examples.views @ w, -2, 2))
    posterior = bayes.update(known, examples.newest @ w, 50.0)
    found = bayes.sigmoid(examples.log_odds(TRUE_WEIGHTS, CLAMPS))
    np.testing.assert_allclose(found, posterior, atol=1e-5)


def test_units_of_a_feature_do_not_matter() -> None:
    examples = generated(4000)
    scale = np.array([100.0, 0.01, 1.0], np.float32)
    scaled = replace(
        examples,
        memory=examples.memory * scale,
        views=examples.views * scale,
        newest=examples.newest * scale,
    )
    weights = fit(examples, [FREE] * 3, 1e-2, CLAMPS)
    np.testing.assert_allclose(fit(scaled, [FREE] * 3, 1e-2, CLAMPS) * scale, weights, atol=1e-2)


def test_limits_hold_and_a_feature_can_be_left_out() -> None:
    weights = fit(generated(4000), [FREE, POSITIVE, (0.0, 0.0)], 1e-6, CLAMPS)
    assert weights[1] == 0  # the truth is negative
    assert weights[2] == 0
    assert weights[0] > 0.5


def test_shrinkage_draws_weights_to_zero() -> None:
    examples = generated(4000)
    lengths = [np.linalg.norm(fit(examples, [FREE] * 3, s, CLAMPS)) for s in (1e-6, 1e-2, 10.0)]
    assert lengths[0] > lengths[1] > lengths[2]
    assert lengths[2] < 0.1


def test_a_feature_that_never_occurs_has_no_weight() -> None:
    examples = generated(1000)
    for part in (examples.memory, examples.views, examples.newest):
        part[:, 1] = 0
    assert fit(examples, [FREE] * 3, 1e-4, CLAMPS)[1] == 0


def test_the_gradient_is_that_of_the_loss() -> None:
    examples, weights, step = generated(300), np.array([0.5, -0.2, 0.3]), 1e-6
    _, gradient = log_loss_and_gradient(examples, weights, CLAMPS)
    for i in range(3):
        ahead, behind = weights.copy(), weights.copy()
        ahead[i] += step
        behind[i] -= step
        slope = log_loss_and_gradient(examples, ahead, CLAMPS)[0]
        slope -= log_loss_and_gradient(examples, behind, CLAMPS)[0]
        assert gradient[i] == pytest.approx(slope / (2 * step), rel=1e-3)


def test_parts_are_the_same_as_the_whole() -> None:
    whole = generated(1000)
    parts = [whole.choose(np.arange(1000) < 300), whole.choose(np.arange(300, 1000))]
    weights = np.array([1.0, 2.0, 3.0])
    assert len(joined(parts)) == 1000
    np.testing.assert_array_equal(
        joined(parts).log_odds(weights, CLAMPS), whole.log_odds(weights, CLAMPS)
    )


@pytest.mark.parametrize('truth', [True, False])
def test_one_kind_of_examples_is_not_enough(truth: bool) -> None:
    one_kind = replace(generated(5), truth=np.full(5, truth))
    with pytest.raises(EvaluationError, match='of 5 examples are dynamic'):
        fit(one_kind, [FREE] * 3, 1e-3, CLAMPS)


def test_arrays_that_do_not_belong_together_are_refused() -> None:
    with pytest.raises(ValueError, match=r'received .*\(4,\)'):
        replace(generated(5), start=np.zeros(4, np.float32))
