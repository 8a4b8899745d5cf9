"""Choose the weights of Eq. 3 by what they predict of recordings they were not fitted to."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief import likelihood, logistic, sightings
from bdgs_ros.belief.filter import sigmoid
from bdgs_ros.belief.likelihood import FEATURES
from bdgs_ros.belief.logistic import FREE, NEGATIVE, POSITIVE, Bounds, Examples, Weights
from bdgs_ros.bench.likelihood_material import Material, Source
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.eval.calibration import Calibration, calibration

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

DECAY_RATES = (0.05, 0.1, 0.2, 0.4, 0.8)  # 1/s
SHRINKAGES = (1e-5, 1e-4, 1e-3, 1e-2)
LEFT_OUT: Bounds = (0.0, 0.0)

# Where more of a feature can only speak for one side, a weight of the other sign would be noise.
SIGNS: dict[str, Bounds] = {
    'prior': POSITIVE,
    'edge': POSITIVE,
    'color': POSITIVE,
    'warp': POSITIVE,
    'free_space': POSITIVE,
    'streak': NEGATIVE,
}

_SEARCHED = 20_000  # examples of each run that the choice of alpha and shrinkage looks at


@dataclass(frozen=True)
class Pool:
    """Examples of several runs."""

    examples: Examples
    count: NDArray[np.int32]
    """Keyframes of evidence, [R]"""
    run: NDArray[np.int32]
    """Index in `sources`, [R]"""
    map: Mask
    """Whether of the map, not of its shadow, [R]"""
    posterior: Array
    """What the filter said in the run, [R]"""
    sources: tuple[Source, ...]

    def of(self, attribute: str, value: object) -> Mask:
        """Return which examples come from sources with this scenario, seed or detector, [R]."""
        chosen = [getattr(source, attribute) == value for source in self.sources]
        return np.array(chosen, bool)[self.run]

    @property
    def seeds(self) -> list[int]:
        """All seeds, in order."""
        return sorted({source.seed for source in self.sources})


def pool(materials: Sequence[Material], decay_rate: float) -> Pool:
    """
    Put the material of all runs together.

    Parameters
    ----------
    materials : sequence of Material
        Of the features of this version.
    decay_rate : float
        alpha of Eq. 5.

    Raises
    ------
    EvaluationError
        If nothing was seen whose truth is known.

    """
    parts, runs, kinds, counts, posteriors = [], [], [], [], []
    for run, material in enumerate(materials):
        for kind, seen in material.sightings.items():
            fused = sightings.fuse(seen, decay_rate)
            parts.append(fused.examples)
            counts.append(fused.count)
            runs.append(np.full(len(fused.rows), run, np.int32))
            kinds.append(np.full(len(fused.rows), kind == 'map'))
            posteriors.append(seen.posterior[fused.rows])
    if not sum(map(len, parts)):
        raise EvaluationError(
            f'{len(materials)} runs left no example; take recordings in which the camera moves'
        )
    return Pool(
        logistic.joined(parts),
        np.concatenate(counts),
        np.concatenate(runs),
        np.concatenate(kinds),
        np.concatenate(posteriors),
        tuple(material.source for material in materials),
    )


def bounds(without: str | None = None) -> list[Bounds]:
    """Return the limits of all weights, with one feature left out or none."""
    return [LEFT_OUT if n == without else SIGNS.get(n, FREE) for n in FEATURES]


def held_out(found: Pool, limits: list[Bounds], shrinkage: float, rows: Mask) -> Array:
    """
    Predict each seed by the weights that the others give.

    Parameters
    ----------
    found : Pool
        Of at least two seeds.
    limits : list of tuple
        See `bounds`.
    shrinkage : float
        See `logistic.fit`.
    rows : ndarray of bool, shape (R,)
        What is fitted to, and predicted.

    Returns
    -------
    log_odds : ndarray, shape (R,)
        0 where not in `rows`.

    """
    log_odds = np.zeros(len(found.examples), np.float32)
    for seed in found.seeds:
        own = found.of('seed', seed)
        weights = logistic.fit(found.examples.choose(rows & ~own), limits, shrinkage)
        test = rows & own
        log_odds[test] = found.examples.choose(test).log_odds(weights)
    return log_odds


@dataclass(frozen=True)
class Trial:
    """One combination in the search."""

    decay_rate: float
    shrinkage: float
    log_loss: float


def search(
    materials: Sequence[Material],
    limit: float,
    decay_rates: Iterable[float] = DECAY_RATES,
    shrinkages: Iterable[float] = SHRINKAGES,
    seed: int = 0,
) -> list[Trial]:
    """
    Try decay rates and shrinkages on held-out seeds, best first.

    Parameters
    ----------
    materials : sequence of Material
        Of at least two seeds.
    limit : float
        Clamp of the log-odds.
    decay_rates, shrinkages : iterable of float
        What to combine.
    seed : int
        Of the choice of examples.

    """
    trials = []
    shrinkages = list(shrinkages)
    for decay_rate in decay_rates:
        found = pool(materials, decay_rate)
        rows = _thinned(found, np.random.default_rng(seed))
        for shrinkage in shrinkages:
            log_odds = held_out(found, bounds(), shrinkage, rows)
            score = scored(found, log_odds, limit, rows)
            trials.append(Trial(decay_rate, shrinkage, score.log_loss))
    return sorted(trials, key=lambda trial: trial.log_loss)


def _thinned(found: Pool, rng: np.random.Generator) -> Mask:
    """Choose at most `_SEARCHED` examples of each run."""
    size = np.bincount(found.run, minlength=len(found.sources))
    share = np.minimum(1.0, _SEARCHED / np.maximum(size, 1))
    return np.asarray(rng.random(len(found.run)) < share[found.run])


def scored(found: Pool, log_odds: Array, limit: float, rows: Mask) -> Calibration:
    """Compare predictions, clamped as the filter does, with the truth of some examples."""
    predicted = sigmoid(np.clip(log_odds[rows], -limit, limit))
    return calibration(predicted, found.examples.truth[rows])


@dataclass(frozen=True)
class Learned:
    """Weights with all that is known about them."""

    weights: Weights
    """Fitted to everything, in the order of `FEATURES`."""
    decay_rate: float
    shrinkage: float
    trials: tuple[Trial, ...]
    pool: Pool
    log_odds: dict[str, Array]
    """Of all examples by variant: `fitted` (held out), `before`, `without FEATURE` (held out)."""


def learn(
    materials: Sequence[Material],
    config: BeliefConfig,
    decay_rates: Sequence[float] = (),
    leave_out: bool = True,
) -> Learned:
    """
    Choose alpha and shrinkage, fit, and predict what was held out.

    Parameters
    ----------
    materials : sequence of Material
        Of at least two seeds, since whole seeds are held out.
    config : BeliefConfig
        What was in force before, to compare with; its clamp is kept.
    decay_rates : sequence of float
        To choose from; by default that of `config`.
    leave_out : bool
        Fit also without each feature.

    Raises
    ------
    EvaluationError
        If there are fewer than two seeds, or not both kinds of examples.

    """
    seeds = sorted({material.source.seed for material in materials})
    if len(seeds) < 2:
        raise EvaluationError(
            f'weights are judged on seeds that they were not fitted to, but there is only '
            f'{seeds}; give at least two'
        )
    limit = config.max_log_odds
    trials = search(materials, limit, decay_rates or (config.decay_rate,))
    best = trials[0]
    found = pool(materials, best.decay_rate)
    everything = np.ones(len(found.examples), bool)
    variants = {
        'before': found.examples.log_odds(likelihood.weights(config.likelihood).astype(float)),
        'fitted': held_out(found, bounds(), best.shrinkage, everything),
    }
    for name in FEATURES if leave_out else ():
        variants[f'without {name}'] = held_out(found, bounds(name), best.shrinkage, everything)
    weights = logistic.fit(found.examples, bounds(), best.shrinkage)
    return Learned(weights, best.decay_rate, best.shrinkage, tuple(trials), found, variants)
