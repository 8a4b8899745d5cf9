"""
Whether a pose can be believed: the calibrated test for loss.

A frame that is aligned to the wrong place still agrees with much of it: walls are walls. What
tells is that it agrees clearly less than the frames before it did, whatever the sensor, the map
and the people make usual. The limits of `LossConfig` say on what they were calibrated.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass

import numpy as np

from bdgs_ros.core.config.tracking import LossConfig
from bdgs_ros.core.types import DepthImage, ProbabilityImage
from bdgs_ros.tracking.align import AlignResult

_MEMORY = 20  # frames that say what is usual
_FAST_RAD_S, _BLUR = 1.5, 0.25  # a turn that blurs, and how much less then agrees
_LEAST_MEMORY = 3
_STRIDE = 4  # pixels; a share needs no more
_USUAL = 0.8  # inlier ratio, where no frame was tracked yet


@dataclass(frozen=True)
class Evidence:
    """What an alignment says about itself."""

    inlier_ratio: float
    relative_ratio: float
    """Over what is usual."""
    coverage: float
    gain: float
    sigma_m: float
    """Standard deviation of the position along its weakest axis, from the images alone."""


class LossTest:
    """
    Judges alignments by limits and by what was usual in the last frames.

    Parameters
    ----------
    config : LossConfig
        The limits.

    """

    def __init__(self, config: LossConfig) -> None:
        self._config = config
        self._ratios: deque[float] = deque(maxlen=_MEMORY)
        self._usual = _USUAL
        self.turn_rad_s = 0.0
        """How fast the camera turns, as far as is known before a frame is aligned."""

    def reset(self) -> None:
        """Forget what was usual."""
        self._ratios.clear()
        self._usual = _USUAL

    def accept(self, quality: AlignResult) -> None:
        """Take an alignment that is believed as an example of what is usual."""
        self._ratios.append(quality.inlier_ratio)
        if len(self._ratios) >= _LEAST_MEMORY:
            self._usual = float(np.median(self._ratios))

    def evidence(self, quality: AlignResult) -> Evidence:
        """Return what the test looks at."""
        variance = float(np.linalg.eigvalsh(quality.covariance[:3, :3])[-1])
        return Evidence(
            quality.inlier_ratio,
            quality.inlier_ratio / max(self._usual, 1e-6),
            quality.coverage,
            quality.gain,
            float(np.sqrt(max(variance, 0.0))),
        )

    def objection(self, quality: AlignResult) -> str:
        """Say in words why a pose is not to be believed; nothing where it is."""
        found = self.evidence(quality)
        return self._too_little(found) or self._fall(found) or self._too_open(found)

    def is_doubtful(self, quality: AlignResult) -> bool:
        """Tell whether nothing speaks against a pose but that the images usually agree better."""
        found = self.evidence(quality)
        return not (self._too_little(found) or self._too_open(found))

    def _too_little(self, found: Evidence) -> str:
        limits = self._config
        # A covered lens agrees with everything at gain 0.
        if not 1 / limits.gain < found.gain < limits.gain:
            return f'exposure gain {found.gain:.2f}'
        if found.coverage < limits.coverage:
            return f'only {100 * found.coverage:.1f} % of the image could be compared'
        if found.inlier_ratio < limits.inlier_ratio:
            return f'{100 * found.inlier_ratio:.0f} % inliers'
        return ''

    def _fall(self, found: Evidence) -> str:
        """Images that the camera's own turn blurs agree less, and are not wrong for it."""
        turning = min(self.turn_rad_s / _FAST_RAD_S, 1.0)
        least = self._config.relative_ratio * (1 - _BLUR * turning)
        if self._ratios and found.relative_ratio < least:
            return f'inliers fell from {100 * self._usual:.0f} to {100 * found.inlier_ratio:.0f} %'
        return ''

    def _too_open(self, found: Evidence) -> str:
        if found.sigma_m > self._config.sigma_m:
            return f'the images leave the position open to {found.sigma_m:.2f} m'
        return ''

    def is_sure(self, quality: AlignResult) -> bool:
        """Tell whether one such frame is enough to be found after a loss."""
        return self.evidence(quality).relative_ratio >= self._config.sure_ratio

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
        known = depth_m[::_STRIDE, ::_STRIDE] > 0
        still = p_dynamic[::_STRIDE, ::_STRIDE] < 128
        return bool((known & still).mean() >= self._config.coverage)
