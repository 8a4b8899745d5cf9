"""One keyframe after the other into the static Gaussian map, sections 3.2-3.5 of the paper."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief import likelihood
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.core.images import without_specks
from bdgs_ros.core.types import Keyframe, ModelView, Pose, ProbabilityImage
from bdgs_ros.mapping import growth
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.keyframe_store import KeyframeSet
from bdgs_ros.mapping.keyframes import (
    MapKeyframe,
    build_levels,
    is_dynamic,
    most_redundant,
    shrink,
)
from bdgs_ros.mapping.lift import lift
from bdgs_ros.mapping.map_files import load_map, save_map
from bdgs_ros.mapping.optimise import Optimiser
from bdgs_ros.mapping.rasterize import Rendered, render
from bdgs_ros.mapping.surface import fit_surface

Mask = NDArray[np.bool_]

_MIN_BLOB_SHARE = 0.002  # of the image; smaller things in front of the map are noise


class Mapper:
    """The static Gaussian map, grown and optimised keyframe by keyframe."""

    def __init__(self, mapping: MappingConfig, belief: BeliefConfig) -> None:
        self._config = mapping
        self._belief = belief
        self._optimiser = Optimiser(mapping)
        self.frozen = False
        """Localisation mode: keyframes are answered with a view, the map does not change."""
        self.reset()

    def reset(self) -> None:
        """Forget the map."""
        self.map = GaussianMap(self._belief)
        self.keyframes: list[MapKeyframe] = []
        self.keyframe_stamps_ns: list[int] = []  # of all that ever were, for the scores
        self._count = 0
        self._rng = np.random.default_rng(self._config.seed)

    def process(self, keyframe: Keyframe) -> ModelView | None:
        """
        Take a keyframe into the map.

        Parameters
        ----------
        keyframe : Keyframe
            Frame, pose and dynamic prior.

        Returns
        -------
        view : ModelView or None
            The static map at the keyframe's pose; None with `mapping.enabled` off.

        """
        if not self._config.enabled:
            return None
        small = shrink(keyframe, self._config.width)
        if not self.frozen:
            self._infer(small)
            static = self.render(small.T_world_camera, small.frame.camera)
            in_front = self._in_front(small, static)
            current = self._remember(small, in_front)
            self._insert(current, static, in_front)
            self._optimiser.run(self.map, current, self._companions())
            self.map.keep(growth.worth_keeping(self.map, self._config.prune))
        return self.view(small.frame.stamp_ns, small.T_world_camera, small.frame.camera)

    def render(self, T_world_camera: Pose, camera: PinholeCamera) -> Rendered:
        """Render the static map: what Eq. 11 lets through."""
        return self._render(T_world_camera, camera, self.map.visible_mask())

    def render_everything(self, T_world_camera: Pose, camera: PinholeCamera) -> Rendered:
        """Render also the Gaussians that Eq. 11 hides, for the posterior of all that is known."""
        return self._render(T_world_camera, camera, None)

    def _render(
        self, T_world_camera: Pose, camera: PinholeCamera, active: Mask | None
    ) -> Rendered:
        return render(
            self.map.as_gaussians(),
            se3.inverse(T_world_camera),
            camera,
            active=active,
            threads=self._config.threads,
            backend=self._config.backend,
        )

    def _infer(self, keyframe: Keyframe) -> None:
        """Update every belief with what this keyframe says, Eq. 1-6, 10; delete what is gone."""
        observation = likelihood.Observation(
            se3.inverse(keyframe.T_world_camera),
            keyframe.frame.camera,
            keyframe.frame.color.astype(np.float32) / np.float32(255),
            keyframe.frame.depth_m,
            keyframe.p_dynamic,
        )
        config = self._belief.likelihood
        features = likelihood.extract(self.map.means, self.map.colors, observation, config)
        self.map.observations += features.visible
        if self._belief.enabled:
            evidence = likelihood.evidence(features, config)
            stamp_ns = keyframe.frame.stamp_ns
            self.map.belief.observe(stamp_ns, keyframe.T_world_camera, evidence)
        else:
            self.map.belief.overwrite(likelihood.label(features), features.visible)
        seen_through = features.values[:, likelihood.FEATURES.index('free_space')] > 0
        self.map.keep(~growth.confirmed_gone(self.map, seen_through, self._belief))

    def _in_front(self, keyframe: Keyframe, static: Rendered) -> Mask:
        """Return where something stands before the static map, [H, W]."""
        depth_m = keyframe.frame.depth_m
        count = self._config.insert.depth_sigma
        return growth.pixels_in_front(depth_m, static, self._sigma(depth_m), count)

    def _remember(self, keyframe: Keyframe, in_front: Mask) -> MapKeyframe:
        """Keep the keyframe's images; what is labelled or stands in front does not count."""
        frame = keyframe.frame
        moving = is_dynamic(keyframe.p_dynamic) | without_specks(in_front, _MIN_BLOB_SHARE)
        levels = build_levels(
            frame.color, frame.depth_m, moving, frame.camera, self._config.pyramid.levels
        )
        current = MapKeyframe(
            self._count, frame.stamp_ns, keyframe.T_world_camera, keyframe.p_dynamic, levels
        )
        if self.keyframes:
            current.exposure = self.keyframes[-1].exposure.copy()
        self.keyframes.append(current)
        self.keyframe_stamps_ns.append(current.stamp_ns)
        if len(self.keyframes) > max(self._config.keyframes, self._config.window):
            older = self.keyframes[: -self._config.window]
            self.keyframes.remove(most_redundant(older))
        self._count += 1
        return current

    def _sigma(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        config = self._belief.likelihood
        return np.asarray(config.depth_floor + config.depth_noise * depth_m**2, np.float32)

    def _insert(self, current: MapKeyframe, static: Rendered, in_front: Mask) -> None:
        """Add Gaussians where the map is empty and nothing moves; and, hidden, in front of it."""
        config = self._config.insert
        level = current.levels[0]
        usable = growth.usable_depth(level.depth_m, config)
        sigma = self._sigma(level.depth_m)
        surface = fit_surface(level.depth_m, usable, level.camera, config.normal_px, sigma)

        def grow(pixels: Mask, belief: float) -> None:
            new = lift(current, level, surface, pixels, belief, config)
            self.map.append(new, config.opacity, current.index)

        everything = self.render_everything(current.T_world_camera, level.camera)
        unknown = ~growth.explained(level.depth_m, everything, sigma, config.depth_sigma)
        empty = growth.empty_pixels(static, config) & unknown
        still = growth.far_from_movers(level.weight > 0, config)
        grow(usable & still & empty, self._belief.initial)
        # What stands in front of the map and no detector names may be new furniture: it enters
        # hidden by Eq. 11, and the filter decides whether it stays.
        unnamed = ~is_dynamic(current.p_dynamic)
        new = without_specks(in_front & unknown & unnamed, _MIN_BLOB_SHARE)
        grow(usable & new, self._belief.initial_in_front)

    def _companions(self) -> list[MapKeyframe]:
        """Return the window and as many older keyframes at random, in random order."""
        window = self.keyframes[-self._config.window : -1]
        older = self.keyframes[: -self._config.window]
        if older:
            count = min(len(older), self._config.window // 2)
            chosen = self._rng.choice(len(older), count, replace=False)
            window = window + [older[i] for i in chosen]
        return [window[i] for i in self._rng.permutation(len(window))]

    def view(self, stamp_ns: int, T_world_camera: Pose, camera: PinholeCamera) -> ModelView:
        """Render what tracking gets back: the static map and its posterior, as topics carry it."""
        static = self.render(T_world_camera, camera)
        known = static.silhouette > self._config.model.silhouette
        safe = np.maximum(static.silhouette, np.float32(1e-6))
        color = static.color / safe[..., None]
        return ModelView(
            stamp_ns,
            T_world_camera,
            camera,
            np.where(known[..., None], np.clip(color * 255 + 0.5, 0, 255), 0).astype(np.uint8),
            np.where(known, static.depth / safe, 0).astype(np.float32),
            _to_probability_image(np.asarray(static.p_dynamic / safe, np.float32)),
        )

    def save(self, path: Path, *, keyframes: bool = True) -> None:
        """
        Write the map as .ply and, in a folder beside it, the keyframes it was fitted to.

        Parameters
        ----------
        path : Path
            Of the .ply; the folder is `bdgs_ros.mapping.map_files.keyframe_folder(path)`.
        keyframes : bool
            Whether to keep the images, without which a map cannot be refined.

        Raises
        ------
        MapError
            If something cannot be written; the old files are still there then.

        """
        kept = KeyframeSet(self.keyframes, self.keyframe_stamps_ns, self._count)
        save_map(Path(path), self.map, kept if keyframes else None)

    def load(self, path: Path) -> None:
        """
        Replace the map by a saved one; new keyframes continue after those it was made of.

        Raises
        ------
        MapError
            If it cannot be read; the mapper then keeps the map it has.

        """
        loaded, kept = load_map(Path(path), self._belief, self._config.pyramid.levels)
        self.reset()
        self.map = loaded
        self.keyframes = list(kept.keyframes)
        self.keyframe_stamps_ns = list(kept.stamps_ns)
        self._count = kept.next_index


def _to_probability_image(p_dynamic: NDArray[np.float32]) -> ProbabilityImage:
    return np.asarray(np.clip(p_dynamic * 255 + 0.5, 0, 255), np.uint8)
