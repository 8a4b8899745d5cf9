"""How finely an image is covered: square cells, small where there is detail, as a quadtree."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_MIN_SHARE = 0.5  # of a smallest cell's pixels that must be wanted
_LARGE_SHARE = 0.8  # of a larger cell's: they must not hang over edges


@dataclass(frozen=True)
class Cells:
    """M square cells of an image, of sizes that double."""

    row: NDArray[np.int64]
    """[M] first pixel"""
    column: NDArray[np.int64]
    """[M] first pixel"""
    size: NDArray[np.int64]
    """[M] px per side"""

    def __len__(self) -> int:
        """Return M."""
        return len(self.row)


def choose_cells(
    wanted: Mask, color: Array, smallest: int, doublings: int, threshold: float
) -> Cells:
    """
    Cover the wanted pixels with cells, split where they would lose detail.

    Parameters
    ----------
    wanted : ndarray of bool, shape (H, W)
        Pixels to cover; cells of which too few are wanted are split, or left out.
    color : ndarray, shape (H, W, 3)
        In [0, 1].
    smallest : int
        Size in px of cells that are not split.
    doublings : int
        How often the largest cells can be split.
    threshold : float
        Cells that lose more of the image are split, see `lost_detail`.

    """
    found = []
    size = smallest << doublings
    open_ = np.ones(_cells_shape(wanted.shape, size), bool)
    while size > smallest:
        share = _mean_over_cells(wanted.astype(np.float32), size)
        large = (lost_detail(color, size) <= threshold) & (share >= _LARGE_SHARE)
        found.append(_cells_at(open_ & large, size))
        open_ &= ~large & (share > 0)
        size //= 2
        open_ = _children(open_, _cells_shape(wanted.shape, size))
    share = _mean_over_cells(wanted.astype(np.float32), size)
    found.append(_cells_at(open_ & (share >= _MIN_SHARE), size))
    return Cells(*np.concatenate(found, axis=1))


def _cells_at(where: Mask, size: int) -> NDArray[np.int64]:
    rows, columns = np.nonzero(where)
    return np.stack([rows * size, columns * size, np.full(len(rows), size)])


def lost_detail(color: Array, size: int) -> Array:
    """
    Return what each cell of a size loses of an image.

    One level of a Laplacian pyramid: the root mean square difference, over a cell and the
    channels, between the image and the image shrunk to cells and grown back. Ramps lose nothing.
    """
    rows, columns = _cells_shape(color.shape, size)
    padded = _pad(color, size)
    small = cv2.resize(padded, (columns, rows), interpolation=cv2.INTER_AREA)
    back = cv2.resize(small, padded.shape[1::-1], interpolation=cv2.INTER_LINEAR)
    mean = cv2.resize((padded - back) ** 2, (columns, rows), interpolation=cv2.INTER_AREA)
    return np.sqrt(np.mean(mean, axis=2, dtype=np.float32))


def average(image: Array, cells: Cells) -> Array:
    """Return the mean of an image, shape (H, W, ...), over each cell, shape (M, ...)."""
    result = np.zeros((len(cells), *image.shape[2:]), np.float32)
    for size in np.unique(cells.size):
        at = cells.size == size
        small = _mean_over_cells(image, int(size))
        result[at] = small[cells.row[at] // size, cells.column[at] // size]
    return result


def _mean_over_cells(image: Array, size: int) -> Array:
    if size == 1:
        return image
    rows, columns = _cells_shape(image.shape, size)
    small = cv2.resize(_pad(image, size), (columns, rows), interpolation=cv2.INTER_AREA)
    return np.asarray(small, np.float32)


def _pad(image: Array, size: int) -> Array:
    """Repeat the border so that whole cells cover the image."""
    rows, columns = _cells_shape(image.shape, size)
    down, right = rows * size - image.shape[0], columns * size - image.shape[1]
    if down == right == 0:
        return image
    return np.asarray(cv2.copyMakeBorder(image, 0, down, 0, right, cv2.BORDER_REPLICATE))


def _cells_shape(shape: tuple[int, ...], size: int) -> tuple[int, int]:
    return -(-shape[0] // size), -(-shape[1] // size)


def _children(split: Mask, shape: tuple[int, int]) -> Mask:
    return np.repeat(np.repeat(split, 2, axis=0), 2, axis=1)[: shape[0], : shape[1]]
