"""
What one keyframe says about each Gaussian: the features f_t and the logistic model of Eq. 3.

The paper lists position among the features; it is left out, because a model that knows places
memorises them. A Gaussian that something nearer hides gets no evidence.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import cached_property
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.surfaces import Index, find_surfaces, mean_by_group
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.belief import LikelihoodConfig
from bdgs_ros.core.types import DYNAMIC_THRESHOLD, DepthImage, Pose, ProbabilityImage

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

FEATURES = (
    'prior',
    'object',
    'edge',
    'residual',
    'color',
    'warp',
    'departed',
    'free_space',
    'visibility',
    'streak',
    'age',
    'observations',
    'agreement',
    'bias',
)

_KERNEL = np.ones((3, 3), np.uint8)
_EDGE_PX = 4.0  # beyond a mask, in which its rim fades, at the width of the keyframe
_SAME_SURFACE_SIGMA = 15.0  # beyond, it is another surface
_MEDIAN_OF_NORMAL = 0.6745  # of absolute values, in sigma
_ENOUGH = 100  # Gaussians for a median
_COLOR_FLOOR = 0.01  # of the median difference: noise of a still image
_MOST_COLOR = 5.0  # medians
_LONG_STREAK, _LONG_AGE, _MANY = 5, 50, 30  # keyframes at which a feature saturates


@dataclass(frozen=True)
class Observation:
    """One keyframe as the likelihood sees it, at any one resolution."""

    stamp_ns: int
    T_world_camera: Pose
    camera: PinholeCamera
    color: Array
    """[H, W, 3] in [0, 1]"""
    depth_m: DepthImage
    p_dynamic: ProbabilityImage

    @cached_property
    def surfaces(self) -> Index:
        """What moves together: number of the depth-connected surface, 0 for none, [H, W]."""
        return find_surfaces(self.depth_m)

    @cached_property
    def p_object(self) -> Array:
        """Mean P(dynamic) of the labels over each surface; the label itself off them, [H, W]."""
        label = self.p_dynamic.ravel().astype(np.float32) / np.float32(255)
        mean = mean_by_group(label, self.surfaces.ravel())
        own = np.where(self.surfaces.ravel() > 0, mean, label)
        return own.reshape(self.p_dynamic.shape).astype(np.float32)


@dataclass(frozen=True)
class Points:
    """What is known of N Gaussians before a keyframe; each is of shape [N] or [N, 3]."""

    means: Array
    """Metres in world."""
    colors: Array
    """RGB in [0, 1]."""
    visibility: Array
    """alpha T: the largest weight with which it was blended into a recent image."""
    streak: NDArray[np.int32]
    """Keyframes in a row that measured it where it is."""
    age: NDArray[np.int32]
    """Keyframes since it came."""
    observations: NDArray[np.int32]
    """Keyframes that saw it."""
    seen_through: Array
    """Share of the remembered keyframes which looked through it."""
    surface: Index
    """On which surface it was last seen; 0 before."""

    def take(self, rows: NDArray[np.int64]) -> Points:
        """Return some of them."""
        return Points(*(getattr(self, field.name)[rows] for field in fields(self)))


@dataclass(frozen=True)
class Features:
    """Feature vectors of all Gaussians, and which of them were seen."""

    values: Array
    """[N, len(FEATURES)]; zero where not visible"""
    visible: Mask
    """[N]"""
    surface: Index
    """[N] number of the surface that it was seen on, 0 for none"""

    def column(self, name: str) -> Array:
        """Return one feature of all Gaussians, [N]."""
        return self.values[:, FEATURES.index(name)]

    @property
    def agrees(self) -> Mask:
        """Where the camera measured the Gaussian where it is, [N]."""
        return np.asarray(self.column('agreement') > 0)

    @property
    def seen_through(self) -> Mask:
        """Where the camera looked through the Gaussian, [N]."""
        return np.asarray(self.column('free_space') > 0)


def extract(points: Points, observation: Observation, config: LikelihoodConfig) -> Features:
    """
    Compute f_t of Eq. 3 for every Gaussian.

    A Gaussian is seen where the measured depth agrees with it, within `gate_sigma` (of the noise,
    or of what the keyframe as a whole is off, if that is more), or where
    every depth around its pixel lies beyond it: at the rim of something nearer an error of a
    pixel must not pass for free space.

    Parameters
    ----------
    points : Points
        All Gaussians.
    observation : Observation
        The keyframe.
    config : LikelihoodConfig
        Noise and gates.

    Returns
    -------
    features : Features
        Where depth agrees: `prior`, P(dynamic) of the labels at the projection (silence of the
        detector is no evidence, since it does not know every mover); `object`, the same over all
        of its surface, so that legs leave with the person; `edge`, nearness of the next labelled
        pixel; `residual`, signed, in gates, positive where the surface is farther;
        `color`, absolute difference over its median, saturated; `warp`, share of the remembered
        keyframes in which this place was free (depth warp of DG-SLAM); `departed`, share of those
        last seen on the same surface that are seen through now, where a thing slides over its
        own place; `visibility`; `streak`;
        `agreement`, 1. Where seen through: `free_space`, how far beyond the gate, in gates,
        saturated. Where either: `age` and `observations`, logarithmic and saturated; `bias`, 1.

    """
    index, row, column, z = _project(points.means, observation)
    depth_m = observation.depth_m
    measured = depth_m[row, column]
    sigma = config.depth_noise * z**2 + config.depth_floor
    static = observation.p_dynamic[row, column] < DYNAMIC_THRESHOLD
    error = (measured - z) / sigma
    inflation = _inflation(error[static & (measured > 0)])
    gate = config.gate_sigma * sigma * inflation
    residual = (measured - z) / gate
    agree = (measured > 0) & (np.abs(residual) < 1)
    # erode takes a hole, which is 0, as the nearest depth: nothing is known there
    violation = np.clip((cv2.erode(depth_m, _KERNEL)[row, column] - z) / gate - 1, 0, 1)
    violation[agree] = 0
    seen = agree | (violation > 0)
    near = points.take(index)
    on_surface: dict[str, Array | np.float32] = {
        'prior': observation.p_dynamic[row, column].astype(np.float32) / np.float32(255),
        'object': observation.p_object[row, column],
        'edge': _rim(observation.p_dynamic)[row, column],
        'residual': residual,
        'color': _color_difference(observation.color[row, column], near.colors, agree),
        'warp': near.seen_through,
        'departed': _departed(near.surface, seen, violation > 0) / inflation,
        'visibility': near.visibility,
        'streak': np.minimum(near.streak.astype(np.float32) / _LONG_STREAK, np.float32(1)),
        'agreement': np.float32(1),
    }
    whenever: dict[str, Array | np.float32] = {
        'free_space': violation / inflation,
        'age': _saturating(near.age, _LONG_AGE),
        'observations': _saturating(near.observations, _MANY),
        'bias': np.float32(1),
    }
    block = np.zeros((len(index), len(FEATURES)), np.float32)
    for name, value in on_surface.items():
        block[:, FEATURES.index(name)] = np.where(agree, value, 0)
    for name, value in whenever.items():
        block[:, FEATURES.index(name)] = np.where(seen, value, 0)
    surface = np.where(agree, observation.surfaces[row, column], 0)
    count = len(points.means)
    return Features(
        _scatter(block, index, count),
        _scatter(seen, index, count),
        _scatter(surface, index, count),
    )


def _scatter(part: NDArray[Any], index: NDArray[np.int64], count: int) -> NDArray[Any]:
    """Return an array for all Gaussians, 0 but for some."""
    whole = np.zeros((count, *part.shape[1:]), part.dtype)
    whole[index] = part
    return whole


def _departed(surface: Index, seen: Mask, through: Mask) -> Array:
    """Return which share of those seen of each one's surface is seen through, [M]."""
    share = np.zeros(len(surface), np.float32)
    known = seen & (surface > 0)
    if through.any():
        share[known] = mean_by_group(through[known].astype(np.float32), surface[known])
    return share


def _inflation(error: Array) -> np.float32:
    """
    Return by how much a keyframe's depth disagrees with the map beyond sigma_z, 1 or more.

    In motion blur, or where the pose is off, everything is a little displaced: that is no free
    space, and what such a keyframe says of free space counts for less. The median is of what is
    near enough to be the same surface, so movers do not count.
    """
    near = np.abs(error[np.abs(error) < _SAME_SURFACE_SIGMA])
    if len(near) < _ENOUGH:
        return np.float32(1)
    return np.float32(max(1.0, float(np.median(near)) / _MEDIAN_OF_NORMAL))


def _rim(p_dynamic: ProbabilityImage) -> Array:
    """Return how near the next labelled pixel is, 1 to 0; 0 on labelled pixels, [H, W]."""
    free = (p_dynamic < DYNAMIC_THRESHOLD).astype(np.uint8)
    if free.all():
        return np.zeros(p_dynamic.shape, np.float32)
    away_px = cv2.distanceTransform(free, cv2.DIST_L2, 3)
    return np.where(free > 0, np.exp(-away_px / _EDGE_PX), 0).astype(np.float32)


def _color_difference(seen: Array, own: Array, agree: Mask) -> Array:
    """Return absolute differences over their median where depth agrees, in [0, 1], [M]."""
    difference = np.abs(seen - own).mean(axis=1)
    median = float(np.median(difference[agree])) if agree.any() else 0.0
    relative = difference / np.float32(_MOST_COLOR * max(median, _COLOR_FLOOR))
    return np.asarray(np.minimum(relative, 1), np.float32)


def _saturating(count: NDArray[np.int32], many: int) -> Array:
    """Return log(1 + count), 1 from `many` on."""
    share = np.log1p(count.astype(np.float32)) / np.float32(np.log1p(many))
    return np.asarray(np.minimum(share, 1), np.float32)


def _project(
    means: Array, observation: Observation
) -> tuple[NDArray[np.int64], NDArray[np.intp], NDArray[np.intp], Array]:
    """Return which centres lie in the image, their nearest row and column, and camera z."""
    camera = observation.camera
    R = observation.T_world_camera[:3, :3].astype(np.float32)
    t = observation.T_world_camera[:3, 3].astype(np.float32)
    x, y, z = ((means - t) @ R).T
    inverse_z = np.float32(1) / np.where(z > 0.05, z, np.float32(np.inf))
    u = np.rint(np.float32(camera.fx) * x * inverse_z + np.float32(camera.cx))
    v = np.rint(np.float32(camera.fy) * y * inverse_z + np.float32(camera.cy))
    inside = (inverse_z > 0) & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    index = np.flatnonzero(inside)
    return index, v[index].astype(np.intp), u[index].astype(np.intp), z[index]


def weights(config: LikelihoodConfig) -> Array:
    """Return w of Eq. 3 in the order of `FEATURES`; b is the weight of `bias`."""
    return np.array([getattr(config, f'w_{name}') for name in FEATURES], np.float32)


def evidence(features: Features, config: LikelihoodConfig) -> Array:
    """
    Return the log-likelihood ratio w.f + b of Eq. 3, shape (N,); 0 where not visible.

    `p(o | dynamic) = sigmoid(w.f + b)` and `p(o | static) = 1 - p(o | dynamic)`, so their
    log-ratio is the argument of the sigmoid.
    """
    return np.asarray(features.values @ weights(config), dtype=np.float32)


def label(features: Features) -> Array:
    """Return the detector's P(dynamic) at each Gaussian, for runs without the filter."""
    return np.where(features.agrees, features.column('prior'), np.float32(0.5))
