"""
All keyframes at once: the poses and the calibration that suit every pair best.

Levenberg and Marquardt's method: a step is taken only where it lowers the cost, else it is damped.
The normal equations are dense and solved by Cholesky's method; keyframes are bounded in number,
and 100 of them with 1,000 pairs cost 11 ms per round on one core.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy.linalg import LinAlgError, cho_factor, cho_solve
from scipy.spatial.transform import Rotation

from bdgs_ros.back_end.calibration import SIZE, Calibration, Known
from bdgs_ros.back_end.pair import PairFactor
from bdgs_ros.core import se3
from bdgs_ros.core.bend import BENDS
from bdgs_ros.core.config.back_end import BundleConfig
from bdgs_ros.core.types import Pose

Array = NDArray[np.float64]
Index = NDArray[np.intp]

_ROUNDS = 10
_SETTLED = 3e-4  # m and rad
_TOLERANCE = 9.0  # medians of the pairs' errors beyond which a pair counts less
_NARROWER = 10.0  # what is tolerated, from round to round
_WIDEST = 1e6  # at first; a pair further off than that, some metres, pulls no harder for it
_HELD = 6  # unknowns: the first pose stays
_TRIALS = 4  # of one step, each with more damping
_DAMPED_LEAST, _DAMPED_MORE, _DAMPED_LESS = 1e-4, 30.0, 10.0
_ROUNDING = 1e-9  # of a cost
_FARTHEST_TURN_RAD = 0.5  # in one step
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
        2020), so that a true loop far from the present poses can pull them. How much is bounded:
        else a pair that is off by kilometres keeps its weight until the rounds are over.
    calibration : Calibration
        Start.
    known : Known
        Of the calibration, beforehand.
    config : BundleConfig
        Noise.

    """
    problem = _Problem.of(poses, edges, known, config)
    state = _State(problem.pairs, problem.chain, np.array(poses), calibration.vector)
    wide, damping = _WIDEST * _NARROWER, 0.0
    for _ in range(_ROUNDS):
        error = state.errors
        wide = max(min(wide / _NARROWER, float(error.max(initial=1.0))), 1.0)
        weight = 1 / (1 + error / wide) ** 2
        system = problem.system(state, weight)
        found, damping = problem.descend(state, system, weight, damping)
        largest = np.inf if found is None else _largest_step(state, found)
        state = found or state
        if wide == 1.0 and (found is None or largest < _SETTLED):
            break
    return Solution(
        list(state.upright()), Calibration.of_vector(state.vector), system.last_sigma()
    )


def pair_errors(edges: Sequence[Edge], *states: tuple[Sequence[Pose], Calibration]) -> list[Array]:
    """Return how far pairs are from what they want, [M], at each of some states; 1 is bearable."""
    pairs = _Pairs.of(edges)
    chi2 = []
    for poses, calibration in states:
        world = np.array(poses)
        chi2.append(_State(pairs, _neighbours(world), world, calibration.vector).chi2)
    scale = min(_tolerance(each) for each in chi2)
    return [each / scale for each in chi2]


def motions_apart(before: Sequence[Pose], after: Sequence[Pose]) -> Array:
    """Return by what the motion of each pose to the next has changed, (rho, phi), [N - 1, 6]."""
    return _apart(np.array(after), _neighbours(np.array(before)))


@dataclass(frozen=True)
class _State:
    """Where everything is, and what pairs say to that."""

    pairs: _Pairs
    chain: _Pairs
    """Neighbours in time, whose motion is roughly known."""
    world: Array
    """[N, 4, 4]"""
    vector: Array
    """[6] of the calibration"""

    @cached_property
    def away(self) -> Array:
        """Unknowns of each pair from where it was linearised, [M, 12]."""
        away = self.vector - self.pairs.calibration
        return np.concatenate([_apart(self.world, self.pairs), away], axis=1)

    @cached_property
    def drift(self) -> Array:
        """How neighbours' motions have changed, [N - 1, 6]."""
        return _apart(self.world, self.chain)

    @property
    def chi2(self) -> Array:
        """Squared distance of each pair from the motion that it wants, in sigma, [M]."""
        wanted, by_calibration = self.pairs.optimum
        y = self.away
        error = (y[:, :6] + wanted)[:, :, None] + by_calibration @ y[:, 6:, None]
        return np.asarray((error * (self.pairs.regular @ error)).sum(axis=(1, 2)))

    @property
    def errors(self) -> Array:
        """How far each pair is from what it wants, over what is usual among pairs, [M]."""
        chi2 = self.chi2
        return chi2 / _tolerance(chi2)

    def moved(self, step: Array) -> _State:
        """Return the state after a step of all unknowns, [6 N + 6]."""
        size = 6 * len(self.world)
        world = _exponentials(step[:size].reshape(-1, 6)) @ self.world
        return replace(self, world=world, vector=self.vector + step[size:])

    def upright(self) -> Array:
        """Return the poses with their rotations, after many products, back on SO(3)."""
        u, _, vt = np.linalg.svd(self.world[:, :3, :3])
        world = self.world.copy()
        world[:, :3, :3] = u @ vt
        return world


def _largest_step(one: _State, other: _State) -> float:
    poses = np.abs(other.world - one.world).max()
    return float(max(poses, np.abs(other.vector - one.vector).max()))


@dataclass(frozen=True)
class _Problem:
    """What is to be minimised."""

    pairs: _Pairs
    chain: _Pairs
    """Neighbours in time, whose motion is roughly known."""
    sure: Array
    """[6] information of what is known of the calibration"""
    known: Array
    """[6]"""

    @classmethod
    def of(
        cls, poses: Sequence[Pose], edges: Sequence[Edge], known: Known, config: BundleConfig
    ) -> _Problem:
        sigma = np.repeat([config.odometry_m, config.odometry_rad], 3)
        chain = _neighbours(np.array(poses), np.diag(sigma**-2))
        sure = np.append(np.full(BENDS, config.bend_sigma), known.readout_sigma_s) ** -2
        return cls(_Pairs.of(edges), chain, sure, known.calibration.vector)

    def system(self, state: _State, weight: Array) -> _System:
        """Linearise."""
        system = _System(len(state.world))
        system.add(state, weight)
        system.add_motion(state)
        system.add_known(self.sure, state.vector - self.known)
        return system

    def cost(self, state: _State, weight: Array) -> float:
        """Return the weighted quadratics at a state."""
        pull = self.pairs.gradient + 0.5 * _times(self.pairs, state.away)
        own = (state.away * pull).sum(axis=1)
        chain = 0.5 * np.sum(state.drift * _times(self.chain, state.drift))
        known = 0.5 * np.sum(self.sure * (state.vector - self.known) ** 2)
        return float(weight @ own + chain + known)

    def descend(
        self, state: _State, system: _System, weight: Array, damping: float
    ) -> tuple[_State | None, float]:
        """
        Step to where the cost is lower, with as little damping as that takes.

        Weights that fall with the error majorise the robust cost: what lowers the one lowers the
        other. Returns None where no step is found, and the damping to begin with next time.
        """
        cost = self.cost(state, weight)
        most = cost + _ROUNDING * max(abs(cost), 1.0)
        for _ in range(_TRIALS):
            step = system.solve(damping)
            if step is not None:
                found = state.moved(_bounded(step))
                if self.cost(found, weight) <= most:
                    return found, damping / _DAMPED_LESS if damping > _DAMPED_LEAST else 0.0
            damping = max(_DAMPED_LEAST, _DAMPED_MORE * damping)
        return None, damping


def _bounded(step: Array) -> Array:
    """Shorten a step that turns too far for a linearisation to hold."""
    turn = np.abs(step[:-SIZE].reshape(-1, 6)[:, 3:]).max()
    return np.asarray(step * min(1.0, _FARTHEST_TURN_RAD / max(turn, 1e-12)))


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
        """Gather factors."""
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

    @cached_property
    def regular(self) -> Array:
        """Information of the motions, never quite singular, [M, 6, 6]."""
        return np.asarray(self.information[:, :6, :6] + 1e-3 * np.eye(6))

    @cached_property
    def optimum(self) -> tuple[Array, Array]:
        """What a pair wants of -xi, [M, 6], and how that changes with the calibration."""
        right = np.concatenate([self.gradient[:, :6, None], self.information[:, :6, 6:]], axis=2)
        wanted = np.linalg.solve(self.regular, right)
        return wanted[:, :, 0], wanted[:, :, 1:]


def _neighbours(world: Array, information: Array | None = None) -> _Pairs:
    """Return the present motions between keyframes that follow each other."""
    count = len(world) - 1
    one = np.arange(count)
    T = _inverses(world[1:]) @ world[:-1]
    each = np.broadcast_to(np.zeros((6, 6)) if information is None else information, (count, 6, 6))
    return _Pairs(one, one + 1, T, each, np.zeros((count, 6)), np.zeros((count, SIZE)))


def _apart(world: Array, pairs: _Pairs) -> Array:
    """Return xi of `T_other_one = exp(xi) @ T_linearised` now, [M, 6]."""
    now = _inverses(world[pairs.other]) @ world[pairs.one]
    change = now @ _inverses(pairs.T_other_one)
    phi = se3.rotation_vectors(change[:, :3, :3])
    rho = change[:, :3, 3]
    half = np.maximum(0.5 * np.linalg.norm(phi, axis=1, keepdims=True), _SMALL_RAD)
    share = (1 - half / np.tan(half)) / (2 * half) ** 2  # 1/12 where the turn is small
    turn = se3.hats(phi)
    once = np.matmul(turn, rho[:, :, None])
    twice = np.matmul(turn, once)[:, :, 0]
    return np.concatenate([rho - 0.5 * once[:, :, 0] + share * twice, phi], axis=1)


def _times(pairs: _Pairs, y: Array) -> Array:
    """Return information times unknowns."""
    return np.asarray(np.matmul(pairs.information, y[:, :, None])[:, :, 0])


def _tolerance(chi2: Array) -> float:
    usual = float(np.median(chi2)) if len(chi2) else 0.0
    return _TOLERANCE * max(usual, 6.0)


class _System:
    """Normal equations of all poses, perturbed from the left, and the calibration."""

    def __init__(self, count: int) -> None:
        size = 6 * count
        self._matrix = np.zeros((size + SIZE, size + SIZE))
        # They share its memory.
        self._blocks = self._matrix[:size, :size].reshape(count, 6, count, 6).swapaxes(1, 2)
        self._mixed = self._matrix[:size, size:].reshape(count, 6, SIZE)
        self._common = self._matrix[size:, size:]
        self._right = np.zeros(size + SIZE)
        self._right_poses = self._right[:size].reshape(count, 6)
        self._right_common = self._right[size:]
        self._factors: dict[float, tuple[Array, bool]] = {}  # by damping

    def add(self, state: _State, weight: Array) -> None:
        """Add the quadratics of pairs."""
        pairs, y = state.pairs, state.away
        information = weight[:, None, None] * pairs.information
        pull = weight[:, None] * (pairs.gradient + _times(pairs, y))
        slope = _slopes(pairs, state.world, y[:, :6])
        self._add_blocks(pairs, slope, information[:, :6, :6], pull[:, :6])
        mixed = np.swapaxes(slope, 1, 2) @ information[:, :6, 6:]
        np.add.at(self._mixed, pairs.one, mixed)
        np.add.at(self._mixed, pairs.other, -mixed)
        self._common += information[:, 6:, 6:].sum(axis=0)
        self._right_common += pull[:, 6:].sum(axis=0)

    def add_motion(self, state: _State) -> None:
        """Add what is known of motions whatever the calibration is."""
        chain = state.chain
        slope = _slopes(chain, state.world, state.drift)
        self._add_blocks(chain, slope, chain.information, _times(chain, state.drift))

    def add_known(self, information: Array, vector: Array) -> None:
        """Add how far the calibration is from what is known of it."""
        self._common += np.diag(information)
        self._right_common += information * vector

    def _add_blocks(self, pairs: _Pairs, slope: Array, information: Array, pull: Array) -> None:
        back = np.swapaxes(slope, 1, 2)
        block = back @ information @ slope
        for a, b, sign in (
            (pairs.one, pairs.one, 1),
            (pairs.other, pairs.other, 1),
            (pairs.one, pairs.other, -1),
            (pairs.other, pairs.one, -1),
        ):
            np.add.at(self._blocks, (a, b), sign * block)
        right = np.einsum('mij,mj->mi', back, pull)
        np.add.at(self._right_poses, pairs.one, right)
        np.add.at(self._right_poses, pairs.other, -right)

    def solve(self, damping: float) -> Array | None:
        """Return Marquardt's step of all unknowns, [6 N + 6], or None where there is none."""
        try:
            step = -cho_solve(self._factor(damping), self._right[_HELD:])
        except (LinAlgError, ValueError):  # not positive, or not finite
            return None
        return np.concatenate([np.zeros(_HELD), step])

    def last_sigma(self) -> float:
        """Return the standard deviation of the last unknown; infinite where it is not known."""
        unit = np.zeros(len(self._right) - _HELD)
        unit[-1] = 1
        try:
            return float(np.sqrt(cho_solve(self._factor(0.0), unit)[-1]))
        except (LinAlgError, ValueError):
            return np.inf

    def _factor(self, damping: float) -> tuple[Array, bool]:
        if damping not in self._factors:
            matrix = self._matrix[_HELD:, _HELD:].copy()  # the upper triangle is what counts
            matrix[np.diag_indices_from(matrix)] *= 1 + damping
            triangle, is_lower = cho_factor(matrix.T, lower=True, overwrite_a=True)
            self._factors[damping] = np.asarray(triangle), bool(is_lower)
        return self._factors[damping]


def _slopes(pairs: _Pairs, world: Array, xi: Array) -> Array:
    """Return the derivatives of xi by a move of `one`, [M, 6, 6]; by `other` their negatives."""
    adjoint = _adjoints(_inverses(world[pairs.other]))
    turning = np.zeros((len(xi), 6, 6))
    turning[:, :3, :3] = turning[:, 3:, 3:] = se3.hats(xi[:, 3:])
    turning[:, :3, 3:] = se3.hats(xi[:, :3])
    # The inverse of the left Jacobian to second order.
    return np.asarray(adjoint - turning @ (0.5 * adjoint - turning @ adjoint / 12))


def _exponentials(xi: Array) -> Array:
    """Return `se3.exp` of tangent vectors, [N, 6], as motions, [N, 4, 4]."""
    rho, phi = xi[:, :3], xi[:, 3:]
    angle = np.maximum(np.linalg.norm(phi, axis=1, keepdims=True), _SMALL_RAD)
    turn = se3.hats(phi)
    once = np.matmul(turn, rho[:, :, None])
    twice = np.matmul(turn, once)[:, :, 0]
    T = np.zeros((len(xi), 4, 4))
    T[:, :3, :3] = Rotation.from_rotvec(phi).as_matrix()
    T[:, :3, 3] = rho + (1 - np.cos(angle)) / angle**2 * once[:, :, 0]
    T[:, :3, 3] += (angle - np.sin(angle)) / angle**3 * twice
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
    result[:, :3, 3:] = se3.hats(T[:, :3, 3]) @ rotation
    return result
