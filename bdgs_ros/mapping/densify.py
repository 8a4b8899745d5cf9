"""
More Gaussians where the images pull those that are there about, after 3DGS (Kerbl et al., 2023).

A Gaussian that is wanted in several places at once has a large gradient by its position in every
image. It is divided in two along its longest axis: 3DGS tells small ones, which it copies, from
large ones, which it splits; halves of the same total width do both, and change the image least.
"""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import Pose
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.rotations import axes_from_quats

Array = NDArray[np.float32]

_APART = 0.6  # of the longest standard deviation, to either side
_NARROWER = 0.8  # sqrt(1 - 0.6^2): two halves have the variance of the whole


class Pull(Protocol):
    """How strongly each Gaussian is pulled, as steps gather it."""

    def strongest(self, count: int) -> NDArray[np.int64]:
        """Return the `count` Gaussians that were pulled most, fewer if fewer were seen."""


class PositionalGradient:
    """How strongly each Gaussian was pulled over the image, on average over the views of it."""

    def __init__(self, count: int) -> None:
        self._sum = np.zeros(count, np.float32)
        self._views = np.zeros(count, np.int32)

    def note(
        self, means: Array, by_mean: Array, seen: NDArray[np.bool_], T: Pose, camera: PinholeCamera
    ) -> None:
        """
        Take the gradient of one view.

        Parameters
        ----------
        means, by_mean : ndarray, shape (N, 3)
            Centres in world, and the derivative of the loss by them, 1/m.
        seen : ndarray of bool, shape (N,)
            Which of them the view shows.
        T : ndarray, shape (4, 4)
            T_camera_world of the view.
        camera : PinholeCamera
            Of the view.

        """
        row = T[2].astype(np.float32)
        metres_per_px = np.abs(means @ row[:3] + row[3]) / np.float32(camera.fx)
        pull = np.linalg.norm(by_mean, axis=1) * metres_per_px
        self._sum += np.where(seen, pull, 0).astype(np.float32)
        self._views += seen

    def strongest(self, count: int) -> NDArray[np.int64]:
        """Return the `count` Gaussians that were pulled most, fewer if fewer were seen."""
        return strongest((self._sum / np.maximum(self._views, 1)).astype(np.float32), count)


def strongest(mean: Array, count: int) -> NDArray[np.int64]:
    """Return the `count` largest of some values that are above 0, largest first."""
    count = min(count, int((mean > 0).sum()))
    return np.argsort(-mean, kind='stable')[:count]


def divide(gaussians: GaussianMap, rows: NDArray[np.int64]) -> None:
    """Divide Gaussians in two along their longest axes; everything else both halves inherit."""
    scales = gaussians.log_scales.copy()
    axis = scales[rows].argmax(axis=1)
    longest = np.exp(scales[rows, axis])
    direction = axes_from_quats(gaussians.quats[rows])[np.arange(len(rows)), :, axis]
    step = (np.float32(_APART) * longest)[:, None] * direction
    scales[rows, axis] += np.float32(np.log(_NARROWER))
    gaussians.parameters['log_scales'] = scales
    first_copy = len(gaussians)
    gaussians.copy(rows)
    means = gaussians.means.copy()
    means[rows] += step
    means[first_copy:] -= step
    gaussians.parameters['means'] = means
