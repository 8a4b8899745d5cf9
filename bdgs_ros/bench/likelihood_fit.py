"""Choose the weights of Eq. 3 by what they predict of recordings they were not fitted to."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief import likelihood, logistic, sightings
from bdgs_ros.belief.filter import sigmoid
from bdgs_ros.belief.likelihood import FEATURES
from bdgs_ros.belief.logistic import (
    FREE,
    NEGATIVE,
    POSITIVE,
    Bounds,
    Clamps,
    Double,
    Examples,
)
from bdgs_ros.bench.likelihood_material import MAP, SHADOW, Material, Source
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.eval.calibration import Calibration, calibration

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

SHRINKAGES = (1e-5, 1e-4, 1e-3)
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

_MOST = {SHADOW: 20_000, MAP: 5_000}  # examples of each run: more change nothing but the time


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


def pool(materials: Sequence[Material], decay_rate: float, seed: int = 0) -> Pool:
    """
    Put the material of all runs together, at random where there is more than is needed.

    Parameters
    ----------
    materials : sequence of Material
        Of the features of this version.
    decay_rate : float
        alpha of Eq. 5.
    seed : int
        Of the choice.

    Raises
    ------
    EvaluationError
        If nothing was seen whose truth is known.

    """
    rng = np.random.default_rng(seed)
    parts, runs, kinds, counts, posteriors = [], [], [], [], []
    for run, material in enumerate(materials):
        for kind, seen in material.sightings.items():
            fused = sightings.fuse(seen, decay_rate)
            total = len(fused.rows)
            chosen = np.sort(rng.choice(total, min(total, _MOST[kind]), replace=False))
            parts.append(fused.examples.choose(chosen))
            counts.append(fused.count[chosen])
            runs.append(np.full(len(chosen), run, np.int32))
            kinds.append(np.full(len(chosen), kind == MAP))
            posteriors.append(seen.posterior[fused.rows[chosen]])
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


def bounds(without: Collection[str] = ()) -> list[Bounds]:
    """Return the limits of all weights; those of features that are left out are 0."""
    return [LEFT_OUT if n in without else SIGNS.get(n, FREE) for n in FEATURES]


@dataclass(frozen=True)
class Settings:
    """What is chosen beside the weights."""

    decay_rate: float
    """alpha"""
    clamps: Clamps
    shrinkage: float
    without: tuple[str, ...] = ()
    """Features that are left out"""


def held_out(found: Pool, settings: Settings) -> Array:
    """
    Predict each seed by the weights that the others give.

    Parameters
    ----------
    found : Pool
        Of at least two seeds.
    settings : Settings
        How to fit.

    Returns
    -------
    log_odds : ndarray, shape (R,)

    """
    log_odds = np.zeros(len(found.examples), np.float32)
    for seed in found.seeds:
        own = found.of('seed', seed)
        others = found.examples.choose(~own)
        weights = _fit(others, settings)
        log_odds[own] = found.examples.choose(own).log_odds(weights, settings.clamps)
    return log_odds


def _fit(examples: Examples, settings: Settings) -> Double:
    limits = bounds(settings.without)
    return logistic.fit(examples, limits, settings.shrinkage, settings.clamps)


@dataclass(frozen=True)
class Trial:
    """One combination in the search."""

    settings: Settings
    log_loss: float


def search(materials: Sequence[Material], choices: Sequence[Settings]) -> list[Trial]:
    """Try settings on held-out seeds, best first."""
    trials = []
    for decay_rate in sorted({settings.decay_rate for settings in choices}):
        found = pool(materials, decay_rate)
        for settings in choices:
            if settings.decay_rate == decay_rate:
                log_loss = scored(found, held_out(found, settings)).log_loss
                trials.append(Trial(settings, log_loss))
    return sorted(trials, key=lambda trial: trial.log_loss)


def scored(found: Pool, log_odds: Array, rows: Mask | slice = slice(None)) -> Calibration:
    """Compare predictions with the truth of some examples."""
    return calibration(sigmoid(log_odds[rows]), found.examples.truth[rows])


@dataclass(frozen=True)
class Learned:
    """Weights with all that is known about them."""

    weights: Double
    """Fitted to everything, in the order of `FEATURES`."""
    settings: Settings
    trials: tuple[Trial, ...]
    pool: Pool
    log_odds: dict[str, Array]
    """Of all examples: `before`, and held out `fitted`, `without FEATURE` and `with FEATURE`."""


def learn(
    materials: Sequence[Material],
    config: BeliefConfig,
    decay_rates: Sequence[float] = (),
    clamps: Sequence[float] = (),
    without: Sequence[str] = (),
) -> Learned:
    """
    Choose what is to be chosen, fit, and predict what was held out.

    Parameters
    ----------
    materials : sequence of Material
        Of at least two seeds, since whole seeds are held out.
    config : BeliefConfig
        What was in force before, to compare with.
    decay_rates, clamps : sequence of float
        To choose from: alpha, and the most that is known before a keyframe; by default those of
        `config`.
    without : sequence of str
        Features to leave out.

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
    trials = search(
        materials,
        [
            Settings(rate, Clamps(config.max_memory_log_odds, clamp), shrinkage, tuple(without))
            for rate in decay_rates or (config.decay_rate,)
            for clamp in clamps or (config.max_log_odds,)
            for shrinkage in SHRINKAGES
        ],
    )
    chosen = trials[0].settings
    found = pool(materials, chosen.decay_rate)
    return Learned(
        weights=_fit(found.examples, chosen),
        settings=chosen,
        trials=tuple(trials),
        pool=found,
        log_odds=_variants(found, chosen, config),
    )


def _variants(found: Pool, chosen: Settings, config: BeliefConfig) -> dict[str, Array]:
    """Predict with the weights so far, with new ones, and without each of the features in use."""
    before = likelihood.weights(config.likelihood).astype(np.float64)
    variants = {
        'before': found.examples.log_odds(before, chosen.clamps),
        'fitted': held_out(found, chosen),
    }
    for name in FEATURES:
        if name in chosen.without:
            settings = replace(chosen, without=tuple(n for n in chosen.without if n != name))
            variants[f'with {name}'] = held_out(found, settings)
        else:
            settings = replace(chosen, without=(*chosen.without, name))
            variants[f'without {name}'] = held_out(found, settings)
    return variants
