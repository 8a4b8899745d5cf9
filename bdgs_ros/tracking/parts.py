"""
Which part of the view is the world, where parts of it move in different ways.

Every square of the image says by its own normal equations which small motion it has seen
(`Aligner.cells`). A rigid part is a set of squares that one motion explains: motions are proposed
by neighbouring squares (RANSAC that is small enough to try all of them). The part with the most
pixels need not be the world: a door or a person may fill the view. What tells the world is how
much surface, in square metres, agrees with a motion, and whether the camera was expected to move
like that.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import partial

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.config.tracking import PartsConfig
from bdgs_ros.core.images import thinned
from bdgs_ros.core.types import DYNAMIC_THRESHOLD, ProbabilityImage
from bdgs_ros.tracking.align import Cells
from bdgs_ros.tracking.surfaces import planes, things

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

FEWEST = 6  # points of a square that is asked
_LIKELY, _ROUNDS = 4, 3  # motions that are refined, and how often
_LOOSE = np.diag([0.1**-2] * 3 + [0.1**-2] * 3)  # m and rad: a proposal stays in the linear range
_LEFT = 0.25  # of the surface has to remain
_LARGE, _CLEARLY = 0.15, 8.0  # share of the view, and excess: for keyframes to go by
_LEAST_NOISE = 0.3  # residuals over those of the sensor


@dataclass(frozen=True)
class Parts:
    """How the world moves, and which squares do not."""

    step: Array
    """Shape (6,): xi of the world, `exp(xi) @ T_current_reference`."""
    moved: Mask
    """Shape (rows, columns)."""
    excess: Array
    """How much worse the world's motion explains a square than the best, [rows, columns]."""
    cells: Cells
    is_other: bool
    """Whether the world is another part than the one that was aligned."""

    def mask(self, shape: tuple[int, int], p_dynamic: float) -> ProbabilityImage:
        """Return P(dynamic) x 255 of an image of this shape."""
        return _grown(self.moved, shape, p_dynamic)

    def unnamed(self, prior: ProbabilityImage) -> Mask:
        """Return which squares move that the prior does not call dynamic, [rows, columns]."""
        size = (self.moved.shape[1], self.moved.shape[0])
        some = np.ascontiguousarray(thinned(prior))
        is_named = cv2.resize(some, size, interpolation=cv2.INTER_AREA) > DYNAMIC_THRESHOLD
        return np.asarray(self.moved & ~is_named)

    def large(self, prior: ProbabilityImage, p_dynamic: float) -> ProbabilityImage | None:
        """
        Return the same of what is large, clearly moves, and is not in the prior; None for nothing.

        Keyframes go by this: what they call dynamic is no landmark and does not enter the map, so
        that single squares must not be called so.
        """
        solid = cv2.morphologyEx(
            self.unnamed(prior).astype(np.uint8), cv2.MORPH_OPEN, np.ones((3, 3), np.uint8)
        )
        count, label = cv2.connectedComponents(solid)
        large = np.zeros_like(self.moved)
        for i in range(1, count):
            own = label == i
            large |= own & (own.mean() > _LARGE and np.median(self.excess[own]) > _CLEARLY)
        return _grown(large, prior.shape, p_dynamic) if large.any() else None


def _grown(squares: Mask, shape: tuple[int, int], p_dynamic: float) -> ProbabilityImage:
    value = np.uint8(round(255 * p_dynamic))
    image = np.where(squares, value, np.uint8(0))
    size = (shape[1], shape[0])
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST), np.uint8)


def find_world(
    cells: Cells, expected: Array, information: Array, config: PartsConfig
) -> Parts | None:
    """
    Find the world's motion among those that squares propose.

    Parameters
    ----------
    cells : Cells
        Of the present image, at the pose that was found.
    expected : ndarray, shape (6,)
        xi of the predicted pose, `exp(xi) @ T_current_reference`.
    information : ndarray, shape (6, 6)
        How sure that is.
    config : PartsConfig
        Limits.

    Returns
    -------
    parts : Parts or None
        None where too little is seen to tell.

    """
    asked = (cells.seen >= FEWEST) & (cells.weight > 0)
    if asked.sum() < config.least:
        return None
    motions = np.vstack([np.zeros((1, 6)), expected[None], _proposals(cells, asked)])
    costs = _cost(cells, motions)
    least = costs.min(axis=0)
    scale = np.maximum(cells.weight, 1e-9) * _noise(cells, asked, least)
    area = np.where(asked, cells.seen * cells.depth_m**2, 0.0)
    area /= area.sum()

    def loss(motions: Array, costs: Array) -> Array:
        unexplained = np.minimum((costs - least) / scale, 1.0) @ area
        off = motions - expected
        surprise = 0.5 * np.einsum('ni,ij,nj->n', off, information, off)
        return np.asarray(config.evidence * unexplained + np.minimum(surprise, config.surprise))

    losses = loss(motions, costs)
    step, is_other = np.zeros(6), False
    if losses[0] - losses.min() > config.margin:
        likely = motions[np.argsort(losses)[:_LIKELY]]
        for _ in range(_ROUNDS):
            likely = np.stack([_refined(cells, step, least, scale, asked) for step in likely])
        losses = loss(likely, _cost(cells, likely))
        step, is_other = likely[np.argmin(losses)], True
    cost = _cost(cells, step[None])[0] / scale
    excess = cost - least / scale
    moved = _what_moves(cells, asked, cost, excess, scale, area, config)
    image = (-1, cells.columns)
    return Parts(step, moved.reshape(image), excess.reshape(image), cells, is_other)


def _what_moves(
    cells: Cells,
    asked: Mask,
    cost: Array,
    excess: Array,
    scale: Array,
    area: Array,
    config: PartsConfig,
) -> Mask:
    """Return the squares that are not the world, by their cost at its motion over their noise."""
    moved = _clear_regions(asked & (excess > config.moved), excess, cells, config)
    # A limb that swings past agrees with no motion; so do single squares of a blurred room.
    unlike, labels = asked & (cost > config.unlike), things(cells)
    moved |= unlike & _move_mostly(labels, moved | unlike, cells, config)[labels]
    whole_things = partial(_whole_things, labels=labels, cost=cost, scale=scale)
    for whole in (_whole_planes, whole_things):
        grown = moved | (asked & whole(moved, cells, config))
        if area[~grown].sum() > _LEFT:
            moved = grown
    return moved


def _clear_regions(candidates: Mask, excess: Array, cells: Cells, config: PartsConfig) -> Mask:
    """
    Return the regions of candidates that clearly are not the world, by their mean excess.

    What a real sensor does (blur, rolling rows, bent depth) also shifts regions of the image
    together, but less.
    """
    image = candidates.reshape(-1, cells.columns).astype(np.uint8)
    label = cv2.connectedComponents(image, connectivity=8)[1].reshape(-1)
    size = np.bincount(label)
    mean = np.bincount(label, weights=excess) / np.maximum(size, 1)
    return np.asarray(candidates & (mean > config.clearly)[label])


def _whole_planes(moved: Mask, cells: Cells, config: PartsConfig) -> Mask:
    """Return planes of which much moves: all of them does, as a door near its hinges."""
    labels = planes(cells)
    return _move_mostly(labels, moved, cells, config)[labels]


def _move_mostly(labels: NDArray[np.intp], moved: Mask, cells: Cells, config: PartsConfig) -> Mask:
    """Return which of the labels are of surfaces of which much moves."""
    size = np.bincount(labels, weights=cells.seen >= FEWEST)
    share = np.bincount(labels, weights=moved) / np.maximum(size, 1)
    return np.asarray((share > config.surface) & (size >= config.least))


def _whole_things(
    moved: Mask,
    cells: Cells,
    config: PartsConfig,
    *,
    labels: NDArray[np.intp],
    cost: Array,
    scale: Array,
) -> Mask:
    """
    Return the plain parts of things that move: a shirt without a pattern agrees with any motion.

    What agrees with the world's motion, and not as well with the thing's, stays the world.
    """
    found = np.zeros_like(moved)
    for label in np.flatnonzero(_move_mostly(labels, moved, cells, config)):
        own = labels == label
        motion = _agreed(cells, own & moved)
        is_world = own & ~moved & (_cost(cells, motion[None])[0] / scale - cost > config.moved)
        if (own & moved).sum() > is_world.sum():
            found |= own & ~is_world
    return found


def _noise(cells: Cells, asked: Mask, least: Array) -> float:
    """Return how large residuals are that some motion explains, over those of the sensor."""
    return max(float(np.median(least[asked] / cells.weight[asked])), _LEAST_NOISE)


def _proposals(cells: Cells, asked: Mask) -> Array:
    """Return the motions that neighbouring squares see together, shape (N, 6)."""
    squares = (cells.information * asked[:, None, None]).reshape(-1, cells.columns, 36)
    H = _windows(squares).reshape(-1, 6, 6)
    g = _windows((cells.gradient * asked[:, None]).reshape(-1, cells.columns, 6)).reshape(-1, 6)
    return np.asarray(-np.linalg.solve(H + _LOOSE, g[..., None])[..., 0])


def _windows(values: Array) -> Array:
    """Sum over windows of 4 x 4 squares, half of them overlapping; shape (rows, columns, K)."""
    blocks = blocks_of_two(values)
    return np.asarray(blocks[1:, 1:] + blocks[:-1, 1:] + blocks[1:, :-1] + blocks[:-1, :-1])


def blocks_of_two(values: Array) -> Array:
    """Sum over 2 x 2 squares, shape (rows, columns, K); an odd row or column is left out."""
    rows, columns = values.shape[0] // 2, values.shape[1] // 2
    four = values[: 2 * rows, : 2 * columns].reshape(rows, 2, columns, 2, -1)
    return np.asarray(four.sum(axis=(1, 3)))


def _cost(cells: Cells, motions: Array) -> Array:
    """Return the cost of each square at each motion, to second order, shape (N, C)."""
    linear = 2 * motions @ cells.gradient.T
    pairs = (motions[:, :, None] * motions[:, None, :]).reshape(-1, 36)
    square = pairs @ cells.information.reshape(-1, 36).T
    return np.asarray(np.maximum(cells.cost + linear + square, 0.0))


def _refined(cells: Cells, step: Array, least: Array, scale: Array, asked: Mask) -> Array:
    """Let the squares that agree with a motion decide on it."""
    return _agreed(cells, asked & ((_cost(cells, step[None])[0] - least) / scale < 1.0))


def _agreed(cells: Cells, members: Mask) -> Array:
    """Return the motion that some squares have seen together, shape (6,)."""
    H = cells.information[members].sum(axis=0)
    return np.asarray(-np.linalg.solve(H + _LOOSE, cells.gradient[members].sum(axis=0)))
