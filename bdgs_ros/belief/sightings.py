"""What keyframes saw of Gaussians whose truth is known: what weights are fitted to."""

from __future__ import annotations

import zipfile
from collections.abc import Iterator
from dataclasses import dataclass, fields
from itertools import pairwise
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.filter import logit
from bdgs_ros.belief.logistic import Examples
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.files import write_aside

Array = NDArray[np.float32]
Rows = NDArray[np.int64]

STATIC, DYNAMIC, UNKNOWN = 0, 1, -1


@dataclass(frozen=True)
class Sightings:
    """
    One recording: every time that a keyframe saw one of G Gaussians, in the order of `known_at`.

    A keyframe may be asked about a Gaussian that came after it: then `seen_at < known_at`.
    """

    names: NDArray[np.str_]
    """Of the features, [F]"""
    stamps_ns: NDArray[np.int64]
    """Of the keyframes, [K]"""
    born_at: NDArray[np.int32]
    """Keyframe with which each Gaussian came, [G]"""
    initial: Array
    """Belief with which it came, [G]"""
    gaussian: NDArray[np.int32]
    """Who was seen, [R]"""
    seen_at: NDArray[np.int32]
    """Keyframe that saw it, [R]"""
    known_at: NDArray[np.int32]
    """Keyframe at which the filter was told, [R]"""
    features: Array
    """f_k, [R, F]"""
    truth: NDArray[np.int8]
    """At `known_at`: `STATIC`, `DYNAMIC` or `UNKNOWN`, [R]"""
    posterior: Array
    """P(dynamic) that the filter had then, with the weights of the run, [R]"""

    def __len__(self) -> int:
        """Return the number of sightings, R."""
        return len(self.gaussian)

    @property
    def seconds(self) -> NDArray[np.float64]:
        """Time of the keyframes since the first, [K]."""
        return np.asarray((self.stamps_ns - self.stamps_ns[:1]) * 1e-9)

    def save(self, path: Path) -> None:
        """Write all arrays as .npz."""
        arrays = {field.name: getattr(self, field.name) for field in fields(self)}
        write_aside(path, lambda aside: np.savez_compressed(aside, **arrays))

    @classmethod
    def load(cls, path: Path) -> Sightings:
        """
        Read what `save` wrote.

        Raises
        ------
        DatasetError
            If the file is missing, damaged or something else.

        """
        try:
            with np.load(path, allow_pickle=False) as arrays:
                return cls(**{field.name: arrays[field.name] for field in fields(cls)})
        except (OSError, KeyError, ValueError, EOFError, zipfile.BadZipFile) as error:
            raise DatasetError(
                f"'{path}' holds no sightings ({error}); remove it to collect them anew"
            ) from error


@dataclass(frozen=True)
class Fused:
    """The state of the filter at every sighting whose truth is known."""

    examples: Examples
    count: NDArray[np.int32]
    """Keyframes that had seen the Gaussian by then, [R]"""
    rows: Rows
    """Which sightings these are, [R]"""


def fuse(sightings: Sightings, decay_rate: float) -> Fused:
    """
    Add up the features that the filter was told, weighted as in Eq. 5.

    Parameters
    ----------
    sightings : Sightings
        Of one recording.
    decay_rate : float
        alpha in 1/s.

    """
    shape = sightings.features.shape
    memory, views = np.zeros(shape, np.float32), np.zeros(shape, np.float32)
    count = np.zeros(len(sightings), np.int32)
    state = _State(sightings, decay_rate)
    for rows in _by_keyframe(sightings):
        state.add(rows)
        who = sightings.gaussian[rows]
        memory[rows], views[rows], count[rows] = (
            state.memory[who],
            state.views[who],
            state.seen[who],
        )
    at_once = sightings.seen_at == sightings.known_at
    known = np.flatnonzero((sightings.truth != UNKNOWN) & at_once)
    born_at = sightings.born_at[sightings.gaussian]
    later = (sightings.known_at > born_at)[:, None]  # at birth all is told as memory
    seconds = sightings.seconds
    examples = Examples(
        start=logit(sightings.initial)[sightings.gaussian],
        fade=np.exp(-decay_rate * (seconds[sightings.known_at] - seconds[born_at])).astype(
            np.float32
        ),
        memory=memory,
        views=np.where(later, views - sightings.features, 0).astype(np.float32),
        newest=np.where(later, sightings.features, 0).astype(np.float32),
        truth=sightings.truth == DYNAMIC,
    )
    return Fused(examples.choose(known), count[known], known)


class _State:
    """What the filter has been told of each Gaussian up to some keyframe."""

    def __init__(self, sightings: Sightings, decay_rate: float) -> None:
        shape = len(sightings.born_at), sightings.features.shape[1]
        self._sightings = sightings
        self._decay_rate = decay_rate
        self._now = np.zeros(len(sightings.born_at))
        self.memory = np.zeros(shape, np.float32)
        self.views = np.zeros(shape, np.float32)
        self.seen = np.zeros(len(sightings.born_at), np.int32)

    def add(self, rows: Rows) -> None:
        """Take the sightings that became known with one keyframe."""
        said = self._sightings
        who, now = said.gaussian[rows], said.seconds[said.known_at[rows[0]]]
        once = np.unique(who)
        self.views[once] *= self._weight(now - self._now[once])
        self._now[once] = now
        told = self._weight(now - said.seconds[said.seen_at[rows]]) * said.features[rows]
        at_birth = said.born_at[who] == said.known_at[rows]
        np.add.at(self.memory, who[at_birth], told[at_birth])
        np.add.at(self.views, who[~at_birth], told[~at_birth])
        np.add.at(self.seen, who, 1)

    def _weight(self, elapsed_s: NDArray[np.float64]) -> Array:
        return np.exp(-self._decay_rate * elapsed_s)[:, None].astype(np.float32)


def _by_keyframe(sightings: Sightings) -> Iterator[Rows]:
    """Yield the rows that became known with each keyframe, in order of time."""
    edges = np.flatnonzero(np.diff(sightings.known_at, prepend=-1, append=-1))
    for start, stop in pairwise(edges.tolist()):
        yield np.arange(start, stop)
