"""Eq. 5 and 6: several views, none counted twice."""

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.belief import filter as bayes
from bdgs_ros.belief.fusion import (
    BeliefTracker,
    State,
    View,
    covisibility,
    decide,
    temporal_weight,
)
from bdgs_ros.belief.likelihood import Observation
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig

CONFIG = BeliefConfig(decay_rate=0.1, max_log_odds=20.0, views=3, ema=1.0)
SECOND = 1_000_000_000


def at(x: float) -> np.ndarray:
    return se3.exp(np.array([x, 0, 0, 0, 0, 0]))


def array(*values: float) -> np.ndarray:
    return np.array(values, np.float32)


def view(stamp_ns: int, x: float, evidence: np.ndarray, free: np.ndarray | None = None) -> View:
    """What a keyframe at `x` metres says; 0 is not visible."""
    camera = PinholeCamera(4, 4, 4.0, 4.0, 1.5, 1.5)
    empty = np.zeros((4, 4), np.float32)
    seen = Observation(
        stamp_ns, at(x), camera, np.zeros((4, 4, 3), np.float32), empty, empty.astype(np.uint8)
    )
    through = np.zeros(len(evidence), bool) if free is None else free
    return View(seen, evidence, evidence != 0, through)


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


def test_a_decision_holds_until_the_belief_crosses_one_half() -> None:
    before = np.array([State.DYNAMIC, State.DYNAMIC, State.STATIC, State.UNCERTAIN], np.uint8)
    after = decide(array(0.55, 0.45, 0.45, 0.55), 0.1, before)
    assert after.tolist() == [State.DYNAMIC, State.UNCERTAIN, State.STATIC, State.UNCERTAIN]


def test_posterior_is_the_weighted_product_of_eq_5() -> None:
    belief = tracker()
    evidence = [array(1.0, -0.5), array(0.7, 0.0), array(-0.2, -1.0)]
    for k, z in enumerate(evidence):
        belief.observe(view(k * SECOND, float(k), z))
    total = sum(temporal_weight(0.1, 2.0 - k) * z for k, z in enumerate(evidence))
    np.testing.assert_allclose(bayes.logit(belief.belief), total, atol=1e-4)


def test_evidence_beyond_the_window_is_absorbed_once() -> None:
    """Without decay the order and the window do not matter: log-odds are the plain sum."""
    belief = tracker(replace(CONFIG, decay_rate=0.0))
    for k in range(10):
        belief.observe(view(k * SECOND, float(k), array(0.3, -0.2)))
    np.testing.assert_allclose(bayes.logit(belief.belief), array(3.0, -2.0), atol=1e-3)


def test_views_from_one_place_do_not_fill_the_window() -> None:
    belief = tracker(replace(CONFIG, decay_rate=0.0))
    belief.observe(view(0, 0.0, array(1.0, 1.0)))
    for k in range(1, 6):
        belief.observe(view(k * SECOND, 5.0, array(0.0, 0.0)))
    assert len(belief.views) == 2
    np.testing.assert_allclose(bayes.logit(belief.belief), array(1.0, 1.0), atol=1e-4)


def test_unseen_gaussians_only_decay() -> None:
    belief = tracker(initial=0.9)
    belief.observe(view(0, 0.0, array(0.0, 0.0)))
    belief.observe(view(5 * SECOND, 1.0, array(0.0, 0.0)))
    expected = bayes.predict(array(0.9, 0.9), 0.1, 5.0)
    np.testing.assert_allclose(belief.belief, expected, atol=1e-5)


def test_gaussians_come_and_go_with_their_evidence() -> None:
    belief = tracker(replace(CONFIG, decay_rate=0.0))
    belief.observe(view(0, 0.0, array(2.0, -2.0)))
    belief.append(array(0.5))
    belief.keep(np.array([False, True, True]))
    belief.observe(view(SECOND, 1.0, array(0.0, 1.0)))
    np.testing.assert_allclose(bayes.logit(belief.belief), array(-2.0, 1.0), atol=1e-4)


def test_smoothed_belief_lags() -> None:
    belief = tracker(replace(CONFIG, ema=0.5))
    belief.observe(view(0, 0.0, array(10.0, 10.0)))
    assert belief.smoothed[0] == pytest.approx(0.75, abs=1e-3)


def test_the_view_that_shares_least_makes_room() -> None:
    belief = tracker(replace(CONFIG, decay_rate=0.0, views=2))
    belief.observe(view(0, 0.0, array(1.0, 0.0)))
    belief.observe(view(SECOND, 1.0, array(0.0, 1.0)))
    belief.observe(view(2 * SECOND, 2.0, array(1.0, 0.0)))
    assert [v.stamp_ns for v in belief.views] == [0, 2 * SECOND]
    np.testing.assert_allclose(bayes.logit(belief.belief), array(2.0, 1.0), atol=1e-4)


def test_the_graph_of_shared_views_is_kept() -> None:
    belief = tracker()
    belief.observe(view(0, 0.0, array(1.0, 1.0)))
    belief.observe(view(SECOND, 1.0, array(0.0, 1.0)))
    assert belief.views[1].shared == {0: 1.0}
    both, first = np.array([True, True, False]), np.array([True, False, True])
    assert covisibility(both, first) == pytest.approx(0.5)


def test_memory_tells_new_gaussians_where_to_start_and_no_more() -> None:
    """Views that all saw a place empty say together what a single sure one says."""
    config = replace(CONFIG, decay_rate=0.0, max_memory_log_odds=2.0)
    belief = tracker(config)
    views = [view(k * SECOND, float(k), array(1.0, -0.5)) for k in range(3)]
    for one in views:
        belief.observe(one)
    belief.append(array(0.5, 0.5))
    rows = np.array([2, 3])
    for k, one in enumerate(views):
        free = np.array([True, False])
        belief.recall(one, rows, view(k * SECOND, float(k), array(1.5, -0.1), free))
    belief.restart(rows)
    np.testing.assert_allclose(bayes.logit(belief.belief[rows]), [2.0, -0.3], atol=1e-4)
    np.testing.assert_allclose(belief.seen_through(), [0, 0, 1, 0])
    assert belief.hidden.tolist()[2:] == [True, False]


def test_what_is_known_is_clamped_before_the_newest_view() -> None:
    belief = tracker(replace(CONFIG, decay_rate=0.0, max_log_odds=2.0))
    for k in range(3):
        belief.observe(view(k * SECOND, float(k), array(-5.0, -5.0)))
    belief.observe(view(3 * SECOND, 3.0, array(5.0, 0.0)))
    np.testing.assert_allclose(bayes.logit(belief.belief), [3.0, -2.0], atol=1e-3)


def test_ghosts_stay_hidden_when_nobody_looks_and_others_fade_back() -> None:
    belief = tracker()
    belief.observe(view(0, 0.0, array(5.0, 5.0), free=np.array([True, False])))
    assert belief.hidden.tolist() == [True, True]
    for k in range(1, 40):
        belief.observe(view(k * SECOND, float(k), array(0.0, 0.0)))
    assert belief.hidden.tolist() == [True, False]


def test_hidden_gaussians_come_back_only_some_way_below_the_threshold() -> None:
    config = replace(CONFIG, decay_rate=0.0, mask_threshold=0.7, mask_hysteresis=0.2)
    belief = tracker(config)
    for k, target in enumerate((0.6, 0.75, 0.6, 0.4)):
        step = bayes.logit(array(target, target)) - bayes.logit(belief.belief)
        belief.observe(view(k * SECOND, float(k), step))
        assert belief.hidden.tolist() == [[False, True, True, False][k]] * 2


def test_hidden_newcomers_must_be_seen_to_rest_several_times_in_a_row() -> None:
    config = replace(CONFIG, decay_rate=0.0, readmission=3)
    belief = BeliefTracker(config)
    belief.append(array(0.9, 0.2, 0.9))
    passes = np.array([False, False, True])
    for k, free in enumerate((~passes & passes, passes, ~passes & passes)):
        evidence = np.where(free, 9.0, -9.0).astype(np.float32)
        belief.observe(view(k * SECOND, float(k), evidence, free=free))
        assert belief.hidden.tolist() == [k < 2, False, True]
