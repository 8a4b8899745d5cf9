"""
The weights of Eq. 3 from examples: logistic regression through the fusion of Eq. 5.

In log-odds Eq. 5 is linear in the weights. A Gaussian whose belief began with log-odds `L_0` and
that keyframes saw with features `f_k` is dynamic with the log-odds

    L_t = exp(-alpha (t - t_0)) L_0 + w . F_t,      F_t = sum_k exp(-alpha (t - t_k)) f_k

So `w` is fitted to what the filter says after all its evidence, not to what a single frame says:
neighbouring keyframes repeat each other's errors, and weights that are right for one frame make a
filter that is too sure of itself. The bias of Eq. 3 is the weight of a feature that is 1.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from bdgs_ros.core.errors import EvaluationError

Array = NDArray[np.float32]
Weights = NDArray[np.float64]
Bounds = tuple[float | None, float | None]

FREE: Bounds = (None, None)
POSITIVE: Bounds = (0.0, None)
NEGATIVE: Bounds = (None, 0.0)

_BLOCK = 1 << 16  # rows at a time, so that no copy in float64 is as large as the examples
_STEPS = 500


@dataclass(frozen=True)
class Examples:
    """What the filter had been told about Gaussians at some time, and what was true then."""

    features: Array
    """F_t, [R, F]"""
    offset: Array
    """Log-odds without any evidence, [R]"""
    truth: NDArray[np.bool_]
    """Whether dynamic, [R]"""

    def __post_init__(self) -> None:
        """Refuse arrays that do not belong together."""
        rows = len(self.features)
        if self.features.ndim != 2 or self.offset.shape != (rows,) or self.truth.shape != (rows,):
            raise ValueError(
                f'examples: expected features [R, F], offset [R] and truth [R], received '
                f'{self.features.shape}, {self.offset.shape} and {self.truth.shape}'
            )

    def __len__(self) -> int:
        """Return the number of examples, R."""
        return len(self.truth)

    def choose(self, rows: NDArray[np.bool_] | NDArray[np.int64]) -> Examples:
        """Return some of the examples."""
        return Examples(self.features[rows], self.offset[rows], self.truth[rows])

    def log_odds(self, weights: Weights) -> Array:
        """Return L_t of each example, [R]."""
        return np.asarray(self.offset + self.features @ weights.astype(np.float32), np.float32)


def joined(parts: list[Examples]) -> Examples:
    """Put examples of several recordings together."""
    return Examples(
        np.concatenate([part.features for part in parts]),
        np.concatenate([part.offset for part in parts]),
        np.concatenate([part.truth for part in parts]),
    )


def fit(examples: Examples, bounds: list[Bounds], shrinkage: float) -> Weights:
    """
    Learn the weights of Eq. 3, b among them.

    The mean log loss plus `shrinkage / 2` times the squared weights, each times the root mean
    square of its feature, so that units do not matter, is minimised by L-BFGS-B.

    Parameters
    ----------
    examples : Examples
        Of both kinds.
    bounds : list of tuple
        Lower and upper limit of each weight, such as `POSITIVE` where the sign is known; (0, 0)
        leaves a feature out.
    shrinkage : float
        Strength of the regularisation, in log loss per squared log-odds.

    Returns
    -------
    weights : ndarray, shape (F,)

    Raises
    ------
    EvaluationError
        If there are no examples of one kind, or the minimum is not found.

    """
    dynamic = int(np.count_nonzero(examples.truth))
    if dynamic == 0 or dynamic == len(examples):
        raise EvaluationError(
            f'{dynamic} of {len(examples)} examples are dynamic, but both kinds are needed; '
            'take recordings in which something moves'
        )
    scale = np.sqrt(np.mean(np.square(examples.features, dtype=np.float64), axis=0))
    scale = np.where(scale > 0, scale, 1.0)  # a feature that never occurs keeps the weight 0

    def loss(scaled: Weights) -> tuple[float, Weights]:
        value, gradient = log_loss_and_gradient(examples, scaled / scale)
        value += 0.5 * shrinkage * float(scaled @ scaled)
        return value, gradient / scale + shrinkage * scaled

    start = np.zeros(len(scale))
    limits = [_scaled(b, s) for b, s in zip(bounds, scale, strict=True)]
    found = minimize(
        loss, start, jac=True, method='L-BFGS-B', bounds=limits, options={'maxiter': _STEPS}
    )
    if not found.success:
        raise EvaluationError(
            f'no weights found in {found.nit} steps on {len(examples)} examples: {found.message}; '
            f'raise the shrinkage above {shrinkage:g}'
        )
    return np.asarray(found.x / scale, np.float64)


def _scaled(bounds: Bounds, scale: float) -> Bounds:
    low, high = (None if limit is None else limit * float(scale) for limit in bounds)
    return low, high


def log_loss_and_gradient(examples: Examples, weights: Weights) -> tuple[float, Weights]:
    """Return the mean log loss and its derivative by the weights, [F]."""
    total, gradient = 0.0, np.zeros(len(weights))
    for start in range(0, len(examples), _BLOCK):
        rows = slice(start, start + _BLOCK)
        features = examples.features[rows].astype(np.float64)
        truth = examples.truth[rows]
        log_odds = examples.offset[rows] + features @ weights
        total += float(np.sum(np.logaddexp(0.0, log_odds)) - np.sum(log_odds[truth]))
        excess = 0.5 * (1.0 + np.tanh(0.5 * log_odds)) - truth
        gradient += features.T @ excess
    return total / len(examples), gradient / len(examples)
