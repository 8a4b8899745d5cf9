"""
Direct RGB-D alignment in readable form: the slow twin of `src/aligner.cpp`.

A reference pixel with inverse depth is moved by `T_current_reference` and projected to (u, v).
Two residuals are compared there, both homoscedastic:

    e_I = I(u, v) - (gain * I_ref + bias)                 grey level in [0, 1]
    e_D = rho(u, v) - 1 / z + pattern . (q - q_ref)       inverse depth, 1/m

`rho` is the measured inverse depth and z the depth of the moved point. `q = (xx, yy, xy)` of the
viewing ray and the three numbers `pattern` describe the slowly varying error of a depth sensor,
which is fixed to the camera and would otherwise hold the image back from moving; they are
estimated along, with a prior, as are gain and bias (auto exposure). Depth is not compared across
discontinuities.

The two residuals share one weight, that of a t-distribution: a pixel whose depth is wrong (an
occlusion) has no say about colour either, and none at all where another surface is seen. Their
scales are medians of the residuals with a floor, and grow with the gradient, because images are
warped to a fraction of a pixel only. The gradient of grey is the mean of both images (efficient
second-order minimisation, Malis 2004).

The motion is updated from the left, `T <- exp(xi) T`, `xi = (rho, phi)`.

Rows of a rolling shutter are read out one after the other while the camera moves on by `sweep`,
a tangent of its own frame. T joins the two cameras in the middle of their readouts; at the row a
share r in [-0.5, 0.5] off the middle a camera is at `T_world_camera exp(r sweep)`. Points are
taken there to first order, `p_row = p - r (rho + phi x p)`, with the row they have without.

References
----------
Kerl, Sturm, Cremers, "Robust odometry estimation for RGB-D cameras", ICRA 2013 (t-distribution).
Kerl, Stueckler, Cremers, "Dense continuous-time tracking and mapping with rolling shutter RGB-D
cameras", ICCV 2015 (that rows are read one after the other).
"""

from __future__ import annotations

from dataclasses import dataclass, field, fields, replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.tracking.pyramid_numpy import Level, Pyramid, build_pyramid, with_dynamic

__all__ = [
    'Params',
    'align',
    'build_pyramid',
    'cells',
    'normal_equations',
    'residual_maps',
    'with_dynamic',
]

Array = NDArray[np.float64]

_LEAST_STATIC = 0.02  # what surely moves is not worth its time
_LEAST_DEPTH_M = 0.05
_BLOCK, _SAMPLE_BLOCKS = 256, 16  # medians are taken of 16 runs of 256 points
_SIGMA_PER_MEDIAN = 1.4826
_OVER_RELAXATION = 1.3  # reweighting and gradient noise make steps too short
_BRIGHTNESS_TIE = 1e-3  # share of the pixels that say gain 1 and bias 0
_SURFACE_SHARE, _SURFACE_SCALES = 0.03, 4.0  # inverse depth may differ by share and scales
_RESERVED = 4  # iterations kept for every finer level
_COARSE_STOP = 2.0  # coarser levels stop at larger steps
_FEWER = 5000  # points are enough on coarser levels, and to tell in the end how well images agree,
_ENOUGH = 20000  # if not much less of them is to be compared
_DOUBT = 1.1  # noise of two images agrees by chance, a little


@dataclass
class Params:
    """The numbers of `AlignConfig` that the kernel needs."""

    max_iterations: int = 20
    stop_px: float = 0.05
    dof: float = 5.0
    intensity_noise: float = 0.01
    pixel_noise: float = 0.2
    depth_noise: float = 0.0025
    depth_weight: float = 0.5
    pattern_information: float = 1.25e5
    inlier_intensity: float = 0.08
    inlier_depth_sigma: float = 6.0
    min_static: float = 0.25
    shade: float = 0.03
    max_points: int = 20000


@dataclass
class Appearance:
    """What differs between the images beside the motion."""

    values: Array = field(default_factory=lambda: np.array([1.0, 0.0, 0.0, 0.0, 0.0]))
    """Gain, bias, and the pattern xx, yy, xy."""


@dataclass(frozen=True)
class Points:
    """The pixels of a reference level that are worth comparing; K of them, row by row."""

    xyz: Array
    """Shape (K, 3), metres in the reference camera."""
    grey: Array
    gradient: Array
    """Shape (K, 2), grey level per pixel."""
    depth_gradient: Array
    """Shape (K, 2), inverse depth per pixel, 0 where it is not one surface."""
    p_static: Array


def row_share(v: Array, height: int) -> Array:
    """Return when a row is read out, as a share of the readout, 0 in the middle."""
    return np.asarray(np.clip((v + 0.5) / height, 0.0, 1.0) - 0.5)


def swept(points: Array, share: Array, sweep: Array) -> Array:
    """Return where a camera has points, shape (K, 3), once it moved by `share` of `sweep`."""
    return np.asarray(points - share[:, None] * (sweep[:3] + np.cross(sweep[3:], points)))


def collect_points(pyramid: Pyramid, index: int) -> Points:
    """Lift the inner pixels with depth that may be static, to the middle of the readout."""
    level = pyramid.level(index)
    inner = np.zeros((level.height, level.width), bool)
    inner[1:-1, 1:-1] = True
    chosen = inner & (level.inverse_depth > 0) & (level.p_static >= _LEAST_STATIC)
    v, u = np.nonzero(chosen)
    fx, fy, cx, cy = level.intrinsics
    z = 1.0 / level.inverse_depth[v, u].astype(np.float64)
    seen = np.stack([(u - cx) / fx * z, (v - cy) / fy * z, z], axis=1)
    return Points(
        swept(seen, -row_share(v.astype(np.float64), level.height), pyramid.sweep),
        level.grey[v, u].astype(np.float64),
        np.stack([level.gx[v, u], level.gy[v, u]], axis=1).astype(np.float64),
        np.stack([level.dx[v, u], level.dy[v, u]], axis=1).astype(np.float64),
        level.p_static[v, u].astype(np.float64),
    )


def spread(points: Points, params: Params) -> tuple[Points, float]:
    """Keep every n-th run of points; return them, and how many each stands for."""
    count = len(points.grey)
    step = max(1, count // params.max_points)
    kept = np.arange(count) // _BLOCK % step == 0
    chosen = Points(*(getattr(points, f.name)[kept] for f in fields(points)))
    return chosen, count / max(1, int(kept.sum()))


@dataclass(frozen=True)
class Warp:
    """Reference points seen by the current camera."""

    xyz: Array
    seen: NDArray[np.bool_]
    u: Array
    v: Array


def move(points: Array, level: Level, T: Array, sweep: Array) -> Array:
    """Take points, shape (K, 3), to the current camera when it reads out their row."""
    middle = points @ T[:3, :3].T + T[:3, 3]
    z = np.where(middle[:, 2] > _LEAST_DEPTH_M, middle[:, 2], 1.0)
    _, fy, _, cy = level.intrinsics
    return swept(middle, row_share(fy * middle[:, 1] / z + cy, level.height), sweep)


def warp(points: Points, level: Level, T: Array, sweep: Array) -> Warp:
    """Move and project; what is not seen gets pixel (1, 1) and depth 1 m."""
    xyz = move(points.xyz, level, T, sweep)
    ahead = xyz[:, 2] > _LEAST_DEPTH_M
    xyz[:, 2] = np.where(ahead, xyz[:, 2], 1.0)
    fx, fy, cx, cy = level.intrinsics
    u = fx * xyz[:, 0] / xyz[:, 2] + cx
    v = fy * xyz[:, 1] / xyz[:, 2] + cy
    seen = ahead & (u >= 1) & (v >= 1) & (u < level.width - 2) & (v < level.height - 2)
    return Warp(xyz, seen, np.where(seen, u, 1.0), np.where(seen, v, 1.0))


def _bilinear(plane: NDArray[np.float32], w: Warp) -> tuple[Array, NDArray[np.bool_]]:
    """Interpolate, and say where all four neighbours are positive."""
    iu, iv = w.u.astype(int), w.v.astype(int)
    fu, fv = w.u - iu, w.v - iv
    corners = [plane[iv + j, iu + i].astype(np.float64) for j in (0, 1) for i in (0, 1)]
    a, b, c, d = corners
    top, bottom = a + fu * (b - a), c + fu * (d - c)
    positive = np.asarray(np.min(corners, axis=0) > 0)
    return np.asarray(top + fv * (bottom - top)), positive


def _nearest(plane: NDArray[np.float32], w: Warp) -> Array:
    return np.asarray(plane[(w.v + 0.5).astype(int), (w.u + 0.5).astype(int)], np.float64)


def _pattern(points: Points, w: Warp) -> Array:
    """Return how the sensor's pattern changes inverse depth along the warp, shape (K, 3)."""
    x, y, z = w.xyz.T
    sx, sy = points.xyz[:, 0] / points.xyz[:, 2], points.xyz[:, 1] / points.xyz[:, 2]
    stretch = (points.xyz[:, 2] / z) ** 2
    tx, ty = x / z, y / z
    return np.stack(
        [tx * tx - stretch * sx * sx, ty * ty - stretch * sy * sy, tx * ty - stretch * sx * sy],
        axis=1,
    )


def _jacobian(gradient: Array, xyz: Array, level: Level) -> Array:
    """
    Return d(image value) / d(rho, phi), shape (K, 6).

    For `p = exp(xi) p0` the point moves by `rho + phi x p`, so the rotation part is the cross
    product of the point with the translation part.
    """
    fx, fy, _, _ = level.intrinsics
    x, y, z = xyz.T
    ax, ay = gradient[:, 0] * fx / z, gradient[:, 1] * fy / z
    move = np.stack([ax, ay, -(ax * x + ay * y) / z], axis=1)
    return np.hstack([move, np.cross(xyz, move)])


@dataclass(frozen=True)
class Linearised:
    """Residuals and Jacobians of K points; rows of points that are not seen weigh nothing."""

    grey: Array
    depth: Array
    J_I: Array
    """Shape (K, 11): rho, phi, gain, bias, pattern."""
    J_D: Array
    has_depth: NDArray[np.bool_]
    seen: NDArray[np.bool_]
    p_static: Array
    grey_gradient: Array
    depth_gradient: Array
    at: NDArray[np.intp]
    """Shape (K, 2): column and row of the nearest pixel of the current image."""
    gap: Array
    """How much nearer the current image is, 1/m; 0 where it has no depth."""
    inverse_z: Array


@dataclass(frozen=True)
class Mixture:
    """Which gradients Jacobians are made of: shares of the current image's and the reference's."""

    grey: float
    grey_reference: float
    depth: float
    depth_reference: float
    along_z: float
    """1, or 0 without the part of depth that needs no gradient."""


FIT = Mixture(0.5, 0.5, 1.0, 0.0, 1.0)  # efficient second order
MEAN = Mixture(0.5, 0.5, 0.5, 0.5, 1.0)  # what both images show, and
HALF = Mixture(0.5, -0.5, 0.5, -0.5, 0.0)  # what they do not agree on


def linearise(
    points: Points,
    level: Level,
    T: Array,
    sweep: Array,
    appearance: Appearance,
    mixture: Mixture = FIT,
) -> Linearised:
    """Return residuals and their derivatives by motion, exposure and depth pattern."""
    w = warp(points, level, T, sweep)
    gain, bias = appearance.values[:2]
    e_I = _bilinear(level.grey, w)[0] - (gain * points.grey + bias)
    measured, smooth = _bilinear(level.smooth, w)
    has_depth = smooth & w.seen
    inverse_z = 1.0 / w.xyz[:, 2]
    change = _pattern(points, w)
    e_D = has_depth * (measured - inverse_z + change @ appearance.values[2:])

    current = np.stack([_nearest(level.gx, w), _nearest(level.gy, w)], axis=1)
    gradient_I = 0.5 * (current + points.gradient)
    gradient_D = np.stack([_nearest(level.dx, w), _nearest(level.dy, w)], axis=1)
    J_I = np.zeros((len(e_I), 11))
    mixed_I = mixture.grey * current + mixture.grey_reference * points.gradient
    mixed_D = mixture.depth * gradient_D + mixture.depth_reference * points.depth_gradient
    J_I[:, :6] = _jacobian(mixed_I, w.xyz, level)
    J_I[:, 6], J_I[:, 7] = -points.grey, -1.0
    J_D = np.zeros((len(e_I), 11))
    J_D[:, :6] = _jacobian(mixed_D, w.xyz, level)
    along_z = np.zeros_like(w.xyz)
    along_z[:, 2] = mixture.along_z * inverse_z**2
    J_D[:, :3] += along_z
    J_D[:, 3:6] += np.cross(w.xyz, along_z)
    J_D[:, 8:] = change
    p_static = w.seen * points.p_static * _nearest(level.p_static, w)
    raw = _nearest(level.inverse_depth, w)
    return Linearised(
        e_I,
        e_D,
        J_I,
        J_D,
        has_depth,
        w.seen,
        p_static,
        gradient_I,
        gradient_D,
        np.stack([w.u + 0.5, w.v + 0.5], axis=1).astype(int),
        np.where(raw > 0, raw - inverse_z, 0.0),
        inverse_z,
    )


@dataclass(frozen=True)
class Scales:
    """Robust standard deviations of the residuals."""

    intensity: float = 0.1
    inverse_depth: float = 0.1


def _median(values: Array) -> float:
    """Return the upper median; 0 of nothing."""
    if len(values) == 0:
        return 0.0
    middle = len(values) // 2
    return float(np.partition(values, middle)[middle])


def _medians(rows: Linearised, params: Params) -> tuple[float, float]:
    """Return the median absolute residuals of a sample of the comparable pixels."""
    block = np.arange(len(rows.grey)) // _BLOCK
    count = -(-len(rows.grey) // _BLOCK)
    sample = (block % max(1, count // _SAMPLE_BLOCKS) == 0) & (rows.p_static >= params.min_static)
    deep = sample & rows.has_depth
    return _median(np.abs(rows.grey[sample])), _median(np.abs(rows.depth[deep]))


def _scales(rows: Linearised, params: Params) -> Scales:
    intensity, inverse_depth = _medians(rows, params)
    return Scales(
        max(params.intensity_noise, _SIGMA_PER_MEDIAN * intensity),
        max(params.depth_noise, _SIGMA_PER_MEDIAN * inverse_depth),
    )


def _same_surface(rows: Linearised, scales: Scales) -> NDArray[np.bool_]:
    """Tell where the image does not show something else: an occluder, or what it uncovered."""
    limit = _SURFACE_SHARE * rows.inverse_z + _SURFACE_SCALES * scales.inverse_depth
    return np.abs(rows.gap) <= limit


def _normalised(rows: Linearised, scales: Scales, params: Params) -> tuple[Array, Array, Array]:
    """Return the variances of colour and depth, and both residuals squared over them."""
    noise = params.pixel_noise**2
    var_I = scales.intensity**2 + noise * (rows.grey_gradient**2).sum(axis=1)
    var_D = scales.inverse_depth**2 + noise * (rows.depth_gradient**2).sum(axis=1)
    return var_I, var_D, rows.grey**2 / var_I + rows.depth**2 / var_D


def _robust(rows: Linearised, squared: Array, same: NDArray[np.bool_], params: Params) -> Array:
    """Return the weights of the t-distribution, 0 where another surface is seen."""
    return np.asarray(same * (params.dof + 1 + rows.has_depth) / (params.dof + squared))


def _totals(
    points: Points, share: float, rows: Linearised, scales: Scales, params: Params
) -> dict[str, Any]:
    """Sum the weighted normal equations and count pixels; each point stands for `share`."""
    var_I, var_D, squared = _normalised(rows, scales, params)
    same = _same_surface(rows, scales)
    weight = rows.p_static * _robust(rows, squared, same, params)
    w_I, w_D = weight / var_I, weight * rows.has_depth * params.depth_weight / var_D
    information: Array = rows.J_I.T @ (w_I[:, None] * rows.J_I)
    information += rows.J_D.T @ (w_D[:, None] * rows.J_D)
    gradient = rows.J_I.T @ (w_I * rows.grey) + rows.J_D.T @ (w_D * rows.depth)
    compared = rows.p_static >= params.min_static
    agree = (np.abs(rows.grey) < params.inlier_intensity) & (
        np.abs(rows.depth) < params.inlier_depth_sigma * params.depth_noise
    )
    reference = points.p_static >= 0.5
    median_I, median_D = _medians(rows, params)
    return {
        'information': share * information,
        'gradient': share * gradient,
        'cost': share * float((weight * squared).sum()),
        'weight': share * float((weight * (1 + rows.has_depth)).sum()),
        'texture': share * float((w_I[:, None] * rows.J_I[:, :2] ** 2).sum()),
        'compared': int(share * compared.sum() + 0.5),
        'inliers': int(share * (compared & agree & same).sum() + 0.5),
        'reference': int(share * reference.sum() + 0.5),
        'in_view': int(share * (reference & rows.seen).sum() + 0.5),
        'median_intensity': median_I,
        'median_inverse_depth': median_D,
    }


def normal_equations(
    reference: Pyramid,
    current: Pyramid,
    reference_level: int,
    current_level: int,
    T: Array,
    gain: float,
    bias: float,
    pattern: Array,
    intensity_scale: float,
    inverse_depth_scale: float,
    params: Params,
) -> dict[str, Any]:
    """Return `information`, shape (11, 11), and `gradient`, shape (11,), at one pose."""
    points, share = spread(collect_points(reference, reference_level), params)
    level = current.level(current_level)
    appearance = Appearance(np.array([gain, bias, *pattern]))
    rows = linearise(points, level, T, current.sweep, appearance)
    return _totals(points, share, rows, Scales(intensity_scale, inverse_depth_scale), params)


def _judged(
    points: Points,
    share: float,
    level: Level,
    T: Array,
    sweep: Array,
    appearance: Appearance,
    scales: Scales,
    params: Params,
) -> dict[str, Any]:
    """
    Compare the images once more where they were found to lie.

    Beside counts and medians it says what both images tell of the motion: `agreed`, shape
    (11, 11), and `texture`. With gradients a and b of the two, `a b' + b a'` is twice the product
    of their mean with itself less that of half their difference. What only one of them has, as
    noise has, is in neither sum: a plain wall tells nothing, however many of its pixels are
    noisy. `texture` is the correlation of the gradients of grey: 1 where they are the same, 0
    where the images have nothing in common.
    """
    mean, half = (
        _totals(
            points,
            share,
            linearise(points, level, T, sweep, appearance, mixture),
            scales,
            params,
        )
        for mixture in (MEAN, HALF)
    )
    agreed = mean.pop('information')
    del mean['gradient']  # the kernel does not tell it either
    agreed[:6, :6] -= _DOUBT * half['information'][:6, :6]
    both, one = mean['texture'], half['texture']
    return {**mean, 'agreed': agreed, 'texture': (both - one) / max(both + one, 1e-12)}


def cells(
    reference: Pyramid,
    current: Pyramid,
    reference_level: int,
    current_level: int,
    T: Array,
    gain: float,
    bias: float,
    pattern: Array,
    size: int,
    params: Params,
) -> dict[str, Any]:
    """
    Return what each square of the current image says of the motion, on its own.

    All that is seen counts, also what is masked, and by the least noise. How bright a square is
    stays open within `shade`: vignettes and shadows are no motion.

    Returns
    -------
    cells : dict
        Of C squares of `size` pixels, row by row, `columns` of them in a row: `information`,
        shape (C, 6, 6), `gradient`, shape (C, 6), and of shape (C,) `cost`, `weight`, `depth_m`
        (mean) and `seen` (points).

    """
    points, level = collect_points(reference, reference_level), current.level(current_level)
    appearance = Appearance(np.array([gain, bias, *pattern]))
    rows = linearise(points, level, T, current.sweep, appearance)
    scales = Scales(params.intensity_noise, params.depth_noise)
    var_I, var_D, squared = _normalised(rows, scales, params)
    same = _same_surface(rows, scales)
    weight = rows.seen * _robust(rows, squared, same, params)
    brightness = np.sqrt(weight / var_I)
    J_I = rows.J_I[:, :6] * brightness[:, None]
    J_D = rows.J_D[:, :6] * np.sqrt(weight * rows.has_depth / var_D)[:, None]
    e_I, e_D = rows.grey * brightness, rows.depth * np.sqrt(weight / var_D)
    columns, lines = -(-level.width // size), -(-level.height // size)
    index = rows.at[:, 1] // size * columns + rows.at[:, 0] // size

    def summed(values: Array) -> Array:
        out = np.zeros((lines * columns, *values.shape[1:]))
        np.add.at(out, index[rows.seen], values[rows.seen])
        return out

    seen = summed(np.ones(len(index)))
    root = np.sqrt(summed(brightness**2) + params.shade**-2)
    mixed = summed(J_I * brightness[:, None]) / root[:, None]
    off = summed(e_I * brightness) / root
    information = summed(J_I[:, :, None] * J_I[:, None] + J_D[:, :, None] * J_D[:, None])
    return {
        'information': information - mixed[:, :, None] * mixed[:, None],
        'gradient': summed(J_I * e_I[:, None] + J_D * e_D[:, None]) - mixed * off[:, None],
        'cost': summed(weight * squared) - off**2,
        'weight': summed(weight * (1 + rows.has_depth)),
        'depth_m': summed(1.0 / rows.inverse_z) / np.maximum(seen, 1),
        'seen': seen,
        'columns': columns,
    }


def _step(
    totals: dict[str, Any],
    T: Array,
    appearance: Appearance,
    prior: tuple[Array, Array] | None,
    params: Params,
) -> Array:
    """Solve the damped normal equations with all priors; returns the step, shape (11,)."""
    A, b = totals['information'].copy(), -totals['gradient']
    A += np.diag(1e-6 * np.diag(A) + 1e-9)
    tie = _BRIGHTNESS_TIE * totals['information'][7, 7]
    weights = np.array([tie, tie, *[params.pattern_information] * 3])
    A[6:, 6:] += np.diag(weights)
    b[6:] -= weights * (appearance.values - np.array([1.0, 0.0, 0.0, 0.0, 0.0]))
    if prior is not None:
        T_prior, information = prior
        A[:6, :6] += information
        b[:6] += information @ se3.log(T_prior @ se3.inverse(T))
    return np.asarray(_OVER_RELAXATION * np.linalg.solve(A, b))


def _step_px(step: Array, level: Level) -> float:
    """Return by how many pixels the step moves a point at 1 m."""
    size = np.linalg.norm(step[:3]) + np.linalg.norm(step[3:6])
    return float(level.intrinsics[0] * size)


def align(
    reference: Pyramid,
    current: Pyramid,
    pairs: list[tuple[int, int]],
    T_init: Array,
    T_prior: Array | None,
    information: Array | None,
    params: Params,
) -> dict[str, Any]:
    """
    Run Gauss-Newton over pairs of levels (reference, current), coarsest first.

    Returns
    -------
    result : dict
        `T`, `gain`, `bias`, `pattern`, `iterations`, `converged`, and how well the images agree
        on the finest level.

    """
    T, appearance = T_init.copy(), Appearance()
    prior = None if T_prior is None or information is None else (T_prior, information)
    fewer = replace(params, max_points=min(params.max_points, _FEWER))
    left, done, converged, scales = params.max_iterations, 0, False, Scales()
    for index, (i, j) in enumerate(pairs):
        finer = len(pairs) - index - 1
        points, share = spread(collect_points(reference, i), fewer if finer else params)
        level = current.level(j)
        budget = min(left, max(2, left - _RESERVED * finer))
        stop = params.stop_px * (_COARSE_STOP if finer else 1.0)
        scales = _scales(linearise(points, level, T, current.sweep, appearance), params)
        converged = False
        while budget > 0 and not converged:
            rows = linearise(points, level, T, current.sweep, appearance)
            totals = _totals(points, share, rows, scales, params)
            step = _step(totals, T, appearance, prior, params)
            T = se3.orthonormalise(se3.exp(step[:6]) @ T)
            appearance = Appearance(appearance.values + step[6:])
            scales = _scales(rows, params)
            converged = _step_px(step, level) < stop
            budget, left, done = budget - 1, left - 1, done + 1
    if totals['compared'] > _ENOUGH:
        points, share = spread(collect_points(reference, i), fewer)
    return {
        **_judged(points, share, level, T, current.sweep, appearance, scales, params),
        'T': T,
        'gain': float(appearance.values[0]),
        'bias': float(appearance.values[1]),
        'pattern': appearance.values[2:],
        'iterations': done,
        'converged': converged,
    }


def residual_maps(
    reference: Pyramid,
    current: Pyramid,
    reference_level: int,
    current_level: int,
    T: Array,
    gain: float,
    bias: float,
    params: Params,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.uint8]]:
    """Compare the current level with the reference warped into it: depth, colour, validity."""
    level = current.level(current_level)
    rho, grey = _splat(collect_points(reference, reference_level), level, T, current.sweep)
    valid = (rho > 0) & (level.inverse_depth > 0)
    far, near = _window(np.where(rho > 0, rho, np.inf), np.minimum), _window(rho, np.maximum)
    dark = _window(np.where(rho > 0, grey, np.inf), np.minimum)
    bright = _window(np.where(rho > 0, grey, -np.inf), np.maximum)
    z = 1.0 / np.where(valid, level.inverse_depth, 1.0)
    bound = np.clip(z, 1.0 / np.where(valid, near, 1.0), 1.0 / np.where(valid, far, 1.0))
    depth_sigma = (bound - z) / (params.depth_noise * np.sqrt(z**4 + bound**4))
    lit = [gain * np.where(valid, shade, 0.0) + bias for shade in (dark, bright)]
    color = np.clip(level.grey, lit[0], lit[1]) - level.grey
    return (
        np.where(valid, depth_sigma, 0.0).astype(np.float32),
        np.where(valid, color, 0.0).astype(np.float32),
        valid.astype(np.uint8),
    )


def _splat(points: Points, level: Level, T: Array, sweep: Array) -> tuple[Array, Array]:
    """Return the z-buffer (inverse depth, 0 = empty) of static points, and their grey levels."""
    static = points.p_static >= 0.5
    xyz = move(points.xyz[static], level, T, sweep)
    grey = points.grey[static]
    ahead = xyz[:, 2] > _LEAST_DEPTH_M
    xyz, grey = xyz[ahead], grey[ahead]
    fx, fy, cx, cy = level.intrinsics
    u = np.floor(fx * xyz[:, 0] / xyz[:, 2] + cx + 0.5).astype(int)
    v = np.floor(fy * xyz[:, 1] / xyz[:, 2] + cy + 0.5).astype(int)
    inside = (u >= 0) & (v >= 0) & (u < level.width) & (v < level.height)
    order = np.argsort(-xyz[inside, 2], kind='stable')  # nearest last: it stays
    u, v = u[inside][order], v[inside][order]
    rho, shade = np.zeros((level.height, level.width)), np.zeros((level.height, level.width))
    rho[v, u], shade[v, u] = 1.0 / xyz[inside, 2][order], grey[inside][order]
    return rho, shade


def _window(plane: Array, extreme: np.ufunc) -> Array:
    """Return the extreme of every 3x3 window."""
    padded = np.pad(plane, 1, mode='edge')
    h, w = plane.shape
    shifted = [padded[j : j + h, i : i + w] for j in range(3) for i in range(3)]
    return np.asarray(extreme.reduce(shifted))
