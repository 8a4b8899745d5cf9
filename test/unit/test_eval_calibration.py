"""The arithmetic of probabilities against what happened."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.eval.calibration import calibration, plot_reliability, reliability_table

PREDICTED = np.array([0.1, 0.1, 0.9, 0.7])
TRUTH = np.array([False, True, True, True])


def test_figures_of_a_few_predictions() -> None:
    found = calibration(PREDICTED, TRUTH)
    assert found.count == 4
    assert found.base_rate == 0.75
    assert found.accuracy == 0.75
    assert found.brier == pytest.approx((0.01 + 0.81 + 0.01 + 0.09) / 4)
    assert found.log_loss == pytest.approx(-np.log([0.9, 0.1, 0.9, 0.7]).mean())
    # bins: two at 0.1 of which half is true, one at 0.9 and one at 0.7 that are
    assert found.calibration_error == pytest.approx((2 * 0.4 + 0.1 + 0.3) / 4)
    assert [(b.count, b.observed) for b in found.bins] == [(2, 0.5), (1, 1.0), (1, 1.0)]


def test_honest_probabilities_lie_on_the_diagonal() -> None:
    rng = np.random.default_rng(0)
    p = rng.random(200_000)
    found = calibration(p, rng.random(len(p)) < p)
    assert len(found.bins) == 10
    assert found.calibration_error < 0.01
    overconfident = calibration(np.where(p > 0.5, 0.99, 0.01), rng.random(len(p)) < p)
    assert overconfident.calibration_error > 0.2
    assert overconfident.brier > found.brier


def test_certain_and_wrong_costs_much_but_not_everything() -> None:
    found = calibration(np.array([0.0, 1.0]), np.array([True, True]))
    assert 5 < found.log_loss < 10
    assert found.bins[-1].count == 1


@pytest.mark.parametrize(
    ('predicted', 'truth', 'message'),
    [
        (np.zeros(0), np.zeros(0, bool), r'\(0,\)'),
        (np.zeros(3), np.zeros(2, bool), r'\(3,\) and \(2,\)'),
        (np.array([0.5, 1.2]), np.zeros(2, bool), '0.5 to 1.2 are no probabilities'),
        (np.array([0.5, np.nan]), np.zeros(2, bool), 'no probabilities'),
    ],
)
def test_what_cannot_be_compared_is_refused(
    predicted: np.ndarray, truth: np.ndarray, message: str
) -> None:
    with pytest.raises(EvaluationError, match=message):
        calibration(predicted, truth)


def test_table_and_plot(tmp_path: Path) -> None:
    found = calibration(PREDICTED, TRUTH)
    table = reliability_table(found)
    assert table.splitlines()[0] == '| predicted | observed | examples |'
    assert len(table.splitlines()) == 2 + len(found.bins)
    plot_reliability(tmp_path / 'curve.png', {'before': found, 'fitted': found})
    assert (tmp_path / 'curve.png').read_bytes().startswith(b'\x89PNG')
