"""How well are the pixels of moving things found."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.types import DYNAMIC_THRESHOLD, ProbabilityImage
from bdgs_ros.eval.metric import Metric, ratio


@dataclass(frozen=True)
class LabelScore:
    """Counts of pixels by call and truth; add scores to pool frames."""

    true_positives: int = 0
    false_positives: int = 0
    false_negatives: int = 0
    true_negatives: int = 0

    def __add__(self, other: LabelScore) -> LabelScore:
        """Pool the pixels of two sets of frames."""
        return LabelScore(
            self.true_positives + other.true_positives,
            self.false_positives + other.false_positives,
            self.false_negatives + other.false_negatives,
            self.true_negatives + other.true_negatives,
        )

    @property
    def precision(self) -> float:
        """Share of the pixels called dynamic that are; NaN if none was called."""
        return ratio(self.true_positives, self.true_positives + self.false_positives)

    @property
    def recall(self) -> float:
        """Share of the dynamic pixels that were called so; NaN if there is none."""
        return ratio(self.true_positives, self.true_positives + self.false_negatives)

    @property
    def false_positive_rate(self) -> float:
        """Share of the static pixels that were called dynamic; NaN if there is none."""
        return ratio(self.false_positives, self.false_positives + self.true_negatives)

    def metrics(self, prefix: str = 'dynamic') -> list[Metric]:
        """Return precision, recall and false positive rate."""
        return [
            Metric(f'{prefix}_precision', self.precision),
            Metric(f'{prefix}_recall', self.recall),
            Metric(f'{prefix}_false_positive_rate', self.false_positive_rate),
        ]


def score_labels(p_dynamic: ProbabilityImage, truth: NDArray[np.bool_]) -> LabelScore:
    """
    Compare a probability image with the true mask of moving things.

    Parameters
    ----------
    p_dynamic : ndarray, shape (H, W), uint8
        P(dynamic) x 255; at or above `DYNAMIC_THRESHOLD` a pixel is called dynamic.
    truth : ndarray, shape (H, W), bool
        True where something that moves is seen.

    Raises
    ------
    EvaluationError
        If the shapes differ.

    """
    if p_dynamic.shape != truth.shape:
        raise EvaluationError(
            f'labels have shape {p_dynamic.shape}, but the true mask has {truth.shape}'
        )
    called = p_dynamic >= DYNAMIC_THRESHOLD
    truth = truth.astype(bool)
    both = int(np.count_nonzero(called & truth))
    n_called, n_true = int(np.count_nonzero(called)), int(np.count_nonzero(truth))
    return LabelScore(both, n_called - both, n_true - both, truth.size - n_called - n_true + both)
