"""
How a depth sensor bends what is flat, learned from pairs of keyframes.

A depth camera that matches a projected pattern errs by what its factory calibration left over:
a wall at 3 m reads a hand's breadth nearer at the rim of the image than in its middle. Each
keyframe then says something else about the same wall. The error varies slowly over the image and
is fixed to the camera, and it is one of disparity, so one of inverse depth:

    1 / z_true = 1 / z + sum_k c_k q_k(x, y)        x, y: tangents of the viewing ray

with few smooth functions `q_k` (`bdgs_ros.core.bend`). No calibration target is needed, as in
Teichman, Miller and Thrun, "Unsupervised intrinsic calibration of depth sensors via SLAM" (RSS
2013), whose table of factors per pixel and distance needs minutes of data; ours has a handful of
numbers.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import lru_cache

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.bend import BENDS, bend_functions, inverse_depth_bend
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import DepthImage, Keyframe, Pose
from bdgs_ros.mapping.keyframes import MapKeyframe, is_dynamic, shrink

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
Matrix = NDArray[np.float64]

_ROUNDS = 4  # of reweighting
_WIDTH = 80  # of the images that are compared, px
_NOISE = 0.004  # of inverse depth, 1/m
_TOLERANCE = 3.0  # noises beyond which differences count less
_SAME_SURFACE = 0.03  # 1/m
_EDGE = 0.03  # of the depth: larger steps between neighbours are edges
_INDEPENDENT = 100.0  # pixels of a pair that err each for itself
_MIN_PIXELS, _MAX_PIXELS = 200, 1500
_PRIOR_SIGMA = 0.01  # of a coefficient, 1/m: what sensors are like
_KNOWN_SIGMA = 0.004  # of one that an earlier run found
_MIN_SLANT = 0.2  # of a surface: nothing is learned from those seen under a smaller sine
_LEAST_M, _LEAST_INVERSE = 0.05, 0.05
_CHANGED = 0.001  # 1/m: keyframes whose correction is off by less keep it
_SOME = 9  # pixels per row and column that stand for all: bends are smooth
_FARTHEST = 2.0  # times its measured depth is where a correction may put a surface


class DepthBend:
    """The bend of one depth camera; starts as none and learns with each pair of images."""

    def __init__(self, coefficients: Sequence[float] = ()) -> None:
        start = np.array(coefficients if len(coefficients) else np.zeros(BENDS), np.float64)
        if start.shape != (BENDS,) or not np.isfinite(start).all():
            raise ValueError(f'coefficients: expected {BENDS} numbers, received {start}')
        self.coefficients: tuple[float, ...] = tuple(start.tolist())
        """c_k, 1/m."""
        self._start = start
        sigma = _KNOWN_SIGMA if start.any() else _PRIOR_SIGMA
        self._information = np.eye(BENDS) / sigma**2
        self._evidence = self._information @ start

    def correct(self, depth_m: DepthImage, camera: PinholeCamera) -> DepthImage:
        """Return depth without the bend, shape (H, W); what is invalid stays so."""
        return shift(depth_m, inverse_depth_bend(camera, self.coefficients))

    def bend(self, depth_m: DepthImage, camera: PinholeCamera) -> DepthImage:
        """Return the depth that the camera would measure, shape (H, W)."""
        return shift(depth_m, -inverse_depth_bend(camera, self.coefficients))

    def renew(self, keyframe: MapKeyframe) -> None:
        """Bring the depth of a keyframe, corrected when less was known, up to date."""
        held = keyframe.depth_bend or (0.0,) * BENDS
        change = tuple(new - old for new, old in zip(self.coefficients, held, strict=True))
        if _largest_bend(keyframe.levels[-1].camera, change) < _CHANGED:
            return
        keyframe.levels = tuple(
            replace(level, depth_m=shift(level.depth_m, inverse_depth_bend(level.camera, change)))
            for level in keyframe.levels
        )
        keyframe.depth_bend = self.coefficients

    def learn(self, one: RangeImage, other: RangeImage) -> None:
        """Take what two images say about the surfaces that both show."""
        found = _compare(one, other, np.array(self.coefficients))
        if found is None:
            return
        information, evidence = found
        self._information += information
        self._evidence += evidence
        covariance = np.linalg.inv(self._information)
        change = covariance @ self._evidence - self._start
        doubt = np.diag(covariance) / np.maximum(change**2, 1e-12)
        # What is within its own uncertainty is not applied (shrinkage of James and Stein).
        self.coefficients = tuple((self._start + np.maximum(1 - doubt, 0) * change).tolist())


def _largest_bend(camera: PinholeCamera, coefficients: tuple[float, ...]) -> float:
    """Return the largest of `inverse_depth_bend`, of either sign, at some pixels, 1/m."""
    return float(np.abs(_functions_at_some(camera) @ coefficients).max())


@lru_cache(maxsize=8)
def _functions_at_some(camera: PinholeCamera) -> Matrix:
    columns = np.linspace(0, camera.width - 1, _SOME)
    rows = np.linspace(0, camera.height - 1, _SOME)
    return bend_functions(camera.tangents(np.stack(np.meshgrid(columns, rows), -1).reshape(-1, 2)))


def shift(depth_m: DepthImage, change: Array) -> DepthImage:
    """Add to inverse depth, shape (H, W), 1/m; what is invalid stays so."""
    factor = np.maximum(1 + depth_m * change, np.float32(1 / _FARTHEST))
    return np.asarray(depth_m / factor, np.float32)


@dataclass(frozen=True)
class RangeImage:
    """A small image of inverse depth, as bends are compared."""

    camera: PinholeCamera
    inverse: Matrix
    """[H, W], 1/m as measured"""
    gradient: Matrix
    """[H, W, 2] by the tangents x and y of the viewing ray"""
    usable: Mask
    """[H, W] where nothing moves, away from edges"""
    T_world_camera: Pose

    @classmethod
    def of(cls, keyframe: Keyframe) -> RangeImage:
        """Take the depth of a keyframe as it was measured."""
        small = shrink(keyframe, _WIDTH)
        depth, camera = small.frame.depth_m, small.frame.camera
        valid = np.isfinite(depth) & (depth > _LEAST_M)
        inverse = np.where(valid, 1 / np.where(valid, depth, 1), 0).astype(np.float64)
        gradient = np.zeros((*depth.shape, 2))
        gradient[:, 1:-1, 0] = (inverse[:, 2:] - inverse[:, :-2]) * (camera.fx / 2)
        gradient[1:-1, :, 1] = (inverse[2:] - inverse[:-2]) * (camera.fy / 2)
        kernel = np.ones((3, 3), np.uint8)
        low, high = cv2.erode(inverse, kernel), cv2.dilate(inverse, kernel)
        moving = is_dynamic(small.p_dynamic).astype(np.uint8)
        still = cv2.dilate(moving, np.ones((5, 5), np.uint8)) == 0
        usable = still & (low > 0) & (high - low < _EDGE * 2 * inverse)
        inner = np.zeros(depth.shape, bool)
        inner[1:-1, 1:-1] = True
        slant = np.abs(inverse) > _MIN_SLANT * np.linalg.norm(gradient, axis=2)
        return cls(
            camera, inverse, gradient, np.asarray(usable & inner & slant), small.T_world_camera
        )


def _compare(one: RangeImage, other: RangeImage, start: Matrix) -> tuple[Matrix, Matrix] | None:
    """
    Return information matrix and vector of the coefficients; None if too little shows.

    The six numbers of the pair's pose are unknown too, and eliminated (Schur complement).
    """
    rows = _residuals(one, other, start)
    if rows is None:
        return None
    error, by_pose, by_bend = rows
    weight = np.ones(len(error))
    for _ in range(_ROUNDS):
        share = (weight / len(error))[:, None]
        normal = (by_pose * share).T @ by_pose + 1e-9 * np.eye(6)
        right = (by_pose * share).T @ np.column_stack([by_bend, error])
        solved = np.linalg.solve(normal, right)
        left = error - by_pose @ solved[:, -1]
        weight = 1 / (1 + (left / _TOLERANCE) ** 2) ** 2
    own = by_bend - by_pose @ solved[:, :-1]
    information = (own * share).T @ own * _INDEPENDENT
    evidence = information @ start - (own * share).T @ left * _INDEPENDENT
    return information, evidence


def _residuals(
    one: RangeImage, other: RangeImage, c: Matrix
) -> tuple[Matrix, Matrix, Matrix] | None:
    """
    Compare the inverse depth that `other` measured with that of the points of `one`.

    Returns the difference in noises, [n], and its derivatives by the motion (rho, phi) of the
    points, [n, 6], and by the coefficients, [n, K].
    """
    T_other_one = np.linalg.inv(other.T_world_camera) @ one.T_world_camera
    rotation, translation = T_other_one[:3, :3], T_other_one[:3, 3]
    ray_one, r, (u, v) = _shared(one, other, T_other_one, c)
    moved = ray_one @ rotation.T + r[:, None] * translation  # the point in `other`, times r
    ray, inverse = moved / moved[:, 2:], r / moved[:, 2]
    gradient = other.gradient[v, u]
    by_other = bend_functions(ray[:, :2])
    away = ray[:, :2] - other.camera.rays()[v, u, :2]
    measured = other.inverse[v, u] + (gradient * away).sum(axis=1) + by_other @ c
    error = measured - inverse

    point = ray / inverse[:, None]
    slope = inverse - (gradient * ray[:, :2]).sum(axis=1)
    by_point = np.column_stack([gradient, slope]) * inverse[:, None]
    by_pose = np.column_stack([by_point, np.cross(point, by_point)])
    by_inverse = -((point - translation) * by_point).sum(axis=1) / r
    by_bend = by_other + by_inverse[:, None] * bend_functions(ray_one[:, :2])
    same = np.abs(error) < _SAME_SURFACE
    if same.sum() < _MIN_PIXELS:
        return None
    return error[same] / _NOISE, by_pose[same] / _NOISE, by_bend[same] / _NOISE


def _shared(
    one: RangeImage, other: RangeImage, T_other_one: Pose, c: Matrix
) -> tuple[Matrix, Matrix, NDArray[np.int64]]:
    """Return rays and corrected inverse depth of `one`, and in which pixels (u, v) of `other`."""
    chosen = np.flatnonzero(one.usable)
    chosen = chosen[:: 1 + len(chosen) // _MAX_PIXELS]
    rays = one.camera.rays().reshape(-1, 3)[chosen].astype(np.float64)
    r = one.inverse.ravel()[chosen] + bend_functions(rays[:, :2]) @ c
    moved = rays @ T_other_one[:3, :3].T + r[:, None] * T_other_one[:3, 3]
    seen = (r > _LEAST_INVERSE) & (moved[:, 2] > _LEAST_M)
    rays, r, moved = rays[seen], r[seen], moved[seen]
    at = np.rint(other.camera.project(moved)).astype(np.int64)
    height, width = other.camera.shape
    inside: Mask = np.asarray(((at >= 0) & (at < [width, height])).all(axis=1))
    inside[inside] = other.usable[at[inside, 1], at[inside, 0]]
    return rays[inside], r[inside], at[inside].T
