"""
All keyframes at once: the poses and the calibration that suit every pair best.

The normal equations are dense and solved by Cholesky's method; keyframes are bounded in number,
and 100 of them with 1,000 pairs cost 15 ms per round on one core.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from bdgs_ros.back_end.calibration import SIZE, Calibration, Known
from bdgs_ros.back_end.pair import PairFactor
from bdgs_ros.core.bend import BENDS
from bdgs_ros.core.config.back_end import BundleConfig
from bdgs_ros.core.types import Pose

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_ROUNDS = 10
_SETTLED = 1e-4  # m and rad
_TOLERANCE = 9.0  # medians of the pairs' errors beyond which a pair counts less
_NARROWER = 10.0  # what is tolerated, from round to round
_FIXED = 1e8
_SMALL_RAD = 1e-4  # below, 1 - cos loses its digits


@dataclass(frozen=True)
class Edge:
    """A pair of keyframes, by their places in the list of poses."""

    one: int
    other: int
    factor: PairFactor


@dataclass(frozen=True)
class Solution:
    """What suits all pairs best."""

    poses: list[Pose]
    """T_world_camera in the order given; the first one is where it was."""
    calibration: Calibration
    readout_sigma_s: float
    """How well the readout is known, if the pairs are independent of each other."""


def solve(
    poses: Sequence[Pose],
    edges: Sequence[Edge],
    calibration: Calibration,
    known: Known,
    config: BundleConfig,
) -> Solution:
    """
    Minimise the quadratics of all pairs.

    Parameters
    ----------
    poses : sequence of ndarray, shape (4, 4)
        T_world_camera in order of time; where to start, and by `odometry_m` and `odometry_rad`
        where neighbours are to each other.
    edges : sequence of Edge
        Pairs. One that the others contradict counts less (Geman and McClure's weights). At
        first all are tolerated, then less and less (graduated non-convexity, Yang et al., RA-L
        2020), so that a true loop far from the present poses can pull them.
    calibration : Calibration
        Start.
    known : Known
        Of the calibration, beforehand.
    config : BundleConfig
        Noise.

    """
    world = np.array(poses)
    vector = calibration.vector
    pairs = _Pairs.of(edges)
    chain = _neighbours(world)
    sigma = np.repeat([config.odometry_m, config.odometry_rad], 3)
    chain_information = np.broadcast_to(np.diag(sigma**-2), (len(chain.one), 6, 6))
    sure = np.append(np.full(BENDS, config.bend_sigma), known.readout_sigma_s) ** -2
    wide = np.inf
    for _ in range(_ROUNDS):
        system = _System(len(world))
        xi = _apart(world, pairs)
        error = _errors(pairs, xi, vector)
        wide = max(min(wide / _NARROWER, float(error.max(initial=1.0))), 1.0)
        system.add(world, pairs, xi, vector, 1 / (1 + error / wide) ** 2)
        drift = _apart(world, chain)
        system.add_motion(world, chain, chain_information, drift)
        system.add_known(sure, vector - known.calibration.vector)
        step = system.solve()
        moves = step[: 6 * len(world)].reshape(-1, 6)
        world = _exponentials(moves) @ world
        vector = vector + step[6 * len(world) :]
        if wide == 1.0 and np.abs(step).max() < _SETTLED:
            break
    u, _, vt = np.linalg.svd(world[:, :3, :3])  # after many products: back onto SO(3)
    world[:, :3, :3] = u @ vt
    return Solution(list(world), Calibration.of_vector(np.asarray(vector)), system.last_sigma())


@dataclass(frozen=True)
class _Pairs:
    """Edges as arrays."""

    one: Index
    other: Index
    T_other_one: Array
    """[M, 4, 4]"""
    information: Array
    """[M, 12, 12]"""
    gradient: Array
    """[M, 12]"""
    calibration: Array
    """[M, 6] of the linearisation"""

    @classmethod
    def of(cls, edges: Sequence[Edge]) -> _Pairs:
        factors = [edge.factor for edge in edges]
        size = 6 + SIZE
        return cls(
            np.array([e.one for e in edges], np.intp),
            np.array([e.other for e in edges], np.intp),
            np.array([f.T_other_one for f in factors]).reshape(-1, 4, 4),
            np.array([f.information for f in factors]).reshape(-1, size, size),
            np.array([f.gradient for f in factors]).reshape(-1, size),
            np.array([f.calibration.vector for f in factors]).reshape(-1, SIZE),
        )


def _neighbours(world: Array) -> _Pairs:
    """Return the present motions between keyframes that follow each other."""
    count = len(world) - 1
    one = np.arange(count)
    T = _inverses(world[1:]) @ world[:-1]
    nothing = np.zeros((count, 0))
    return _Pairs(one, one + 1, T, nothing, nothing, nothing)


def _apart(world: Array, pairs: _Pairs) -> Array:
    """Return xi of `T_other_one = exp(xi) @ T_linearised` now, [M, 6]; they are small."""
    now = _inverses(world[pairs.other]) @ world[pairs.one]
    change = now @ _inverses(pairs.T_other_one)
    phi = Rotation.from_matrix(change[:, :3, :3]).as_rotvec().reshape(-1, 3)
    rho = change[:, :3, 3]
    second = np.cross(phi, np.cross(phi, rho)) / 12
    return np.concatenate([rho - 0.5 * np.cross(phi, rho) + second, phi], axis=1)


def _errors(pairs: _Pairs, xi: Array, vector: Array) -> Array:
    """Return how far each pair is from what it wants, over what is usual among pairs, [M]."""
    if not len(xi):
        return np.zeros(0)
    pose = pairs.information[:, :6, :6] + 1e-3 * np.eye(6)
    away = vector - pairs.calibration
    pull = pairs.gradient[:, :6] + np.einsum('mij,mj->mi', pairs.information[:, :6, 6:], away)
    error = xi + np.linalg.solve(pose, pull[:, :, None])[:, :, 0]
    chi2 = np.einsum('mi,mij,mj->m', error, pose, error)
    scale = _TOLERANCE * max(float(np.median(chi2)), 6.0)
    return np.asarray(chi2 / scale)


class _System:
    """Normal equations of all poses, perturbed from the left, and the calibration."""

    def __init__(self, count: int) -> None:
        self._count = count
        self._blocks = np.zeros((count, count, 6, 6))
        self._mixed = np.zeros((count, 6, SIZE))
        self._common = np.zeros((SIZE, SIZE))
        self._right = np.zeros((count, 6))
        self._right_common = np.zeros(SIZE)

    def add(self, world: Array, pairs: _Pairs, xi: Array, vector: Array, weight: Array) -> None:
        """Add the quadratics of pairs."""
        information = weight[:, None, None] * pairs.information
        y = np.concatenate([xi, vector - pairs.calibration], axis=1)
        pull = weight[:, None] * pairs.gradient + np.einsum('mij,mj->mi', information, y)
        adjoint = _adjoints(_inverses(world[pairs.other]))
        self._add_blocks(pairs, adjoint, information[:, :6, :6], pull[:, :6])
        mixed = np.swapaxes(adjoint, 1, 2) @ information[:, :6, 6:]
        np.add.at(self._mixed, pairs.one, mixed)
        np.add.at(self._mixed, pairs.other, -mixed)
        self._common += information[:, 6:, 6:].sum(axis=0)
        self._right_common += pull[:, 6:].sum(axis=0)

    def add_motion(self, world: Array, pairs: _Pairs, information: Array, xi: Array) -> None:
        """Add what is known of motions whatever the calibration is."""
        adjoint = _adjoints(_inverses(world[pairs.other]))
        pull = np.einsum('mij,mj->mi', information, xi)
        self._add_blocks(pairs, adjoint, information, pull)

    def add_known(self, information: Array, vector: Array) -> None:
        """Add how far the calibration is from what is known of it; hold the first pose."""
        self._common += np.diag(information)
        self._right_common += information * vector
        self._blocks[0, 0] += _FIXED * np.eye(6)

    def _add_blocks(self, pairs: _Pairs, adjoint: Array, information: Array, pull: Array) -> None:
        back = np.swapaxes(adjoint, 1, 2)
        block = back @ information @ adjoint
        for a, b, sign in (
            (pairs.one, pairs.one, 1),
            (pairs.other, pairs.other, 1),
            (pairs.one, pairs.other, -1),
            (pairs.other, pairs.one, -1),
        ):
            np.add.at(self._blocks, (a, b), sign * block)
        right = np.einsum('mij,mj->mi', back, pull)
        np.add.at(self._right, pairs.one, right)
        np.add.at(self._right, pairs.other, -right)

    def solve(self) -> Array:
        """Return the step of all unknowns, [6 N + 6]."""
        right = np.concatenate([self._right.ravel(), self._right_common])
        return np.asarray(-cho_solve(self._factor(), right))

    def last_sigma(self) -> float:
        """Return the standard deviation of the last unknown."""
        unit = np.zeros(6 * self._count + SIZE)
        unit[-1] = 1
        return float(np.sqrt(cho_solve(self._factor(), unit)[-1]))

    def _factor(self) -> tuple[Array, bool]:
        size = 6 * self._count
        matrix = np.empty((size + SIZE, size + SIZE))
        matrix[:size, :size] = self._blocks.transpose(0, 2, 1, 3).reshape(size, size)
        matrix[:size, size:] = self._mixed.reshape(size, SIZE)
        matrix[size:, :size] = matrix[:size, size:].T
        matrix[size:, size:] = self._common
        triangle, is_lower = cho_factor(matrix)
        return np.asarray(triangle), bool(is_lower)


def _exponentials(xi: Array) -> Array:
    """Return `se3.exp` of tangent vectors, [N, 6], as motions, [N, 4, 4]."""
    rho, phi = xi[:, :3], xi[:, 3:]
    angle = np.maximum(np.linalg.norm(phi, axis=1, keepdims=True), _SMALL_RAD)
    once = np.cross(phi, rho)
    T = np.zeros((len(xi), 4, 4))
    T[:, :3, :3] = Rotation.from_rotvec(phi).as_matrix()
    T[:, :3, 3] = rho + (1 - np.cos(angle)) / angle**2 * once
    T[:, :3, 3] += (angle - np.sin(angle)) / angle**3 * np.cross(phi, once)
    T[:, 3, 3] = 1
    return T


def _inverses(T: Array) -> Array:
    result = np.zeros_like(T)
    rotation = np.swapaxes(T[:, :3, :3], 1, 2)
    result[:, :3, :3] = rotation
    result[:, :3, 3] = -np.einsum('mij,mj->mi', rotation, T[:, :3, 3])
    result[:, 3, 3] = 1
    return result


def _adjoints(T: Array) -> Array:
    """Return Ad with `T exp(xi) = exp(Ad xi) T`, [M, 6, 6]."""
    rotation = T[:, :3, :3]
    result = np.zeros((len(T), 6, 6))
    result[:, :3, :3] = result[:, 3:, 3:] = rotation
    result[:, :3, 3:] = np.cross(T[:, None, :3, 3], np.swapaxes(rotation, 1, 2)).swapaxes(1, 2)
    return result
