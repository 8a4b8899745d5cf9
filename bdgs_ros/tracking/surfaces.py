"""Squares of an image that hang together in depth: the planes, and the things."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.tracking.align import Cells

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_BEND = 0.02  # of inverse depth, from square to square, that a plane may have


def planes(cells: Cells) -> Index:
    """Return which plane each square belongs to: neighbours whose planes go on in each other."""
    return _connected(cells, _BEND)


def things(cells: Cells) -> Index:
    """Return which thing each square belongs to: neighbours without a step in depth between."""
    return _connected(cells, np.inf)


def _connected(cells: Cells, bend: float) -> Index:
    """Label an image of the squares with what is between them: there neighbours hang together."""
    plane = cells.plane.reshape(-1, cells.columns, 3)
    rows, columns = plane.shape[:2]
    joined = np.zeros((2 * rows - 1, 2 * columns - 1), np.uint8)
    joined[::2, ::2] = 1
    joined[::2, 1::2] = _goes_on(plane[:, :-1], plane[:, 1:], 1, bend)
    joined[1::2, ::2] = _goes_on(plane[:-1], plane[1:], 2, bend)
    label = cv2.connectedComponents(joined, connectivity=4)[1][::2, ::2]
    return np.asarray(label.reshape(-1), np.intp)


def _goes_on(a: Array, b: Array, axis: int, bend: float) -> NDArray[np.bool_]:
    """Return which of neighbours along an axis are one surface; planes are `Cells.plane`."""
    nearest = np.maximum(a[..., 0], b[..., 0])
    step = np.abs(b[..., 0] - a[..., 0] - 0.5 * (a[..., axis] + b[..., axis]))
    turn = np.abs(b[..., 1:] - a[..., 1:]).max(axis=-1)
    is_known = (a[..., 0] > 0) & (b[..., 0] > 0)
    is_even = (turn < bend * nearest) if np.isfinite(bend) else is_known
    return np.asarray(is_known & (step < _BEND * nearest) & is_even)
