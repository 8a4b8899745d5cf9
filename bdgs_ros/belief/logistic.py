"""
The weights of Eq. 3 from examples: logistic regression through the filter and the fusion of Eq. 5.

Weights are fitted to what the filter says after all its evidence, not to what a single frame says:
neighbouring keyframes repeat each other's errors, and weights that are right for one frame make a
filter that is too sure of itself. With the features `f_k` of keyframe `t_k` the filter says

    L_t = clamp(predict(clamp(L_0 + w . M)) + w . V) + w . f_t
    M = sum over t_k before birth,     exp(-alpha (t_0 - t_k)) f_k
    V = sum over t_k from birth to t,  exp(-alpha (t - t_k)) f_k

where `L_0` is the log-odds that a Gaussian came with at `t_0`, M what remembered keyframes said
of it then, and `predict` is Eq. 4 over the time since. `bdgs_ros.belief.fusion` does the same but
for what its eight views do not hold. The bias of Eq. 3 is the weight of a feature that is 1.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

from bdgs_ros.core.errors import EvaluationError

Array = NDArray[np.float32]
Double = NDArray[np.float64]
Bounds = tuple[float | None, float | None]

FREE: Bounds = (None, None)
POSITIVE: Bounds = (0.0, None)
NEGATIVE: Bounds = (None, 0.0)

_BLOCK = 1 << 15  # rows at a time: what is computed of them stays in the caches
_STEPS = 500


@dataclass(frozen=True)
class Clamps:
    """The most log-odds that are taken over; see `BeliefConfig`."""

    memory: float
    """From keyframes before birth."""
    known: float
    """From before the newest keyframe."""


@dataclass(frozen=True)
class Examples:
    """What the filter had been told about Gaussians at some time, and what was true then."""

    start: Array
    """L_0, [R]"""
    fade: Array
    """exp(-alpha (t - t_0)), [R]"""
    memory: Array
    """M, [R, F]"""
    views: Array
    """V, [R, F]"""
    newest: Array
    """f_t, [R, F]"""
    truth: NDArray[np.bool_]
    """Whether dynamic, [R]"""

    def __post_init__(self) -> None:
        """Refuse arrays that do not belong together."""
        shape = self.newest.shape
        wanted = (shape[:1], shape[:1], shape, shape, shape, shape[:1])
        found = tuple(getattr(self, field.name).shape for field in fields(self))
        if len(shape) != 2 or found != wanted:
            raise ValueError(f'examples: expected shapes {wanted}, received {found}')

    def __len__(self) -> int:
        """Return the number of examples, R."""
        return len(self.truth)

    def choose(self, rows: NDArray[np.bool_] | NDArray[np.int64] | slice) -> Examples:
        """Return some of the examples."""
        return Examples(*(getattr(self, field.name)[rows] for field in fields(self)))

    def log_odds(self, weights: Double, clamps: Clamps) -> Array:
        """Return L_t of each example, [R]."""
        blocks = [_filtered(block, weights, clamps)[0] for block in _blocks(self)]
        return np.concatenate([np.zeros(0, np.float32), *blocks]).astype(np.float32)


def joined(parts: Sequence[Examples]) -> Examples:
    """Put examples of several recordings together."""
    names = [field.name for field in fields(Examples)]
    return Examples(*(np.concatenate([getattr(part, name) for part in parts]) for name in names))


def fit(examples: Examples, bounds: Sequence[Bounds], shrinkage: float, clamps: Clamps) -> Double:
    """
    Learn the weights of Eq. 3, b among them.

    The mean log loss plus `shrinkage / 2` times the squared weights, each times the root mean
    square of its feature, so that units do not matter, is minimised by L-BFGS-B.

    Parameters
    ----------
    examples : Examples
        Of both kinds.
    bounds : sequence of tuple
        Lower and upper limit of each weight, such as `POSITIVE` where the sign is known; (0, 0)
        leaves a feature out.
    shrinkage : float
        Strength of the regularisation, in log loss per squared log-odds.
    clamps : Clamps
        Of the filter.

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
    told = examples.memory + examples.views + examples.newest
    scale = np.sqrt(np.mean(np.square(told, dtype=np.float64), axis=0))
    scale = np.where(scale > 0, scale, 1.0)  # a feature that never occurs keeps the weight 0

    def loss(scaled: Double) -> tuple[float, Double]:
        value, gradient = log_loss_and_gradient(examples, scaled / scale, clamps)
        value += 0.5 * shrinkage * float(scaled @ scaled)
        return value, gradient / scale + shrinkage * scaled

    found = minimize(
        loss,
        np.zeros(len(scale)),
        jac=True,
        method='L-BFGS-B',
        bounds=[_scaled(b, s) for b, s in zip(bounds, scale, strict=True)],
        options={'maxiter': _STEPS},
    )
    if found.nit >= _STEPS or not np.isfinite(found.fun):
        raise EvaluationError(
            f'no weights found in {found.nit} steps on {len(examples)} examples: {found.message}; '
            f'raise the shrinkage above {shrinkage:g}'
        )
    return np.asarray(found.x / scale, np.float64)


def _scaled(bounds: Bounds, scale: float) -> Bounds:
    low, high = (None if limit is None else limit * float(scale) for limit in bounds)
    return low, high


def log_loss_and_gradient(
    examples: Examples, weights: Double, clamps: Clamps
) -> tuple[float, Double]:
    """Return the mean log loss and its derivative by the weights, [F]."""
    total, gradient = 0.0, np.zeros(len(weights))
    for block in _blocks(examples):
        log_odds, by_memory, by_views = _filtered(block, weights, clamps)
        total += float(np.sum(np.logaddexp(0.0, log_odds)) - np.sum(log_odds[block.truth]))
        excess = 0.5 * (1.0 + np.tanh(0.5 * log_odds)) - block.truth
        gradient += (excess * by_memory) @ block.memory
        gradient += (excess * by_views) @ block.views + excess @ block.newest
    return total / len(examples), gradient / len(examples)


def _blocks(examples: Examples) -> list[Examples]:
    starts = range(0, len(examples), _BLOCK)
    return [examples.choose(slice(start, start + _BLOCK)) for start in starts]


def _filtered(
    examples: Examples, weights: Double, clamps: Clamps
) -> tuple[Double, Double, Double]:
    """Return L_t, and its derivatives by w . M and by w . V; each [R]."""
    told = examples.start + examples.memory @ weights
    heard = np.clip(told, -clamps.memory, clamps.memory)
    before = 0.5 * (1.0 + np.tanh(0.5 * heard))
    predicted = examples.fade * (before - 0.5) + 0.5  # Eq. 4
    slope = examples.fade * before * (1 - before) / (predicted * (1 - predicted))
    known = np.log(predicted / (1 - predicted)) + examples.views @ weights
    free = np.abs(known) < clamps.known
    by_memory = np.where(free & (np.abs(told) < clamps.memory), slope, 0.0)
    log_odds = np.clip(known, -clamps.known, clamps.known) + examples.newest @ weights
    return log_odds, by_memory, free.astype(np.float64)
