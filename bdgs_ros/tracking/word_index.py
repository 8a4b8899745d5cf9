"""
Which of many images may show the same as a new one: retrieval by binary words.

An ORB descriptor is hashed by a few random choices of its bits; each hash is a word. Images of
one place share rare words, which an inverse-frequency vote finds in about a millisecond. It is the
bag of words of Galvez-Lopez and Tardos (TRO 2012) with hashes in place of a trained vocabulary.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

Words = NDArray[np.int64]

_TABLES, _BITS = 8, 12  # of the hash: words per feature, and bits of each


class WordIndex:
    """Words of descriptors: random choices of their bits, the same in every run."""

    def __init__(self) -> None:
        rng = np.random.default_rng(0)
        bits = 256  # of an ORB descriptor
        self._bits = np.stack([rng.choice(bits, _BITS, replace=False) for _ in range(_TABLES)])
        self._size = _TABLES << _BITS

    def words(self, descriptors: NDArray[np.uint8]) -> Words:
        """Return the words of descriptors, shape (N, 32), as numbers, shape (N * tables,)."""
        bits = np.unpackbits(descriptors, axis=1)[:, self._bits].astype(np.int64)
        first = np.arange(_TABLES) << _BITS
        return np.asarray((bits @ (1 << np.arange(_BITS)) + first).ravel(), np.int64)

    def likely(self, query: Words, images: Sequence[Words], count: int) -> list[int]:
        """
        Return which images share the rarest words with a query, the best first.

        Parameters
        ----------
        query : ndarray, shape (Q,)
            Words of the query.
        images : sequence of ndarray
            Words of each image.
        count : int
            Of images returned, at most.

        """
        if not query.size or not len(images):
            return []
        votes = self._votes(query, images)
        order = np.argsort(-votes, kind='stable')[:count]
        return [int(i) for i in order if votes[i] > 0]

    def _votes(self, query: Words, images: Sequence[Words]) -> NDArray[np.float64]:
        """Say how much each image shares with a query, rare words counting more."""
        sizes = np.array([words.size for words in images])
        words = np.concatenate(list(images))
        frequency = np.bincount(words, minlength=self._size)
        weight = np.zeros(self._size)
        weight[query] = np.log1p(len(words) / np.maximum(frequency[query], 1))
        owner = np.repeat(np.arange(len(sizes)), sizes)
        shared = np.bincount(owner, weight[words], len(sizes))
        return np.asarray(shared / np.sqrt(np.maximum(sizes, 1)))
