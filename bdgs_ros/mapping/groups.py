"""Gaussians in groups, and what a group has in common."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Index = NDArray[np.int64]
Count = TypeVar('Count', NDArray[np.int32], NDArray[np.float32])


@dataclass(frozen=True)
class Groups:
    """A partition of N Gaussians into M groups, most of one member."""

    label: Index
    """[N] group of each Gaussian"""
    leader: Index
    """[M] heaviest member of each group"""
    weight: Array
    """[N] opacity times area, m^2"""

    def mean(self, values: Array) -> Array:
        """Return the weighted mean of each group, of values [N, ...], [M, ...]."""
        flat = values.reshape(len(values), -1)
        total = np.maximum(self.total(np.ones_like(self.weight)), 1e-20)
        columns = [self.total(column) / total for column in flat.T]
        return np.stack(columns, axis=1).reshape(-1, *values.shape[1:]).astype(np.float32)

    def total(self, values: Array) -> NDArray[np.float64]:
        """Return the sum of weight times values, [N], over each group, [M]."""
        sums = np.bincount(self.label, self.weight * values, len(self.leader))
        return np.asarray(sums, np.float64)

    def least(self, values: Count) -> Count:
        """Return the smallest of the values, [N], in each group, [M]."""
        result = values[self.leader].copy()
        np.minimum.at(result, self.label, values)
        return result

    def most(self, values: Count) -> Count:
        """Return the largest of the values, [N], in each group, [M]."""
        result = values[self.leader].copy()
        np.maximum.at(result, self.label, values)
        return result
