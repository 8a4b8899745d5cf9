"""
The least useful Gaussians given to neighbours that look like them: how the map keeps its budget.

Candidates share a cell of a grid whose pitch follows their size, and face the same way. The
heaviest of a cell takes on the mean, covariance and colour of the mixture of itself and what it
is given, each weighted by opacity, contribution and area, which is its share of the light.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.fusion import State
from bdgs_ros.core.config.mapping import MergeConfig
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.groups import Groups
from bdgs_ros.mapping.parameters import PARAMETERS
from bdgs_ros.mapping.prune import least_useful, usefulness
from bdgs_ros.mapping.rotations import axes_from_quats, quats_from_axes

Array = NDArray[np.float32]
Index = NDArray[np.int64]
Mask = NDArray[np.bool_]

_PLACE_BITS = 18  # of the number of a cell along an axis
_OCTAVES = 80  # of size, around 1 m
_ROUNDS = 3  # each with cells twice as wide


def merge_down_to(gaussians: GaussianMap, count: int, config: MergeConfig) -> None:
    """
    Merge the least useful Gaussians into neighbours that look like them, until `count` are left.

    What finds no such neighbour stays, so that more may be left.

    Parameters
    ----------
    gaussians : GaussianMap
        Changed in place. Hidden, dynamic and uncertain Gaussians stay as they are.
    count : int
        How many are wanted.
    config : MergeConfig
        What counts as alike.

    """
    for i in range(_ROUNDS):
        spare = least_useful(gaussians, len(gaussians) - count)
        if not spare.any():
            return
        groups = find_groups(gaussians, spare, config.reach * 2**i, config.color)
        gaussians.pool(groups, merged_parameters(gaussians, groups))


def find_groups(gaussians: GaussianMap, spare: Mask, reach: float, color: float) -> Groups:
    """
    Give Gaussians to the heaviest one in their cell of a grid, if they look like it.

    Parameters
    ----------
    gaussians : GaussianMap
        The map.
    spare : ndarray of bool, shape (N,)
        Which may be given away.
    reach : float
        Pitch of the grid over the size of the Gaussians, whose sizes within a cell differ by
        less than a factor of two.
    color : float
        Greatest difference of colour, in any channel.

    """
    weight = _weights(gaussians)
    cell = _cells(gaussians, reach)
    groups = _partition(cell, weight)
    leader = groups.leader[groups.label]
    difference = np.abs(gaussians.colors - gaussians.colors[leader]).max(axis=1)
    alone = (difference > color) | ~spare
    alone &= leader != np.arange(len(leader))
    cell[alone] = -1 - np.flatnonzero(alone)
    return _partition(cell, weight)


def merged_parameters(gaussians: GaussianMap, groups: Groups) -> dict[str, Array]:
    """Return the parameters of each group's Gaussian, by name, [M, ...] each."""
    members = np.bincount(groups.label)
    parameters = {name: gaussians.parameters[name][groups.leader] for name in PARAMETERS}
    several = members > 1
    if not several.any():
        return parameters
    take = several[groups.label]
    part = _only(groups, take, several)
    means = gaussians.means[take]
    mean = part.mean(means)
    offset = means - mean[part.label]
    axes = axes_from_quats(gaussians.quats[take])
    half = axes * np.exp(gaussians.log_scales[take])[:, None, :]
    covariance = half @ half.transpose(0, 2, 1) + offset[:, :, None] * offset[:, None, :]
    scales, quats = _ellipsoids(part.mean(covariance))
    parameters['means'][several] = mean
    parameters['quats'][several] = quats
    parameters['log_scales'][several] = np.log(scales)
    parameters['colors'][several] = part.mean(gaussians.colors[take])
    return parameters


def _weights(gaussians: GaussianMap) -> Array:
    scales = np.sort(gaussians.log_scales, axis=1)
    area = np.exp(scales[:, 1] + scales[:, 2])
    return np.asarray(usefulness(gaussians) * area, np.float32)


def _cells(gaussians: GaussianMap, reach: float) -> Index:
    """Number the cell of each Gaussian, [N]; those that must stay alone get one of their own."""
    octave = np.floor(gaussians.log_scales.max(axis=1, initial=-20) / np.log(2)).astype(np.int64)
    pitch = reach * np.exp2(octave + 1.0)[:, None]
    place = np.floor(gaussians.means / pitch).astype(np.int64)
    thinnest = np.argmin(gaussians.log_scales, axis=1)
    axes = axes_from_quats(gaussians.quats) if len(gaussians) else np.zeros((0, 3, 3), np.float32)
    normal = np.take_along_axis(axes, thinnest[:, None, None], axis=2)[..., 0]
    facing = np.argmax(np.abs(normal), axis=1)
    kind = 3 * (octave + _OCTAVES // 2) + facing
    key = kind << 3 * _PLACE_BITS
    for i in range(3):
        key += (place[:, i] & ((1 << _PLACE_BITS) - 1)) << i * _PLACE_BITS
    cell = np.unique(key, return_inverse=True)[1].reshape(-1).astype(np.int64)
    alone = (gaussians.states != State.STATIC) | ~gaussians.visible_mask()
    cell[alone] = -1 - np.flatnonzero(alone)
    return cell


def _partition(cell: Index, weight: Array) -> Groups:
    label = np.unique(cell, return_inverse=True)[1].reshape(-1).astype(np.int64)
    by_weight = np.argsort(weight, kind='stable')
    leader = np.zeros(int(label.max(initial=-1)) + 1, np.int64)
    leader[label[by_weight]] = by_weight  # the last one written is the heaviest
    return Groups(label, leader, weight)


def _only(groups: Groups, take: Mask, several: Mask) -> Groups:
    """Return the groups of several members, with the members numbered anew."""
    number = np.cumsum(several) - 1
    place = np.cumsum(take) - 1
    leader = place[groups.leader[several]]
    return Groups(number[groups.label[take]], leader, groups.weight[take])


def _ellipsoids(covariance: Array) -> tuple[Array, Array]:
    """Return standard deviations, thinnest first, and quaternions of covariances [M, 3, 3]."""
    values, axes = np.linalg.eigh(covariance.astype(np.float64))
    axes[:, :, 2] *= np.sign(np.linalg.det(axes))[:, None]
    scales = np.sqrt(np.maximum(values, 1e-12))
    return scales.astype(np.float32), quats_from_axes(axes.astype(np.float32))
