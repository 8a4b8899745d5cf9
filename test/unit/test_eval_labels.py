"""Precision and recall of dynamic pixels."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.types import DYNAMIC_THRESHOLD
from bdgs_ros.eval.labels import LabelScore, score_labels


def test_counts_of_a_known_case():
    p = np.array([[255, DYNAMIC_THRESHOLD, DYNAMIC_THRESHOLD - 1, 0, 0]], np.uint8)
    truth = np.array([[True, False, True, False, True]])
    score = score_labels(p, truth)
    assert score == LabelScore(1, 1, 2, 1)
    assert score.precision == 0.5
    assert score.recall == pytest.approx(1 / 3)
    assert score.false_positive_rate == 0.5


def test_scores_pool_by_pixels():
    rng = np.random.default_rng(0)
    p = rng.integers(0, 256, (6, 8), dtype=np.uint8)
    truth = rng.random((6, 8)) < 0.3
    halves = score_labels(p[:2], truth[:2]) + score_labels(p[2:], truth[2:])
    assert halves == score_labels(p, truth)


def test_nothing_moves():
    score = score_labels(np.zeros((3, 3), np.uint8), np.zeros((3, 3), bool))
    assert np.isnan(score.recall)
    assert np.isnan(score.precision)
    assert score.false_positive_rate == 0.0


def test_shapes_must_agree():
    with pytest.raises(EvaluationError, match=r'\(3, 3\).*\(2, 3\)'):
        score_labels(np.zeros((3, 3), np.uint8), np.zeros((2, 3), bool))
