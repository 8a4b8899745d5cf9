"""Eq. 1-4, 10 and 11 against their definitions."""

import numpy as np
import pytest

from bdgs_ros.belief import filter as bayes

BELIEFS = np.linspace(0.01, 0.99, 25, dtype=np.float32)


@pytest.mark.parametrize('elapsed_s', [0.0, 0.1, 1.0, 30.0])
def test_decay_is_a_symmetric_two_state_chain(elapsed_s: float) -> None:
    """Eq. 4 equals Eq. 1 with the switch probability q."""
    q = bayes.switch_probability(0.3, elapsed_s)
    chain = (1 - q) * BELIEFS + q * (1 - BELIEFS)
    np.testing.assert_allclose(bayes.predict(BELIEFS, 0.3, elapsed_s), chain, atol=1e-6)


def test_two_short_decays_are_one_long() -> None:
    twice = bayes.predict(bayes.predict(BELIEFS, 0.3, 0.4), 0.3, 0.6)
    np.testing.assert_allclose(twice, bayes.predict(BELIEFS, 0.3, 1.0), atol=1e-6)


def test_update_is_bayes_rule() -> None:
    """Eq. 2, normalised by hand over the two states."""
    p_dynamic, p_static = 0.8, 0.3
    evidence = np.full_like(BELIEFS, np.log(p_dynamic / p_static))
    by_hand = p_dynamic * BELIEFS / (p_dynamic * BELIEFS + p_static * (1 - BELIEFS))
    np.testing.assert_allclose(bayes.update(BELIEFS, evidence, 20.0), by_hand, atol=1e-5)


def test_no_evidence_changes_nothing() -> None:
    np.testing.assert_allclose(
        bayes.update(BELIEFS, np.zeros_like(BELIEFS), 20.0), BELIEFS, atol=1e-6
    )


def test_beliefs_stay_within_the_clamp() -> None:
    sure = bayes.update(BELIEFS, np.full_like(BELIEFS, 100.0), 4.0)
    np.testing.assert_allclose(sure, bayes.sigmoid(np.float32(4.0)), atol=1e-6)


def test_logit_inverts_sigmoid_and_is_finite_at_the_ends() -> None:
    np.testing.assert_allclose(bayes.sigmoid(bayes.logit(BELIEFS)), BELIEFS, atol=1e-6)
    assert np.isfinite(bayes.logit(np.array([0, 1], np.float32))).all()


def test_smoothing_follows_the_belief_by_rho() -> None:
    smoothed = bayes.smooth(np.ones(1, np.float32), np.zeros(1, np.float32), 0.25)
    assert smoothed[0] == pytest.approx(0.25)


def test_mask_hides_at_and_above_the_threshold() -> None:
    mask = bayes.render_mask(np.array([0.69, 0.7, 0.71], np.float32), 0.7)
    assert mask.tolist() == [True, False, False]
