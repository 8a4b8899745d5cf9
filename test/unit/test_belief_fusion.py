"""Eq. 5 and 6: several views, none counted twice."""

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.belief import filter as bayes
from bdgs_ros.belief.fusion import BeliefTracker, State, decide, temporal_weight
from bdgs_ros.core import se3
from bdgs_ros.core.config import BeliefConfig

CONFIG = BeliefConfig(decay_rate=0.1, max_log_odds=20.0, views=3, ema=1.0)
SECOND = 1_000_000_000


def at(x: float) -> np.ndarray:
    return se3.exp(np.array([x, 0, 0, 0, 0, 0]))


def array(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def tracker(config: BeliefConfig = CONFIG, initial: float = 0.5) -> BeliefTracker:
    out = BeliefTracker(config)
    out.append(array(initial, initial))
    return out


def test_decision_has_three_outcomes() -> None:
    assert decide(array(0.2, 0.45, 0.55, 0.8), 0.1).tolist() == [
        State.STATIC,
        State.UNCERTAIN,
        State.UNCERTAIN,
        State.DYNAMIC,
    ]


def test_posterior_is_the_weighted_product_of_eq_5() -> None:
    belief = tracker()
    evidence = [array(1.0, -0.5), array(0.7, 0.0), array(-0.2, -1.0)]
    for k, z in enumerate(evidence):
        belief.observe(k * SECOND, at(float(k)), z)
    total = sum(temporal_weight(0.1, 2.0 - k) * z for k, z in enumerate(evidence))
    np.testing.assert_allclose(bayes.logit(belief.belief), total, atol=1e-4)


def test_evidence_beyond_the_window_is_absorbed_once() -> None:
    """Without decay the order and the window do not matter: log-odds are the plain sum."""
    belief = tracker(replace(CONFIG, decay_rate=0.0))
    for k in range(10):
        belief.observe(k * SECOND, at(float(k)), array(0.3, -0.2))
    np.testing.assert_allclose(bayes.logit(belief.belief), array(3.0, -2.0), atol=1e-3)


def test_views_from_one_place_do_not_fill_the_window() -> None:
    belief = tracker(replace(CONFIG, decay_rate=0.0))
    belief.observe(0, at(0.0), array(1.0, 1.0))
    for k in range(1, 6):
        belief.observe(k * SECOND, at(5.0), array(0.0, 0.0))
    assert len(belief._views) == 2
    np.testing.assert_allclose(bayes.logit(belief.belief), array(1.0, 1.0), atol=1e-4)


def test_unseen_gaussians_only_decay() -> None:
    belief = tracker(initial=0.9)
    belief.observe(0, at(0.0), array(0.0, 0.0))
    belief.observe(5 * SECOND, at(1.0), array(0.0, 0.0))
    expected = bayes.predict(array(0.9, 0.9), 0.1, 5.0)
    np.testing.assert_allclose(belief.belief, expected, atol=1e-5)


def test_gaussians_come_and_go_with_their_evidence() -> None:
    belief = tracker(replace(CONFIG, decay_rate=0.0))
    belief.observe(0, at(0.0), array(2.0, -2.0))
    belief.append(array(0.5))
    belief.keep(np.array([False, True, True]))
    belief.observe(SECOND, at(1.0), array(0.0, 1.0))
    np.testing.assert_allclose(bayes.logit(belief.belief), array(-2.0, 1.0), atol=1e-4)


def test_smoothed_belief_lags() -> None:
    belief = tracker(replace(CONFIG, ema=0.5))
    belief.observe(0, at(0.0), array(10.0, 10.0))
    assert belief.smoothed[0] == pytest.approx(0.75, abs=1e-3)
