"""
Whether a pose can be believed: by how well both images together determine it.

A frame that is aligned to the wrong place still agrees with much of it: walls are walls. But what
is written on them does not: the gradients of the two images have nothing in common there, and the
covariance that only counts what both show (`align_numpy.Mixture`) is wide open. It is so, too,
where there is nothing to see. `LossConfig` says on what the limits were calibrated.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.config.tracking import LossConfig
from bdgs_ros.core.images import thinned
from bdgs_ros.core.types import DepthImage, ProbabilityImage
from bdgs_ros.tracking.align import AlignResult
from bdgs_ros.tracking.starts import Estimate


@dataclass(frozen=True)
class Evidence:
    """What an alignment says about itself."""

    inlier_ratio: float
    texture: float
    """Correlation of the gradients of grey of the two images."""
    coverage: float
    depth_m: float
    """Of the view, median."""
    sigma_m: float
    """Standard deviation of the position along its weakest axis, from the images alone."""
    sigma_rad: float
    """And of the direction."""

    @property
    def sigma_share(self) -> float:
        """The standard deviation of the position over the depth: how far the view may shift."""
        return self.sigma_m / max(self.depth_m, 1e-6)


class LossTest:
    """
    Judges alignments.

    Parameters
    ----------
    config : LossConfig
        The limits.

    """

    def __init__(self, config: LossConfig) -> None:
        self._config = config

    def evidence(self, quality: AlignResult) -> Evidence:
        """Return what the test looks at."""
        return Evidence(
            quality.inlier_ratio,
            quality.texture,
            quality.coverage,
            quality.depth_m,
            _widest(quality.covariance[:3, :3]),
            _widest(quality.covariance[3:, 3:]),
        )

    def objection(self, quality: AlignResult) -> str:
        """Say in words why a pose is not to be believed; nothing where it is."""
        found, limits = self.evidence(quality), self._config
        if found.inlier_ratio < limits.inlier_ratio:
            return f'{100 * found.inlier_ratio:.0f} % inliers'
        if found.sigma_share > limits.sigma_share:
            return (
                f'the images leave the position open to {found.sigma_m:.2f} m at a depth of '
                f'{found.depth_m:.1f} m'
            )
        if found.sigma_rad > limits.sigma_rad:
            return f'the images leave the direction open to {np.rad2deg(found.sigma_rad):.0f} deg'
        return ''

    def contradiction(self, coarse: Estimate, fine: Estimate) -> str:
        """
        Say how far keyframe and map put the camera apart, where neither of them fits.

        Parameters
        ----------
        coarse, fine : Estimate
            Aligned to the keyframe and to the map; one and the same where there is no map.

        """
        best = max(coarse.quality.inlier_ratio, fine.quality.inlier_ratio)
        if coarse is fine or best >= self._config.fits:
            return ''
        T_coarse_fine = se3.inverse(coarse.T_world_camera) @ fine.T_world_camera
        way_m = float(np.linalg.norm(T_coarse_fine[:3, 3]))
        turn = se3.rotation_angle_rad(T_coarse_fine)
        if way_m / fine.quality.depth_m + turn <= self._config.apart:
            return ''
        return (
            f'keyframe and map put it {100 * way_m:.0f} cm and {np.rad2deg(turn):.1f} deg apart, '
            f'with {100 * coarse.quality.inlier_ratio:.0f} and '
            f'{100 * fine.quality.inlier_ratio:.0f} % inliers'
        )

    def can_be_aligned_to(self, depth_m: DepthImage, p_dynamic: ProbabilityImage) -> bool:
        """
        Tell whether later frames could pass the test of coverage against this one.

        A frame without depth may well be aligned by its colour, but nothing can be aligned to
        it: it is no keyframe, and a map would get nothing from it.

        Parameters
        ----------
        depth_m : ndarray, shape (H, W), float32
            Metres; 0 or NaN where invalid.
        p_dynamic : ndarray, shape (H, W), uint8
            P(dynamic) x 255.

        """
        known, still = thinned(depth_m) > 0, thinned(p_dynamic) < 128
        return bool((known & still).mean() >= self._config.coverage)


def _widest(covariance: NDArray[np.float64]) -> float:
    return float(np.sqrt(max(np.linalg.eigvalsh(covariance)[-1], 0.0)))
