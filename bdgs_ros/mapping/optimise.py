"""The adaptive optimisation of section 3.4 on the pyramid of section 3.5."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.fusion import State
from bdgs_ros.core.config import MappingConfig
from bdgs_ros.mapping import losses
from bdgs_ros.mapping.densify import PositionalGradient
from bdgs_ros.mapping.gaussians import RASTERISED, GaussianMap
from bdgs_ros.mapping.harmonics import Shading
from bdgs_ros.mapping.keyframes import Level, MapKeyframe, Window
from bdgs_ros.mapping.rasterize import (
    AdamGroup,
    FusedResult,
    Gaussians,
    LossWeights,
    adam_step,
    adam_steps,
    fused_step,
)

Array = NDArray[np.float32]

_POSE_BETAS = (0.9, 0.99)  # a pose is seen in few steps, so the second moment must be fast

Plan = list[tuple[MapKeyframe, int]]


class Optimiser:
    """
    Fit the map to its keyframes: Eq. 7-9 with Adam, coarse to fine by Eq. 12-13.

    Parameters
    ----------
    config : MappingConfig
        Steps and rates.
    hurried : callable
        Whether the next keyframe waits already: then there are `config.hurried` iterations.

    """

    def __init__(self, config: MappingConfig, hurried: Callable[[], bool] = lambda: False) -> None:
        self._config = config
        self._hurried = hurried
        self._weights = LossWeights(
            color=config.loss.psim,
            ssim=config.loss.ssim,
            depth=config.loss.depth,
            smooth=config.loss.smooth,
            empty=config.loss.empty,
        )
        self._rng = np.random.default_rng(config.seed)
        self.pull: PositionalGradient | None = None
        """Where set, the positional gradients of all steps are gathered in it."""
        self._scratch = np.empty((0, 0), np.float32)  # kept: fresh memory is slow
        rate = config.rate
        self._rates = {
            'means': rate.means,
            'quats': rate.quats,
            'log_scales': rate.scales,
            'logit_opacities': rate.opacities,
            'colors': rate.colors,
        }

    def run(
        self, gaussians: GaussianMap, newest: MapKeyframe, others: Sequence[MapKeyframe]
    ) -> list[float]:
        """
        Optimise after a new keyframe.

        Parameters
        ----------
        gaussians : GaussianMap
            Changed in place.
        newest : MapKeyframe
            Every second iteration looks at it.
        others : sequence of MapKeyframe
            The rest of the window and a few older ones; the other iterations take them in turn.

        Returns
        -------
        losses : list of float
            One per iteration, each of its own view.

        """
        visible = gaussians.visible_mask()
        # Gaussians that Eq. 11 hides are frozen, opacity too, so that they can come back.
        penalised = visible & (gaussians.states == State.DYNAMIC)
        coarse, fine = self._plan(newest, others)

        def step(done: int, view: tuple[MapKeyframe, int]) -> float:
            # poses settle: Adam's steps do not get smaller by themselves
            calm = (1 - done / self._config.iterations) ** 2
            return self._step(gaussians, *view, visible, penalised, pose_scale=calm)

        losses: list[float] = []
        for view in self._until_hurried(coarse, 0):
            losses.append(step(len(losses), view))
        seen = [loss for (kf, _), loss in zip(coarse, losses, strict=False) if kf is newest]
        if _gain(seen[len(seen) // 2 :]) < self._config.enough:
            fine = fine[: self._config.min_fine]
        for view in self._until_hurried(fine, len(losses)):
            losses.append(step(len(losses), view))
        return losses

    def _until_hurried(self, plan: Plan, done: int) -> Iterator[tuple[MapKeyframe, int]]:
        """Yield from a plan, and end where enough is done for as long as a keyframe waits."""
        for count, view in enumerate(plan, done):
            if count >= self._config.hurried and self._hurried():
                return
            yield view

    def step(
        self,
        gaussians: GaussianMap,
        keyframe: MapKeyframe,
        level_index: int,
        rate_scale: float = 1.0,
        *,
        move: bool = True,
    ) -> float:
        """
        Take one step of Eq. 7 on one view and return its loss.

        Parameters
        ----------
        gaussians : GaussianMap
            Changed in place.
        keyframe : MapKeyframe
            The view; its exposure and pose are adapted too.
        level_index : int
            Of the keyframe's pyramid, 0 is the finest.
        rate_scale : float
            Factor on every learning rate.
        move : bool
            Whether the keyframe's pose is adapted; else it stays as it was told.

        """
        visible = gaussians.visible_mask()
        penalised = visible & (gaussians.states == State.DYNAMIC)
        pose_scale = rate_scale**2 if move else 0.0
        return self._step(
            gaussians, keyframe, level_index, visible, penalised, rate_scale, pose_scale
        )

    def _plan(self, newest: MapKeyframe, others: Sequence[MapKeyframe]) -> tuple[Plan, Plan]:
        """Return keyframe and pyramid level of each iteration: coarse ones, finest ones."""
        levels = self._levels(len(newest.levels))
        plan = [
            (newest if i % 2 == 0 or not others else others[(i // 2) % len(others)], level)
            for i, level in enumerate(levels)
        ]
        first_fine = levels.index(0) if 0 in levels else len(levels)
        return plan[:first_fine], plan[first_fine:]

    def _levels(self, count: int) -> list[int]:
        """Return the level of each iteration, i = L, ..., 0 as in Eq. 12."""
        coarse = round(self._config.iterations * self._config.pyramid.coarse_share)
        each = coarse // max(count - 1, 1)
        levels = [level for level in range(count - 1, 0, -1) for _ in range(each)]
        return levels + [0] * (self._config.iterations - len(levels))

    def _step(
        self,
        gaussians: GaussianMap,
        keyframe: MapKeyframe,
        level_index: int,
        visible: NDArray[np.bool_],
        penalised: NDArray[np.bool_],
        rate_scale: float = 1.0,
        pose_scale: float = 1.0,
    ) -> float:
        level = self._look(keyframe.levels[level_index])
        active = visible & self._opaque_enough(gaussians.logit_opacities, level_index)
        shading = gaussians.shading(keyframe.T_camera_world, self._config.threads)
        shaded = gaussians.as_gaussians(shading, active)
        result = self._photometric(shaded, keyframe, level, active)
        gradients = dict(zip(RASTERISED, result.gradients.parameters(), strict=True))
        if self.pull is not None:
            seen, pose = result.visibility > 0, keyframe.T_camera_world
            self.pull.note(gaussians.means, gradients['means'], seen, pose, level.camera)
        regulariser = self._add_direct_terms(gaussians, gradients, level, penalised)
        self._adam(gaussians, gradients, (result.visibility > 0) | penalised, rate_scale)
        if shading is not None:
            seen = result.visibility > 0
            self._adapt_shading(gaussians, shading, gradients['colors'], seen, rate_scale)
        self._adapt_exposure(keyframe, result.exposure_gradient, rate_scale)
        self._adapt_pose(keyframe, result.gradients.pose, pose_scale)
        return result.loss + regulariser

    def _look(self, level: Level) -> Level:
        """Choose the window of a large image that this step sees; small ones it sees whole."""
        height, width = level.camera.shape
        share = np.sqrt(self._config.step_pixels / (height * width))
        if share >= 1:
            return level
        rows, columns = (self._stretch(length, share) for length in (height, width))
        return level.cut(Window(rows, columns))

    def _stretch(self, length: int, share: float) -> slice:
        """Return a random stretch; its ends reach beyond the image, so that rims are seen too."""
        wanted = round(length * share)
        anywhere = self._rng.integers(-wanted // 2, length - wanted // 2)
        start = int(np.clip(anywhere, 0, length - wanted))
        return slice(start, start + wanted)

    def _opaque_enough(self, logit_opacities: Array, level_index: int) -> NDArray[np.bool_]:
        """Eq. 13: alpha_g counts only above tau_i, which grows towards the coarse levels."""
        threshold = self._config.pyramid.opacity_threshold * 2**level_index
        if threshold == 0:
            return np.ones(len(logit_opacities), bool)
        return np.asarray(logit_opacities > np.log(threshold / (1 - threshold)))

    def _photometric(
        self,
        gaussians: Gaussians,
        keyframe: MapKeyframe,
        level: Level,
        active: NDArray[np.bool_],
    ) -> FusedResult:
        """Lambda_psim times Eq. 9 plus the depth term, on pixels where nothing moves."""
        return fused_step(
            gaussians,
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

    def _add_direct_terms(
        self,
        gaussians: GaussianMap,
        gradients: dict[str, Array],
        level: Level,
        penalised: NDArray[np.bool_],
    ) -> float:
        """Add the last two terms of Eq. 7; per pixel like the first, so that they compare."""
        per_pixel = np.float32(1 / level.weight.size)
        weights = self._config.loss
        dynamic, gradient = losses.dynamic_penalty(
            gaussians.logit_opacities, penalised, gaussians.p_dynamic
        )
        gradients['logit_opacities'] += np.float32(weights.dynamic) * per_pixel * gradient
        large, gradient = losses.covariance_penalty(gaussians.log_scales)
        gradients['log_scales'] += np.float32(weights.reg) * per_pixel * gradient
        return float(per_pixel) * (weights.dynamic * dynamic + weights.reg * large)

    def _adam(
        self,
        gaussians: GaussianMap,
        gradients: dict[str, Array],
        touched: NDArray[np.bool_],
        rate_scale: float,
    ) -> None:
        groups = []
        for name in RASTERISED:
            first, second = gaussians.moments[name]
            rate = rate_scale * self._rates[name]
            groups.append(
                AdamGroup(gaussians.parameters[name], gradients[name], first, second, rate)
            )
        adam_steps(groups, rows=touched, threads=self._config.threads)

    def _adapt_shading(
        self,
        gaussians: GaussianMap,
        shading: Shading,
        by_color: Array,
        seen: NDArray[np.bool_],
        rate_scale: float,
    ) -> None:
        """Fit what depends on the direction; only where it is seen, the rest stays as it is."""
        if self._scratch.shape != gaussians.harmonics.shape:
            self._scratch = np.empty_like(gaussians.harmonics)
        shading.gradient(by_color, seen, self._scratch)
        adam_step(
            gaussians.harmonics,
            self._scratch,
            *gaussians.moments['harmonics'],
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
        adam_step(xi, gradient.astype(np.float32), first, second, rate=rate, betas=_POSE_BETAS)
        keyframe.move(xi)


def _gain(losses: Sequence[float]) -> float:
    """Return the share by which a loss fell; infinite where too little is known."""
    return 1 - losses[-1] / losses[0] if len(losses) > 1 and losses[0] > 0 else float('inf')
