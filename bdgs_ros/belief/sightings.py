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

    Returns
    -------
    fused : Fused
        `features` are `F_t` and `offset` is what is left of the initial log-odds; see
        `bdgs_ros.belief.logistic`.

    """
    features = np.zeros_like(sightings.features)
    count = np.zeros(len(sightings), np.int32)
    total = np.zeros((len(sightings.born_at), features.shape[1]), np.float32)
    seen = np.zeros(len(total), np.int32)
    seconds = (sightings.stamps_ns - sightings.stamps_ns[:1]) * 1e-9
    now = np.zeros(len(total))
    for rows in _by_keyframe(sightings):
        who, t = sightings.gaussian[rows], seconds[sightings.known_at[rows[0]]]
        once = np.unique(who)
        total[once] *= np.exp(-decay_rate * (t - now[once]))[:, None].astype(np.float32)
        now[once] = t
        weight = np.exp(-decay_rate * (t - seconds[sightings.seen_at[rows]])).astype(np.float32)
        np.add.at(total, who, weight[:, None] * sightings.features[rows])
        np.add.at(seen, who, 1)
        features[rows], count[rows] = total[who], seen[who]
    known = np.flatnonzero(
        (sightings.truth != UNKNOWN) & (sightings.seen_at == sightings.known_at)
    )
    elapsed = seconds[sightings.known_at] - seconds[sightings.born_at[sightings.gaussian]]
    start = logit(sightings.initial)[sightings.gaussian]
    offset = (start * np.exp(-decay_rate * elapsed)).astype(np.float32)
    truth = sightings.truth == DYNAMIC
    return Fused(Examples(features, offset, truth).choose(known), count[known], known)


def _by_keyframe(sightings: Sightings) -> Iterator[Rows]:
    """Yield the rows that became known with each keyframe, in order of time."""
    edges = np.flatnonzero(np.diff(sightings.known_at, prepend=-1, append=-1))
    for start, stop in pairwise(edges.tolist()):
        yield np.arange(start, stop)
