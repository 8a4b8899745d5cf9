"""Are probabilities what they claim: Brier score, log loss and the reliability curve."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.files import write_aside
from bdgs_ros.eval.metric import markdown_table

BINS = 10
_LEAST = 1e-6  # a probability of 0 or 1 that is wrong once must not cost infinitely much
# Of the same validated palette as the other plots, told apart by markers as well.
_LINES = (('#2a78d6', 'o'), ('#c2571a', 's'), ('#3a8f5c', '^'), ('#7a55b8', 'D'))
_INK = '#52514e'
_GRID = '#e4e3df'


@dataclass(frozen=True)
class Bin:
    """The predictions of one tenth of [0, 1]."""

    count: int
    predicted: float
    """Mean prediction."""
    observed: float
    """Share that was true."""


@dataclass(frozen=True)
class Calibration:
    """How good probabilities of something were."""

    count: int
    base_rate: float
    """Share that was true."""
    log_loss: float
    """Mean of -log of the probability given to what was true, in nats."""
    brier: float
    """Mean squared difference of probability and truth."""
    accuracy: float
    """Share on the right side of 1/2."""
    calibration_error: float
    """Mean distance of the reliability curve from the diagonal, by number of predictions."""
    bins: tuple[Bin, ...]
    """Those that are not empty."""

    def row(self) -> dict[str, Any]:
        """Return the figures as a row of a table."""
        return {
            'examples': self.count,
            'base_rate': self.base_rate,
            'log_loss': self.log_loss,
            'brier': self.brier,
            'accuracy': self.accuracy,
            'calibration_error': self.calibration_error,
        }


def calibration(
    predicted: NDArray[np.floating[Any]], truth: NDArray[np.bool_], bins: int = BINS
) -> Calibration:
    """
    Compare probabilities with what was true.

    Parameters
    ----------
    predicted : ndarray, shape (R,)
        Probabilities in [0, 1].
    truth : ndarray of bool, shape (R,)
        What they were of.
    bins : int
        Of equal width in the reliability curve.

    Raises
    ------
    EvaluationError
        If there are no predictions, the shapes differ, or something is no probability.

    References
    ----------
    Brier 1950; the calibration error is that of Naeini et al. 2015.

    """
    _check(predicted, truth)
    p = predicted.astype(np.float64)
    given = np.clip(np.where(truth, p, 1.0 - p), _LEAST, 1.0)
    curve = _curve(p, truth, bins)
    apart = sum(b.count * abs(b.predicted - b.observed) for b in curve)
    return Calibration(
        count=len(p),
        base_rate=float(np.mean(truth)),
        log_loss=float(-np.mean(np.log(given))),
        brier=float(np.mean((p - truth) ** 2)),
        accuracy=float(np.mean((p > 0.5) == truth)),
        calibration_error=apart / len(p),
        bins=curve,
    )


def _check(predicted: NDArray[np.floating[Any]], truth: NDArray[np.bool_]) -> None:
    if predicted.shape != truth.shape or predicted.ndim != 1 or not len(predicted):
        raise EvaluationError(
            f'calibration needs predictions and truth of one length above 0, received '
            f'{predicted.shape} and {truth.shape}'
        )
    low, high = float(np.min(predicted)), float(np.max(predicted))
    if not (low >= 0.0 and high <= 1.0):  # NaN too
        raise EvaluationError(
            f'predictions from {low:g} to {high:g} are no probabilities; '
            'turn log-odds into probabilities first'
        )


def _curve(p: NDArray[np.float64], truth: NDArray[np.bool_], bins: int) -> tuple[Bin, ...]:
    index = np.minimum((p * bins).astype(np.int64), bins - 1)
    count = np.bincount(index, minlength=bins)
    predicted = np.bincount(index, weights=p, minlength=bins)
    observed = np.bincount(index, weights=truth.astype(np.float64), minlength=bins)
    return tuple(
        Bin(int(n), float(a / n), float(b / n))
        for n, a, b in zip(count, predicted, observed, strict=True)
        if n
    )


def reliability_table(found: Calibration) -> str:
    """Write the reliability curve as a Markdown table."""
    return markdown_table(
        [
            {'predicted': b.predicted, 'observed': b.observed, 'examples': b.count}
            for b in found.bins
        ]
    )


def plot_reliability(path: Path, curves: Mapping[str, Calibration]) -> None:
    """
    Draw reliability curves, and below them how often each probability was given.

    Parameters
    ----------
    path : Path
        A .png, .pdf or .svg file.
    curves : mapping of str to Calibration
        By their names in the legend, four at most.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(5.2, 6.0), layout='constrained')
    FigureCanvasAgg(figure)
    top, bottom = figure.subplots(2, 1, sharex=True, height_ratios=(3, 1))
    top.plot([0, 1], [0, 1], color=_INK, lw=1.0, ls='--')
    for (name, found), (color, marker) in zip(curves.items(), _LINES, strict=False):
        predicted = [b.predicted for b in found.bins]
        style = {'color': color, 'marker': marker, 'lw': 1.4, 'ms': 5}
        label = f'{name}: Brier {found.brier:.4f}'
        top.plot(predicted, [b.observed for b in found.bins], label=label, **style)
        bottom.plot(predicted, [b.count / found.count for b in found.bins], **style)
    top.set(ylabel='share that was dynamic', xlim=(0, 1), ylim=(0, 1))
    bottom.set(xlabel='P(dynamic) of the filter', ylabel='share of examples', yscale='log')
    top.legend(frameon=False, fontsize=9)
    for axes in (top, bottom):
        _tidy(axes)
    write_aside(path, lambda aside: figure.savefig(aside, dpi=130))


def _tidy(axes: Any) -> None:
    axes.grid(color=_GRID, lw=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_INK, labelsize=9)
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)
