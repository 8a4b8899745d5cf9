"""
What one keyframe says about each Gaussian: the features f_t and the logistic model of Eq. 3.

The paper lists position among the features; it is left out, because a model that knows places
memorises them. A Gaussian that something nearer hides gets no evidence.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.belief import LikelihoodConfig
from bdgs_ros.core.types import DepthImage, Pose, ProbabilityImage

Array = NDArray[np.float32]

FEATURES = ('prior', 'free_space', 'agreement', 'color', 'bias')


@dataclass(frozen=True)
class Observation:
    """One keyframe as the likelihood sees it, at any one resolution."""

    T_camera_world: Pose
    camera: PinholeCamera
    color: Array
    """[H, W, 3] in [0, 1]"""
    depth_m: DepthImage
    p_dynamic: ProbabilityImage


@dataclass(frozen=True)
class Features:
    """Feature vectors of all Gaussians, and which of them were seen."""

    values: Array
    """[N, len(FEATURES)]; zero where not visible"""
    visible: NDArray[np.bool_]
    """[N]"""


def extract(
    means: Array, colors: Array, observation: Observation, config: LikelihoodConfig
) -> Features:
    """
    Compute f_t of Eq. 3 for every Gaussian.

    Parameters
    ----------
    means : ndarray, shape (N, 3)
        Centres in world, metres.
    colors : ndarray, shape (N, 3)
        RGB in [0, 1].
    observation : Observation
        The keyframe.
    config : LikelihoodConfig
        Noise and gates.

    Returns
    -------
    features : Features
        `prior`: P(dynamic) of the labels at the projection, where depth agrees; silence of the
        detector is no evidence, since it does not know every mover;
        `free_space`: how far, in sigma_z beyond the gate, the camera saw through the Gaussian,
        saturated at 1; `agreement`: 1 where the measured depth is that of the Gaussian;
        `color`: absolute colour difference where depth agrees; `bias`: 1.

    """
    pixel, z, inside = _project(means, observation)
    values = np.zeros((len(means), len(FEATURES)), np.float32)
    row, column = pixel[inside, 1], pixel[inside, 0]
    measured = observation.depth_m[row, column]
    sigma = config.depth_noise * z[inside] ** 2 + config.depth_floor
    residual = np.where(measured > 0, (measured - z[inside]) / sigma, -np.inf)
    seen = residual > -config.gate_sigma
    agree = seen & (residual < config.gate_sigma)
    violation = np.clip((residual - config.gate_sigma) / config.gate_sigma, 0, 1)
    prior = observation.p_dynamic[row, column].astype(np.float32) / 255
    difference = np.abs(observation.color[row, column] - colors[inside]).mean(axis=1)
    block = np.stack(
        [
            np.where(agree, prior, 0),
            violation,
            agree,
            np.where(agree, difference, 0),
            np.ones_like(prior),
        ],
        axis=1,
    )
    index = np.flatnonzero(inside)
    values[index] = np.where(seen[:, None], block, 0)
    visible = np.zeros(len(means), bool)
    visible[index] = seen
    return Features(values, visible)


def _project(
    means: Array, observation: Observation
) -> tuple[NDArray[np.int64], Array, NDArray[np.bool_]]:
    """Return nearest pixel (u, v), camera z and whether the pixel lies inside the image."""
    T = observation.T_camera_world.astype(np.float32)
    points = means @ T[:3, :3].T + T[:3, 3]
    z = points[:, 2]
    front = z > 0.05
    safe = np.where(front, z, 1.0)
    camera = observation.camera
    u = np.rint(camera.fx * points[:, 0] / safe + camera.cx)
    v = np.rint(camera.fy * points[:, 1] / safe + camera.cy)
    inside = front & (u >= 0) & (u < camera.width) & (v >= 0) & (v < camera.height)
    pixel = np.where(inside[:, None], np.stack([u, v], axis=1), 0).astype(np.int64)
    return pixel, z, inside


def evidence(features: Features, config: LikelihoodConfig) -> Array:
    """
    Return the log-likelihood ratio w.f + b of Eq. 3, shape (N,); 0 where not visible.

    `p(o | dynamic) = sigmoid(w.f + b)` and `p(o | static) = 1 - p(o | dynamic)`, so their
    log-ratio is the argument of the sigmoid.
    """
    weights = np.array(
        [config.w_prior, config.w_free_space, config.w_agreement, config.w_color, config.bias],
        np.float32,
    )
    return np.asarray(features.values @ weights, dtype=np.float32)


def label(features: Features) -> Array:
    """Return the detector's P(dynamic) at each Gaussian, for runs without the filter."""
    prior = features.values[:, FEATURES.index('prior')]
    return np.where(features.values[:, FEATURES.index('agreement')] > 0, prior, 0.5)
