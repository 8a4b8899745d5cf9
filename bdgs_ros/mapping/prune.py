"""
Which Gaussians are taken out of the map, and why.

Faint, large and needle-shaped ones follow DG-SLAM (opacity, largest scale, axis ratio), whose
ratio would take flat ones too: a needle is long over its *second* axis. Two rules look back over
keyframes: a Gaussian that cameras see without it adding to their images is redundant, and a new
one that later keyframes do not confirm was never there: a rim of something that moved on.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.filter import sigmoid
from bdgs_ros.belief.likelihood import Features
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.config.mapping import PruneConfig
from bdgs_ros.core.types import Pose
from bdgs_ros.mapping.gaussians import GaussianMap

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

_RESOLVED_PX = 0.5  # a Gaussian smaller than this in an image is not judged by it


def worth_keeping(gaussians: GaussianMap, config: PruneConfig) -> Mask:
    """Return which Gaussians are shaped and opaque enough to be of use, [N]."""
    faint = gaussians.logit_opacities < np.log(config.opacity / (1 - config.opacity))
    middle, largest = _two_largest(gaussians.log_scales)
    large = largest > np.log(config.scale)
    needle = largest - middle > np.log(config.axis_ratio)
    return np.asarray(~(faint | large | needle))


def _two_largest(scales: Array) -> tuple[Array, Array]:
    """Return the second and the largest of three per row; ten times as fast as sorting them."""
    x, y, z = scales.T
    more, less = np.maximum(x, y), np.minimum(x, y)
    return np.maximum(less, np.minimum(more, z)), np.maximum(more, z)


def note_contribution(
    gaussians: GaussianMap, agree: Mask, max_weight: Array, resolved: Mask, config: PruneConfig
) -> None:
    """
    Remember how much each Gaussian adds to the images that show its surface.

    `gaussians.contribution` is the largest weight with which it was blended into any pixel, and
    fades with every view in which it is less. Views in which something hides it say nothing.

    Parameters
    ----------
    gaussians : GaussianMap
        Its `contribution` changes.
    agree : ndarray of bool, shape (N,)
        Where the camera measured the Gaussian's depth.
    max_weight : ndarray, shape (N,)
        Of the rendered view.
    resolved : ndarray of bool, shape (N,)
        Where the view is close enough to judge: `resolved_by`.
    config : PruneConfig
        How fast it fades.

    """
    judged = agree & resolved & gaussians.visible_mask()
    faded = np.maximum(max_weight, np.float32(config.fading) * gaussians.contribution)
    gaussians.contribution = np.where(judged, faded, gaussians.contribution).astype(np.float32)


def resolved_by(gaussians: GaussianMap, T_camera_world: Pose, camera: PinholeCamera) -> Mask:
    """Return which Gaussians are wide enough in a view for it to see what each adds, [N]."""
    row = T_camera_world[2].astype(np.float32)
    z = np.maximum(gaussians.means @ row[:3] + row[3], np.float32(1e-3))
    width = np.exp(_two_largest(gaussians.log_scales)[0])
    return np.asarray(camera.fx * width / z > _RESOLVED_PX)


def redundant(gaussians: GaussianMap, config: PruneConfig) -> Mask:
    """Return the Gaussians that add next to nothing to any recent view of their surface, [N]."""
    return np.asarray(gaussians.contribution < config.contribution)


def note_checks(gaussians: GaussianMap, features: Features) -> None:
    """Count the keyframes that could see each Gaussian, and those that saw something there."""
    agree = features.agrees & (features.column('prior') <= 0.5)
    gaussians.checks += features.visible
    gaussians.confirmations += agree


def unconfirmed(gaussians: GaussianMap, newest_index: int, config: PruneConfig) -> Mask:
    """
    Return the new Gaussians that keyframes since then did not see, [N].

    Parameters
    ----------
    gaussians : GaussianMap
        Their `checks` and `confirmations` are compared.
    newest_index : int
        Of the newest keyframe that has checked them.
    config : PruneConfig
        How long a Gaussian is new, and how often it must be seen.

    """
    young = newest_index - gaussians.keyframe_index <= config.trial
    enough = gaussians.checks >= config.trial_checks
    seldom = gaussians.confirmations < config.trial_share * gaussians.checks
    return np.asarray(young & enough & seldom)


def confirmed_gone(gaussians: GaussianMap, config: BeliefConfig) -> Mask:
    """
    Return the Gaussians that may be deleted: believed dynamic, and free space where they were.

    Deletion is delayed on purpose: a Gaussian that is only believed to be dynamic stays frozen
    and unrendered, so that it can come back. Free space must be confirmed by keyframes in a row,
    as nvblox asks for a time.
    """
    sure = gaussians.belief.smoothed > config.delete_above
    return np.asarray(sure & (gaussians.violations >= config.delete_after))


def usefulness(gaussians: GaussianMap) -> Array:
    """Return opacity times contribution, [N]: by this the map is ranked when it is too large."""
    opacity = sigmoid(gaussians.logit_opacities)
    return np.asarray(opacity * np.maximum(gaussians.contribution, 1e-3), np.float32)


def least_useful(gaussians: GaussianMap, count: int) -> Mask:
    """Return the `count` Gaussians of least use, none if `count` is negative, [N]."""
    found = np.zeros(len(gaussians), bool)
    if count > 0:
        rank = usefulness(gaussians)
        found[np.argpartition(rank, min(count, len(rank)) - 1)[:count]] = True
    return found
