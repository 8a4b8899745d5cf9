"""
What two keyframes say about their poses: a bundle adjustment of two views, condensed.

Corners of the one view have unknown inverse depths; where the other view shows them and which
depth it measures there are the residuals. The depths are eliminated (Schur complement), and what
is left is a quadratic in the motion between the views and in the `Calibration`:

    E(y) = E_0 + g . y + y . L y / 2      y = (xi, calibration - that of the linearisation)

with `T_other_one = exp(xi) @ T_linearised`. It stands for all corners of the pair, so the problem
over all keyframes (`graph`) has no landmarks and costs milliseconds.
"""

from __future__ import annotations

import contextlib
from dataclasses import dataclass, replace
from importlib import import_module
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.back_end.calibration import SIZE, Calibration
from bdgs_ros.back_end.corners import Shared
from bdgs_ros.core import se3
from bdgs_ros.core.bend import BENDS, bend_functions
from bdgs_ros.core.config.back_end import BundleConfig
from bdgs_ros.core.types import Pose

Array = NDArray[np.float64]

_kernels: Any = None
with contextlib.suppress(ImportError):
    _kernels = import_module('bdgs_ros._two_views')

UNKNOWNS = 6 + SIZE
_FREE = [*range(6), 6 + BENDS]  # of the unknowns, while a pair is condensed
_ROUNDS = 5
_SETTLED = 1e-5
_LEAST_INVERSE, _MOST_INVERSE = 0.05, 5.0  # 1/m


@dataclass(frozen=True)
class PairFactor:
    """The quadratic of one pair of views."""

    T_other_one: Pose
    """Where it was linearised."""
    calibration: Calibration
    """With which."""
    held_readout_s: float
    """Near which the readout was looked for."""
    twists: tuple[Array, Array]
    """Velocities of the one and of the other view."""
    information: Array
    """L, shape (12, 12)."""
    gradient: Array
    """g, shape (12,)."""
    inliers: int
    """Corners within three sigma."""


@dataclass(frozen=True)
class _Linear:
    """Residuals in sigma and their derivatives."""

    residuals: Array
    """[N, 4]: two of the corner's position, one of depth in the other view, one in its own."""
    by_unknowns: Array
    """[N, 4, 12]"""
    by_inverse: Array
    """[N, 4] by the inverse depth of each corner"""


def condense(
    shared: Shared,
    T_other_one: Pose,
    twists: tuple[Array, Array],
    calibration: Calibration,
    readout_sigma_s: float,
    focal_px: float,
    config: BundleConfig,
    native: bool = True,
) -> PairFactor:
    """
    Align two views by their shared corners, and return what that says.

    Parameters
    ----------
    shared : Shared
        At least six corners.
    T_other_one : ndarray, shape (4, 4)
        Start.
    twists : pair of ndarray, shape (6,)
        Velocities of the one and of the other view, in their own frames.
    calibration : Calibration
        What is known; the factor says how the optimum depends on it.
    readout_sigma_s : float
        How well the readout is known. A wrong one would make outliers of the corners that tell
        it, so the pair is linearised at its own.
    focal_px : float
        Of the other view.
    config : BundleConfig
        Noise.
    native : bool
        Use the kernel where it was built; otherwise its twin in numpy.

    """
    if native and _kernels is not None:
        noise = focal_px / config.pixel_sigma, config.inverse_depth_sigma, config.dof
        T, readout_s, information, gradient, inliers = _kernels.condense(
            *_measured(shared), T_other_one, *twists,
            calibration.bend, calibration.readout_s, readout_sigma_s, *noise, _ROUNDS,
        )  # fmt: skip
        at = replace(calibration, readout_s=readout_s)
        return PairFactor(T, at, calibration.readout_s, twists, information, gradient, inliers)
    T, at = np.asarray(T_other_one, np.float64), calibration
    bent = bend_functions(shared.tangents) @ calibration.bend
    inverse = shared.inverse_depth + bent
    for i in range(_ROUNDS):
        linear = linearise(shared, T, twists, at, inverse, focal_px, config)
        weight = shared.p_static[:, None] * _weights(linear.residuals, config.dof)
        information, gradient, back = _eliminate(linear, weight)
        known = (at.readout_s - calibration.readout_s, readout_sigma_s)
        step = _step(information[_FREE][:, _FREE], gradient[_FREE], known)
        if i == _ROUNDS - 1 or np.abs(step).max() < _SETTLED:
            break
        change = back[0] + back[1][:, _FREE] @ step
        inverse = np.clip(inverse + change, _LEAST_INVERSE, _MOST_INVERSE)
        T = se3.exp(step[:6]) @ T
        at = replace(at, readout_s=at.readout_s + float(step[6]))
    inliers = int((np.abs(linear.residuals[:, :3]) < 3).all(axis=1).sum())
    return PairFactor(T, at, calibration.readout_s, twists, information, gradient, inliers)


def _measured(shared: Shared) -> tuple[Array, ...]:
    """Return what is known of the corners, as the kernel takes it."""
    return (
        shared.tangents,
        shared.inverse_depth,
        shared.tangents_other,
        shared.inverse_depth_other,
        shared.rows,
        shared.p_static,
        bend_functions(shared.tangents),
        bend_functions(shared.tangents_other),
    )


def _step(information: Array, gradient: Array, known: tuple[float, float]) -> Array:
    """Return the step of motion and readout, [7], of which an offset and its sigma are known."""
    damped = information + 1e-6 * np.diag(np.diag(information)) + 1e-3 * np.eye(7)
    offset_s, sigma_s = known
    damped[6, 6] += sigma_s**-2
    pull = gradient.copy()
    pull[6] += offset_s / sigma_s**2
    return np.asarray(-np.linalg.solve(damped, pull), np.float64)


def linearise(
    shared: Shared,
    T_other_one: Pose,
    twists: tuple[Array, Array],
    calibration: Calibration,
    inverse: Array,
    focal_px: float,
    config: BundleConfig,
) -> _Linear:
    """
    Return residuals and derivatives at inverse depths, shape (N,).

    Everything is times inverse depth, so that points far away are no special case.
    """
    rotation, translation = T_other_one[:3, :3], T_other_one[:3, 3]
    rays = np.column_stack([shared.tangents, np.ones(len(shared))])
    during_one = _moved(rays, inverse, twists[0], shared.rows[:, 0])
    global_shutter = (rays + calibration.readout_s * during_one) @ rotation.T
    global_shutter += inverse[:, None] * translation
    during_other = _moved(global_shutter, inverse, twists[1], shared.rows[:, 1])
    point = global_shutter - calibration.readout_s * during_other

    by_motion = np.zeros((len(shared), 3, 7))  # of `point` by xi and by the readout
    by_motion[:, :, :3] = inverse[:, None, None] * np.eye(3)
    by_motion[:, :, 3:6] = -se3.hats(point)
    by_motion[:, :, 6] = during_one @ rotation.T - during_other
    depth = 1 / point[:, 2]
    at = point[:, :2] * depth[:, None]
    seen = inverse * depth
    measured = shared.inverse_depth_other > 0
    px, sigma = focal_px / config.pixel_sigma, config.inverse_depth_sigma

    bend_one, bend_other = bend_functions(shared.tangents), bend_functions(shared.tangents_other)
    by_unknowns = np.zeros((len(shared), 4, UNKNOWNS))
    for axis in range(2):
        by_at = by_motion[:, axis] - at[:, axis, None] * by_motion[:, 2]
        by_unknowns[:, axis, _FREE] = px * depth[:, None] * by_at
    known = measured[:, None] / sigma
    by_unknowns[:, 2, _FREE] = -known * (seen * depth)[:, None] * by_motion[:, 2]
    by_unknowns[:, 2, 6 : 6 + BENDS] = -known * bend_other
    by_unknowns[:, 3, 6 : 6 + BENDS] = -bend_one / sigma

    off = shared.inverse_depth_other + bend_other @ calibration.bend
    own = shared.inverse_depth + bend_one @ calibration.bend
    residuals = np.column_stack(
        [
            px * (at - shared.tangents_other),
            np.where(measured, (seen - off) / sigma, 0),
            (inverse - own) / sigma,
        ]
    )
    by_inverse = np.column_stack(
        [
            px * depth[:, None] * (translation[:2] - at * translation[2]),
            measured / sigma * depth * (1 - seen * translation[2]),
            np.full(len(shared), 1 / sigma),
        ]
    )
    return _Linear(residuals, by_unknowns, by_inverse)


def _moved(points: Array, inverse: Array, twist: Array, rows: Array) -> Array:
    """Return how far points, times inverse depth, move per second of readout, [N, 3]."""
    speed = points @ se3.hat(twist[3:]).T + inverse[:, None] * twist[:3]
    return np.asarray(rows[:, None] * speed)


def _weights(residuals: Array, dof: float) -> Array:
    """Return the weights of a t-distribution, [N, 4]; a position's two residuals go together."""
    squares = residuals**2
    squares[:, :2] = squares[:, :2].sum(axis=1, keepdims=True)
    weights = (dof + 1) / (dof + squares)
    weights[:, :2] *= (dof + 2) / (dof + 1)
    weights[:, 3] = 1  # a corner's own depth is what it is
    return np.asarray(weights)


def _eliminate(linear: _Linear, weight: Array) -> tuple[Array, Array, tuple[Array, Array]]:
    """
    Take the inverse depths out of the normal equations.

    Returns information, gradient, and what gives the inverse depths back: their change is
    `back[0] + back[1] @ step`.
    """
    J, r, by_inverse = linear.by_unknowns, linear.residuals, linear.by_inverse
    own = np.maximum((weight * by_inverse**2).sum(axis=1), 1e-9)
    right = (weight * by_inverse * r).sum(axis=1)
    cross = np.einsum('nij,ni->nj', J, weight * by_inverse)
    weighted = (J * weight[:, :, None]).reshape(-1, UNKNOWNS)
    information = weighted.T @ J.reshape(-1, UNKNOWNS) - (cross / own[:, None]).T @ cross
    gradient = weighted.T @ r.ravel() - cross.T @ (right / own)
    return information, gradient, (-right / own, -cross / own[:, None])
