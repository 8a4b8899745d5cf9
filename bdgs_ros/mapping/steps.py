"""One step of Eq. 7 on one view, where the map's parameters are numpy's."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.fusion import State
from bdgs_ros.core.config import MappingConfig
from bdgs_ros.mapping import losses
from bdgs_ros.mapping.densify import PositionalGradient, Pull
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.harmonics import Shading
from bdgs_ros.mapping.keyframes import Level, MapKeyframe, Window
from bdgs_ros.mapping.parameters import RASTERISED, HostParameters
from bdgs_ros.mapping.rasterize import (
    AdamGroup,
    FusedResult,
    LossWeights,
    adam_step,
    adam_steps,
    fused_step,
    map_device,
)

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

POSE_BETAS = (0.9, 0.99)  # a pose is seen in few steps, so the second moment must be fast


class Steps(Protocol):
    """
    Steps of Eq. 7 on some keyframes, one view after the other.

    `begin`, then `take` as often as wanted, then `end`; between `begin` and `end` nothing else
    reads or changes the map or the keyframes.
    """

    def begin(self, gaussians: GaussianMap, keyframes: Sequence[MapKeyframe]) -> None:
        """Take a map and the keyframes that it will be fitted to."""

    def take(
        self,
        keyframe: MapKeyframe,
        level_index: int,
        window: Window | None,
        *,
        rate_scale: float = 1.0,
        pose_scale: float = 1.0,
    ) -> None:
        """Take a step on (a window of) one level of a keyframe's pyramid, 0 the finest."""

    def losses(self) -> list[float]:
        """Return what the steps since `begin` had as loss, each of its own view."""

    def end(self) -> None:
        """Bring the poses and exposures of the keyframes up to date."""

    def gather(self, count: int | None) -> Pull | None:
        """Gather from now on how `count` Gaussians are pulled, or with None no longer."""


def open_steps(config: MappingConfig) -> Steps:
    """Return the steps of the backend that `config` chooses."""
    device = map_device(config.backend)
    if device is None:
        return HostSteps(config)
    from bdgs_ros.mapping.cuda.steps import CudaSteps

    return CudaSteps(config, device)


def loss_weights(config: MappingConfig) -> LossWeights:
    """Return the weights of the image terms."""
    loss = config.loss
    return LossWeights(loss.psim, loss.ssim, loss.depth, loss.smooth, loss.empty)


def learning_rates(config: MappingConfig) -> dict[str, float]:
    """Return Adam's step sizes by the names in `RASTERISED`."""
    rate = config.rate
    sizes = rate.means, rate.quats, rate.scales, rate.opacities, rate.colors
    return dict(zip(RASTERISED, sizes, strict=True))


def least_logit(config: MappingConfig, level_index: int) -> float:
    """Eq. 13: alpha_g counts only above tau_i, which grows towards the coarse levels."""
    threshold = config.pyramid.opacity_threshold * 2**level_index
    return float(np.log(threshold / (1 - threshold))) if threshold > 0 else -np.inf


def penalised_by(gaussians: GaussianMap) -> tuple[Mask, Mask]:
    """
    Return which Gaussians are visible, and of them the members of G_D in Eq. 7, [N] each.

    Gaussians that Eq. 11 hides are frozen, opacity too, so that they can come back.
    """
    visible = gaussians.visible_mask()
    return visible, visible & (gaussians.states == State.DYNAMIC)


class HostSteps:
    """
    Steps by the native kernels or the torch twin.

    Parameters
    ----------
    config : MappingConfig
        Weights and rates.

    """

    def __init__(self, config: MappingConfig) -> None:
        self._config = config
        self._weights = loss_weights(config)
        self._rates = learning_rates(config)
        self._pull: PositionalGradient | None = None
        self._scratch = np.empty((0, 0), np.float32)  # kept: fresh memory is slow
        self._losses: list[float] = []

    def begin(self, gaussians: GaussianMap, keyframes: Sequence[MapKeyframe]) -> None:
        """Take a map."""
        assert isinstance(gaussians.parameters, HostParameters)
        self._map, self._parameters = gaussians, gaussians.parameters
        self._visible, self._penalised = penalised_by(gaussians)
        self._losses = []

    def losses(self) -> list[float]:
        """Return the losses since `begin`."""
        return self._losses

    def end(self) -> None:
        """Do nothing: keyframes are changed at once."""

    def gather(self, count: int | None) -> Pull | None:
        """Gather how Gaussians are pulled."""
        self._pull = None if count is None else PositionalGradient(count)
        return self._pull

    def take(
        self,
        keyframe: MapKeyframe,
        level_index: int,
        window: Window | None,
        *,
        rate_scale: float = 1.0,
        pose_scale: float = 1.0,
    ) -> None:
        """Take a step."""
        whole = keyframe.levels[level_index]
        level = whole if window is None else whole.cut(window)
        gaussians = self._map
        opaque = gaussians.logit_opacities > least_logit(self._config, level_index)
        active = self._visible & opaque
        shading = self._parameters.shading(keyframe.T_camera_world, self._config.threads)
        result = self._photometric(shading, keyframe, level, active)
        gradients = dict(zip(RASTERISED, result.gradients.parameters(), strict=True))
        seen = result.visibility > 0
        if self._pull is not None:
            pose = keyframe.T_camera_world
            self._pull.note(gaussians.means, gradients['means'], seen, pose, level.camera)
        regulariser = self._add_direct_terms(gradients, level)
        self._adam(gradients, seen | self._penalised, rate_scale)
        if shading is not None:
            self._adapt_shading(shading, gradients['colors'], seen, rate_scale)
        self._adapt_exposure(keyframe, result.exposure_gradient, rate_scale)
        self._adapt_pose(keyframe, result.gradients.pose, pose_scale)
        self._losses.append(result.loss + regulariser)

    def _photometric(
        self, shading: Shading | None, keyframe: MapKeyframe, level: Level, active: Mask
    ) -> FusedResult:
        """Lambda_psim times Eq. 9 plus the depth term, on pixels where nothing moves."""
        return fused_step(
            self._map.as_gaussians(shading, active),
            keyframe.T_camera_world,
            level.camera,
            level.color,
            level.depth_m,
            level.weight,
            self._weights,
            exposure=(float(keyframe.exposure[0]), float(keyframe.exposure[1])),
            active=active,
            threads=self._config.threads,
            backend=self._config.backend,
        )

    def _add_direct_terms(self, gradients: dict[str, Array], level: Level) -> float:
        """Add the last two terms of Eq. 7; per pixel like the first, so that they compare."""
        gaussians, weights = self._map, self._config.loss
        per_pixel = np.float32(1 / level.weight.size)
        dynamic, gradient = losses.dynamic_penalty(
            gaussians.logit_opacities, self._penalised, gaussians.p_dynamic
        )
        gradients['logit_opacities'] += np.float32(weights.dynamic) * per_pixel * gradient
        large, gradient = losses.covariance_penalty(gaussians.log_scales)
        gradients['log_scales'] += np.float32(weights.reg) * per_pixel * gradient
        return float(per_pixel) * (weights.dynamic * dynamic + weights.reg * large)

    def _adam(self, gradients: dict[str, Array], touched: Mask, rate_scale: float) -> None:
        groups = []
        for name in RASTERISED:
            first, second = self._parameters.moments[name]
            rate = rate_scale * self._rates[name]
            values = self._parameters[name]
            groups.append(AdamGroup(values, gradients[name], first, second, rate))
        adam_steps(groups, rows=touched, threads=self._config.threads)

    def _adapt_shading(
        self, shading: Shading, by_color: Array, seen: Mask, rate_scale: float
    ) -> None:
        """Fit what depends on the direction; only where it is seen, the rest stays as it is."""
        harmonics = self._parameters['harmonics']
        if self._scratch.shape != harmonics.shape:
            self._scratch = np.empty_like(harmonics)
        shading.gradient(by_color, seen, self._scratch)
        adam_step(
            harmonics,
            self._scratch,
            *self._parameters.moments['harmonics'],
            rate=rate_scale * self._config.rate.harmonics,
            rows=seen,
            threads=self._config.threads,
        )

    def _adapt_exposure(self, keyframe: MapKeyframe, gradient: Array, rate_scale: float) -> None:
        """Fit gain and offset of a keyframe; the first keyframe defines the map's exposure."""
        if keyframe.index == 0:
            return
        moments = keyframe.exposure_moments
        rate = rate_scale * self._config.rate.exposure
        adam_step(keyframe.exposure, gradient, *moments, rate=rate)

    def _adapt_pose(
        self, keyframe: MapKeyframe, gradient: NDArray[np.float64], scale: float
    ) -> None:
        """Let a keyframe's pose follow the map; the first keyframe defines the world."""
        if keyframe.index == 0:
            return
        xi = np.zeros(6, np.float32)
        rate = scale * self._config.rate.pose
        first, second = keyframe.pose_moments
        adam_step(xi, gradient.astype(np.float32), first, second, rate=rate, betas=POSE_BETAS)
        keyframe.move(xi)
