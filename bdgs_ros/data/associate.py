"""Pair colour with depth images by their stamps."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Stamps = NDArray[np.int64]

MAX_DIFFERENCE_S = 0.030
"""BONN and OpenLORIS colour images lie up to 20 ms from their depth; half a period is 17 ms."""


def associate(
    first_ns: Stamps, second_ns: Stamps, max_difference_ns: int
) -> list[tuple[int, int]]:
    """
    Match two sets of stamps one to one, the closest pairs first.

    Parameters
    ----------
    first_ns, second_ns : ndarray, shape (N,) and (M,), int64
        Stamps in any order.
    max_difference_ns : int
        Pairs further apart than this are not made.

    Returns
    -------
    pairs : list of (int, int)
        Indices into both, in order of the first stamp; every index at most once.

    """
    taken_first: set[int] = set()
    taken_second: set[int] = set()
    pairs: list[tuple[int, int]] = []
    for _, i, j in sorted(_candidates(first_ns, second_ns, max_difference_ns)):
        if i not in taken_first and j not in taken_second:
            taken_first.add(i)
            taken_second.add(j)
            pairs.append((i, j))
    return sorted(pairs, key=lambda pair: (int(first_ns[pair[0]]), pair))


def _candidates(
    first_ns: Stamps, second_ns: Stamps, max_difference_ns: int
) -> list[tuple[int, int, int]]:
    """Return every admissible (difference, i, j)."""
    order = np.argsort(second_ns, kind='stable')
    ordered = second_ns[order]
    low = np.searchsorted(ordered, first_ns - max_difference_ns, side='left')
    high = np.searchsorted(ordered, first_ns + max_difference_ns, side='right')
    return [
        (abs(int(first_ns[i]) - int(second_ns[j])), i, int(j))
        for i in range(len(first_ns))
        for j in order[low[i] : high[i]]
    ]
