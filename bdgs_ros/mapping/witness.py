"""
Inference that keeps a record of what it was told, beside the truth: material for Eq. 3.

The map alone would not do: what the labels call dynamic never enters it, so it holds few examples
of things that move. A shadow map takes random pixels of every keyframe whatever they show.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.fusion import View
from bdgs_ros.belief.likelihood import FEATURES, Features, Observation
from bdgs_ros.belief.sightings import Sightings
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.inference import Inference, Rows

Array = NDArray[np.float32]
Truth = Callable[[Array, Observation], NDArray[np.int8]]
"""Takes centres in world, [N, 3], and a keyframe to states of `belief.sightings`, [N]."""

_SCALE_M = 0.01  # of the shadow's Gaussians, which are never rendered
_OPACITY = 0.5


class Witness(Inference):
    """
    Inference for one map that writes down what it learns of Gaussians which were announced to it.

    Parameters
    ----------
    config : BeliefConfig
        As for `Inference`.
    truth : callable
        What Gaussians really are at the time of a keyframe.
    every : int
        Only every so many-th Gaussian is followed.

    """

    def __init__(self, config: BeliefConfig, truth: Truth, every: int = 1) -> None:
        super().__init__(config)
        self._truth = truth
        self._every = every
        self._said: list[tuple[Observation, Features]] = []
        self._newest: Observation | None = None
        self._stamps_ns: dict[int, int] = {}
        self._born: list[tuple[Rows, int, Array]] = []
        self._followed = np.zeros(0, np.int64)
        self._log: list[tuple[NDArray[np.generic], ...]] = []

    def observe(self, gaussians: GaussianMap, observation: Observation, index: int) -> Features:
        """Do the same as `Inference`, and write it down."""
        self._said.clear()
        self._newest = observation
        self._stamps_ns[index] = observation.stamp_ns
        features = super().observe(gaussians, observation, index)
        self._write(gaussians, np.arange(len(gaussians)), index)
        return features

    def ask_memory(self, gaussians: GaussianMap, rows: Rows, index: int) -> None:
        """Do the same as `Inference`, and follow the new Gaussians from now on."""
        chosen = gaussians.serial[rows] % self._every == 0
        serials = gaussians.serial[rows[chosen]]
        self._born.append((serials, index, gaussians.belief.belief[rows[chosen]].copy()))
        self._followed = np.concatenate([self._followed, serials])
        self._said.clear()
        super().ask_memory(gaussians, rows, index)
        self._write(gaussians, rows, index)

    def _view(self, observation: Observation, features: Features) -> View:
        self._said.append((observation, features))
        return super()._view(observation, features)

    def _write(self, gaussians: GaussianMap, rows: Rows, index: int) -> None:
        """Write down what was said about `rows`, [M], whose features are in that order."""
        assert self._newest is not None
        followed = np.isin(gaussians.serial[rows], self._followed)
        at_stamp = {stamp_ns: k for k, stamp_ns in self._stamps_ns.items()}
        truth = self._truth(gaussians.means[rows], self._newest)
        for observation, features in self._said:
            seen = np.flatnonzero(features.visible & followed)
            of = rows[seen]
            when = np.full(len(seen), at_stamp[observation.stamp_ns], np.int32)
            known = np.full(len(seen), index, np.int32)
            posterior = gaussians.belief.belief[of]
            entry = (
                gaussians.serial[of],
                when,
                known,
                features.values[seen],
                truth[seen],
                posterior,
            )
            self._log.append(entry)

    def sightings(self) -> Sightings:
        """Return all that was written down."""
        serials = np.concatenate([np.zeros(0, np.int64), *(s for s, _, _ in self._born)])
        order = np.argsort(serials)
        born_at = np.concatenate(
            [np.zeros(0, np.int32), *(np.full(len(s), k, np.int32) for s, k, _ in self._born)]
        )
        initial = np.concatenate([np.zeros(0, np.float32), *(b for _, _, b in self._born)])
        nothing = (
            np.zeros(0, np.int64), np.zeros(0, np.int32), np.zeros(0, np.int32),
            np.zeros((0, len(FEATURES)), np.float32), np.zeros(0, np.int8),
            np.zeros(0, np.float32),
        )  # fmt: skip
        who, seen_at, known_at, features, truth, posterior = (
            np.concatenate(column) for column in zip(nothing, *self._log, strict=True)
        )
        count = max(self._stamps_ns, default=-1) + 1
        return Sightings(
            names=np.array(FEATURES),
            stamps_ns=np.array([self._stamps_ns.get(k, 0) for k in range(count)], np.int64),
            born_at=born_at[order],
            initial=initial[order],
            gaussian=np.searchsorted(serials[order], who).astype(np.int32),
            seen_at=seen_at,
            known_at=known_at,
            features=features,
            truth=truth,
            posterior=posterior,
        )


class Shadow:
    """
    A map of random points of every keyframe, unmasked, which nothing is done with but to infer.

    Parameters
    ----------
    config : BeliefConfig
        All Gaussians begin with `config.initial`.
    witness : Witness
        Writes down what is found out about them.
    pixels : int
        Taken from each keyframe.
    lifetime : int
        Keyframes after which they are forgotten.
    seed : int
        Of the choice of pixels.

    """

    def __init__(
        self, config: BeliefConfig, witness: Witness, pixels: int, lifetime: int, seed: int
    ) -> None:
        self._config = config
        self._witness = witness
        self._pixels, self._lifetime = pixels, lifetime
        self._rng = np.random.default_rng(seed)
        self._map = GaussianMap(config)

    def update(self, observation: Observation, index: int) -> None:
        """Take keyframe number `index`."""
        self._witness.observe(self._map, observation, index)
        first = len(self._map)
        self._map.append(self._lift(observation), _OPACITY, index)
        self._witness.ask_memory(self._map, np.arange(first, len(self._map)), index)
        self._map.keep(index - self._map.keyframe_index < self._lifetime)

    def _lift(self, observation: Observation) -> NewGaussians:
        """Return what random pixels with a depth show, as Gaussians."""
        valid = np.flatnonzero(observation.depth_m)
        count = min(self._pixels, len(valid))
        chosen = np.sort(self._rng.choice(valid, count, replace=False))
        points = observation.camera.unproject(observation.depth_m).reshape(-1, 3)[chosen]
        T = observation.T_world_camera
        return NewGaussians(
            means=(points @ T[:3, :3].T + T[:3, 3]).astype(np.float32),
            scales=np.full(count, _SCALE_M, np.float32),
            colors=observation.color.reshape(-1, 3)[chosen],
            belief=np.full(count, self._config.initial, np.float32),
        )
