"""One keyframe after the other into the static Gaussian map, sections 3.2-3.5 of the paper."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Mapping
from dataclasses import replace
from pathlib import Path
from typing import TypeVar

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.likelihood import Observation
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.core.images import without_specks
from bdgs_ros.core.types import (
    Keyframe,
    ModelView,
    Pose,
    ProbabilityImage,
    RgbdFrame,
    StampedPose,
    Trajectory,
)
from bdgs_ros.mapping import growth, prune
from bdgs_ros.mapping.depth_bend import DepthBend, RangeImage
from bdgs_ros.mapping.exposure import fit_exposure
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.history import History
from bdgs_ros.mapping.inference import Inference
from bdgs_ros.mapping.keyframe_store import KeyframeSet
from bdgs_ros.mapping.keyframes import (
    Level,
    MapKeyframe,
    build_levels,
    is_dynamic,
    most_redundant,
    photograph,
    shrink,
)
from bdgs_ros.mapping.lift import lift
from bdgs_ros.mapping.map_files import load_map, save_map
from bdgs_ros.mapping.merge import merge_down_to
from bdgs_ros.mapping.optimise import Optimiser
from bdgs_ros.mapping.rasterize import Rendered, render
from bdgs_ros.mapping.surface import fit_surface
from bdgs_ros.mapping.vignette import Photo, Vignette

Mask = NDArray[np.bool_]
Answer = Callable[[ModelView], None]
Seen = TypeVar('Seen')

_log = logging.getLogger(__name__)

_PHOTOS = 4  # so many earlier keyframes are compared with
_CLEARLY_MORE = 1.5  # than the budget
_MIN_BLOB_SHARE = 0.002  # of the image; smaller things in front of the map are noise


class Mapper:
    """
    The static Gaussian map, grown and optimised keyframe by keyframe.

    Parameters
    ----------
    mapping, belief : MappingConfig, BeliefConfig
        All parameters.
    hurried : callable
        Asked during optimisation whether the next keyframe waits already; then it is shorter.

    """

    def __init__(
        self,
        mapping: MappingConfig,
        belief: BeliefConfig,
        hurried: Callable[[], bool] = lambda: False,
    ) -> None:
        self._config = mapping
        self._belief = belief
        self._hurried = hurried
        self._optimiser = Optimiser(mapping, hurried)
        self.inference = Inference(belief)
        """May be replaced by one that keeps a record."""
        self.frozen = False
        """Localisation mode: keyframes are answered with a view, the map does not change."""
        self.reset()

    def reset(self) -> None:
        """Forget the map."""
        self.map = GaussianMap(self._belief, self._config.color.degree)
        self.removed_by_belief = self.map.serial
        """Serial numbers of what the last keyframe took out because it moved or never was."""
        self.keyframes: list[MapKeyframe] = []
        self.history = History()
        self.readout_s: float | None = None
        """What is known of the camera's rolling shutter; told to tracking with every view."""
        self.refused = 0
        """How many corrections were none that can be."""
        self.vignette = Vignette()
        self.depth_bend = DepthBend()
        self._photos: list[Photo] = []
        self._ranges: list[RangeImage] = []
        self._count = 0
        self._polished = 0  # steps since the last keyframe
        self._index_of: dict[int, int] = {}  # of this run's keyframes, by stamp
        self._rng = np.random.default_rng(self._config.seed)

    @property
    def grows(self) -> bool:
        """Whether keyframes change the map."""
        return self._config.enabled and not self.frozen

    def announce(self, stamp_ns: int, T_world_camera: Pose) -> None:
        """Take the pose of a new keyframe, as tracking gave it; it moves with `correct_poses`."""
        self.history.add(stamp_ns, T_world_camera)

    def process(self, keyframe: Keyframe, early: Answer | None = None) -> ModelView | None:
        """
        Take a keyframe into the map.

        Parameters
        ----------
        keyframe : Keyframe
            Frame, pose and dynamic prior.
        early : callable, optional
            Called with the view as it is before optimisation, which takes most of the time. If
            the next keyframe waits after that, it has to do.

        Returns
        -------
        view : ModelView or None
            The static map at the keyframe's pose; None with `mapping.enabled` off, or if the
            early one has to do.

        """
        if not self._config.enabled:
            return None
        fine = shrink(keyframe, self._config.width)
        small = shrink(fine, self._config.growth_width)
        if self.frozen:
            return self.view(small.frame.stamp_ns, small.T_world_camera, small.frame.camera)
        fine, small = self._straighten(fine, small)
        agree, gone = self._infer(small)
        static = self._look(small, agree, gone)
        in_front = self._in_front(small, static)
        level = self._growth_level(small, in_front)
        current = self._remember(fine, level.static)
        self._calibrate(current, level, static)
        self._insert(current, level, static, in_front & ~is_dynamic(small.p_dynamic))
        companions = self._companions()
        for companion in companions:
            self.depth_bend.renew(companion)
        if early is not None:
            early(self._answer(current, level.camera))
        self._optimiser.run(self.map, current, companions)
        self._settle()
        self._thin()
        if early is not None and self._hurried():
            return None
        return self._answer(current, level.camera)

    def _settle(self) -> None:
        """Fit the map to all keyframes, so that it does not follow the newest ones alone."""
        if self._config.settle:
            views = [self._any_keyframe(i) for i in range(self._config.settle)]
            self._optimiser.settle(self.map, views, self._config.settle_rate)

    def _any_keyframe(self, turn: int) -> MapKeyframe:
        """Return a keyframe at random: in turn one of the window, or of all."""
        among = self.keyframes[-self._config.window :] if turn % 2 else self.keyframes
        return among[self._rng.integers(len(among))]

    def polish(self, most: int) -> bool:
        """
        Take one more step of optimisation while there is nothing else to do.

        Parameters
        ----------
        most : int
            Steps after each keyframe.

        Returns
        -------
        more : bool
            Whether there are any left.

        """
        if not self.grows or not self.keyframes or self._polished >= most:
            return False
        keyframe = self._any_keyframe(self._polished)
        self._optimiser.step(self.map, keyframe, 0, move=False)
        self._polished += 1
        return self._polished < most

    def _answer(self, current: MapKeyframe, camera: PinholeCamera) -> ModelView:
        """Render what tracking gets."""
        return self.view(current.stamp_ns, current.T_world_camera, camera, current.exposure)

    def _straighten(self, fine: Keyframe, small: Keyframe) -> tuple[Keyframe, Keyframe]:
        """Learn the bend of the depth sensor, and take out of the depth what is known of it."""
        measured = RangeImage.of(small)
        for earlier in self._compared(self._ranges):
            self.depth_bend.learn(measured, earlier)
        self._ranges = [*self._ranges, measured][-_PHOTOS:]
        return self._unbent(fine), self._unbent(small)

    def _compared(self, earlier: list[Seen]) -> list[Seen]:
        """Return which earlier images a new one is compared with: in a hurry, the oldest alone."""
        return earlier[:1] if self._hurried() else earlier

    def _unbent(self, keyframe: Keyframe) -> Keyframe:
        frame = keyframe.frame
        depth_m = self.depth_bend.correct(frame.depth_m, frame.camera)
        return replace(keyframe, frame=replace(frame, depth_m=depth_m))

    def render(self, T_world_camera: Pose, camera: PinholeCamera) -> Rendered:
        """Render the static map: what Eq. 11 lets through."""
        return self._render(T_world_camera, camera, self.map.visible_mask())

    def render_everything(self, T_world_camera: Pose, camera: PinholeCamera) -> Rendered:
        """Render also the Gaussians that Eq. 11 hides, for the posterior of all that is known."""
        return self._render(T_world_camera, camera, None)

    def _render(
        self,
        T_world_camera: Pose,
        camera: PinholeCamera,
        active: Mask | None,
        statistics: bool = False,
    ) -> Rendered:
        T_camera_world = se3.inverse(T_world_camera)
        shading = self.map.shading(T_camera_world, self._config.threads)
        return render(
            self.map.as_gaussians(shading, active),
            T_camera_world,
            camera,
            active=active,
            statistics=statistics,
            threads=self._config.threads,
            backend=self._config.backend,
        )

    def _infer(self, keyframe: Keyframe) -> tuple[Mask, Mask]:
        """
        Update every belief with what this keyframe says, Eq. 1-6, 10.

        Returns where the camera measured a Gaussian's depth, and which Gaussians are gone, [N].
        """
        frame = keyframe.frame
        observation = Observation(
            frame.stamp_ns,
            keyframe.T_world_camera,
            frame.camera,
            self._in_map_colors(frame),
            frame.depth_m,
            keyframe.p_dynamic,
        )
        features = self.inference.observe(self.map, observation, self._count)
        prune.note_checks(self.map, features)
        gone = prune.confirmed_gone(self.map, self._belief)
        gone |= prune.unconfirmed(self.map, self._count, self._config.prune)
        self.removed_by_belief = self.map.serial[gone]
        return features.agrees, gone

    def _look(self, keyframe: Keyframe, agree: Mask, gone: Mask) -> Rendered:
        """Render the static map as a keyframe finds it; what is gone, or adds nothing, goes."""
        T, camera = keyframe.T_world_camera, keyframe.frame.camera
        static = self._render(T, camera, self.map.visible_mask() & ~gone, statistics=True)
        assert static.max_weight is not None
        resolved = prune.resolved_by(self.map, se3.inverse(T), camera)
        config = self._config.prune
        prune.note_contribution(self.map, agree, static.max_weight, resolved, config)
        useful = prune.worth_keeping(self.map, config) & ~prune.redundant(self.map, config)
        self.map.keep(useful & ~gone)
        return static

    def _in_map_colors(self, frame: RgbdFrame) -> NDArray[np.float32]:
        """Return an image without falloff and exposure, that of the last keyframe, [H, W, 3]."""
        log_gain, offset = self.keyframes[-1].exposure if self.keyframes else (0.0, 0.0)
        color = frame.color * self.vignette.scale(frame.camera)
        return np.asarray((color - offset) / np.exp(log_gain), np.float32)

    def _in_front(self, keyframe: Keyframe, static: Rendered) -> Mask:
        """Return where something stands before the static map, [H, W]."""
        depth_m = keyframe.frame.depth_m
        count = self._config.insert.depth_sigma
        return growth.pixels_in_front(depth_m, static, self._sigma(depth_m), count)

    def _growth_level(self, keyframe: Keyframe, in_front: Mask) -> Level:
        """Return the images that the map grows by; what stands in front may move."""
        moving = is_dynamic(keyframe.p_dynamic) | without_specks(in_front, _MIN_BLOB_SHARE)
        return self._levels(keyframe.frame, moving, 1)[0]

    def _levels(self, frame: RgbdFrame, moving: Mask, count: int) -> tuple[Level, ...]:
        return build_levels(frame.color, frame.depth_m, moving, frame.camera, count, self.vignette)

    def _remember(self, keyframe: Keyframe, static: Mask) -> MapKeyframe:
        """Keep the keyframe's images; `static` may be of a smaller size."""
        frame = keyframe.frame
        size = (frame.camera.width, frame.camera.height)
        still = cv2.resize(static.astype(np.uint8), size, interpolation=cv2.INTER_NEAREST)
        moving = is_dynamic(keyframe.p_dynamic) | (np.asarray(still) == 0)
        levels = self._levels(frame, moving, self._config.pyramid.levels)
        current = MapKeyframe(
            self._count, frame.stamp_ns, keyframe.T_world_camera, keyframe.p_dynamic, levels
        )
        current.depth_bend = self.depth_bend.coefficients
        if self.keyframes:
            current.exposure = self.keyframes[-1].exposure.copy()
        self.keyframes.append(current)
        if current.stamp_ns not in self.history.poses:
            self.history.add(current.stamp_ns, current.T_world_camera)
        self._index_of[current.stamp_ns] = current.index
        if len(self.keyframes) > max(self._config.keyframes, self._config.window):
            redundant = most_redundant(self.keyframes[: -self._config.window])
            self.history.refresh([redundant])
            self.keyframes.remove(redundant)
        self._count += 1
        self._polished = 0
        return current

    def _calibrate(self, current: MapKeyframe, level: Level, static: Rendered) -> None:
        """Learn the lens's falloff from earlier keyframes, and the exposure from the map."""
        photo = Photo.of(level, current.T_world_camera)
        for earlier in self._compared(self._photos):
            self.vignette.learn(photo, earlier)
        self._photos = [*self._photos, photo][-_PHOTOS:]
        exposure = fit_exposure(static, level)
        if exposure is not None and current.index > 0:
            current.exposure = exposure

    def _sigma(self, depth_m: NDArray[np.float32]) -> NDArray[np.float32]:
        config = self._belief.likelihood
        return np.asarray(config.depth_floor + config.depth_noise * depth_m**2, np.float32)

    def _insert(self, current: MapKeyframe, level: Level, static: Rendered, unnamed: Mask) -> None:
        """Add Gaussians where the map is empty and nothing moves; and, hidden, in front of it."""
        config = self._config.insert
        usable = growth.usable_depth(level.depth_m, config)
        sigma = self._sigma(level.depth_m)
        everything = self.render_everything(current.T_world_camera, level.camera)
        unknown = ~growth.explained(level.depth_m, everything, sigma, config.depth_sigma)
        still = growth.far_from_movers(level.static, config)
        empty = usable & still & growth.empty_pixels(static, config) & unknown
        # What stands in front of the map and no detector names may be new furniture: it enters
        # hidden by Eq. 11, and the filter decides whether it stays.
        new = usable & without_specks(unnamed & unknown, _MIN_BLOB_SHARE)
        surface = fit_surface(
            level.depth_m, usable, empty | new, level.camera, config.normal_px, sigma
        )
        for pixels, belief in (
            (empty, self._belief.initial),
            (new, self._belief.initial_in_front),
        ):
            if pixels.any():
                added = lift(current, level, surface, pixels, belief, config)
                self._grow(added, current.index)

    def _grow(self, new: NewGaussians, index: int) -> None:
        """Add Gaussians, and ask what earlier keyframes saw where they are."""
        self.map.append(new, self._config.insert.opacity, index)
        rows = np.arange(len(self.map) - len(new.means), len(self.map))
        self.inference.ask_memory(self.map, rows, index)

    def _thin(self) -> None:
        """
        Take out what is of no use; over the budget, merge neighbours, then drop the least.

        In a hurry, what is of no use can wait for the next keyframe.
        """
        budget = self._config.prune.max_gaussians
        if self._hurried() and len(self.map) <= budget:
            return
        self.map.keep(prune.worth_keeping(self.map, self._config.prune))
        if len(self.map) > budget:
            if len(self.map) > _CLEARLY_MORE * budget:  # not grown here: of a map that was loaded
                _log.warning(
                    '%d Gaussians become %d: to keep them, set mapping.prune.max_gaussians higher',
                    len(self.map),
                    budget,
                )
            config = self._config.merge
            merge_down_to(self.map, round(config.share * budget), config)
        self.map.keep(~prune.least_useful(self.map, len(self.map) - budget))

    def correct_poses(self, transforms: Mapping[int, Pose]) -> None:
        """
        Move keyframes and, with them, the Gaussians that they brought: loop closure.

        Parameters
        ----------
        transforms : mapping of int to ndarray, shape (4, 4)
            `T_new_old` in world by stamp (ns), also of keyframes whose images are forgotten;
            what is not named, or unknown, stays. All stays if one of them is no motion, or moves
            a keyframe further than `se3.FARTHEST_CORRECTION_M`.

        """
        old = {s: pose for s, pose in self.keyframe_poses().items() if s in transforms}
        new = [transforms[s] @ pose for s, pose in old.items()]
        if not se3.is_correction(list(old.values()), new):
            self.refused += 1
            _log.warning('a correction was refused (%d so far)', self.refused)
            return
        brought = {self._index_of[s]: T for s, T in transforms.items() if s in self._index_of}
        self.map.deform(brought)
        self.history.refresh(self.keyframes)
        self.history.move(transforms)
        for keyframe in self.keyframes:
            if keyframe.index in brought:
                T_new_old = brought[keyframe.index]
                keyframe.T_world_camera = se3.orthonormalise(T_new_old @ keyframe.T_world_camera)

    def keyframe_poses(self) -> dict[int, Pose]:
        """Return `T_world_camera` of this run's keyframes by stamp (ns), as they are now."""
        self.history.refresh(self.keyframes)
        return self.history.poses

    def _companions(self) -> list[MapKeyframe]:
        """Return the window and as many older keyframes at random, in random order."""
        window = self.keyframes[-self._config.window : -1]
        older = self.keyframes[: -self._config.window]
        if older:
            count = min(len(older), self._config.window // 2)
            chosen = self._rng.choice(len(older), count, replace=False)
            window = window + [older[i] for i in chosen]
        return [window[i] for i in self._rng.permutation(len(window))]

    def as_photograph(self, rendered: Rendered, camera: PinholeCamera, stamp_ns: int) -> Rendered:
        """
        Return a render as the camera would show it at a time: exposed, with falloff, depth bent.

        The exposure is blended between the keyframes around that time.
        """
        self.history.refresh(self.keyframes)
        return self._exposed(rendered, camera, self.history.exposure(stamp_ns))

    def _exposed(
        self, rendered: Rendered, camera: PinholeCamera, exposure: NDArray[np.float32]
    ) -> Rendered:
        color = np.exp(exposure[0]) * rendered.color + exposure[1] * rendered.silhouette[..., None]
        color = color * self.vignette.falloff(camera)[..., None]
        silhouette = np.maximum(rendered.silhouette, np.float32(1e-6))
        surface = np.asarray(rendered.depth / silhouette, np.float32)
        return replace(
            rendered, color=color, depth=silhouette * self.depth_bend.bend(surface, camera)
        )

    def final_trajectory(self, online: Trajectory) -> Trajectory:
        """
        Return poses with what mapping found out after it had answered tracking.

        Frames of pieces of map that were joined later have one, too.
        """
        self.history.refresh(self.keyframes)
        return self.history.correct(self.history.completed(online))

    def final_pose(self, stamp_ns: int, T_world_camera: Pose) -> Pose:
        """Return one pose with what mapping found out later."""
        online = Trajectory((StampedPose(stamp_ns, T_world_camera),))
        self.history.refresh(self.keyframes)
        return self.history.correct(online).poses[0].T_world_camera

    def view(
        self,
        stamp_ns: int,
        T_world_camera: Pose,
        camera: PinholeCamera,
        exposure: NDArray[np.float32] | None = None,
    ) -> ModelView:
        """Render what tracking gets back: the static map and its posterior, as topics carry it."""
        exposed = self.history.exposure(stamp_ns) if exposure is None else exposure
        static = self._exposed(self.render(T_world_camera, camera), camera, exposed)
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
            self.readout_s,
        )

    def photographs(self) -> Iterator[Keyframe]:
        """Yield the keyframes of the map at its size: places that may be recognised."""
        return map(photograph, self.keyframes)

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
        for keyframe in self.keyframes:
            self.depth_bend.renew(keyframe)
        save_map(Path(path), self.map, self.kept() if keyframes else None)

    def kept(self) -> KeyframeSet:
        """Return what belongs to the map beside its Gaussians."""
        self.history.refresh(self.keyframes)
        return KeyframeSet(
            self.keyframes,
            self.history,
            self.vignette,
            self.depth_bend,
            self._count,
            self.readout_s,
            self._index_of,
        )

    def load(self, path: Path) -> None:
        """
        Replace the map by a saved one; new keyframes continue after those it was made of.

        Raises
        ------
        MapError
            If it cannot be read; the mapper then keeps the map it has.

        """
        loaded, kept = load_map(
            Path(path), self._belief, self._config.pyramid.levels, self._config.color.degree
        )
        self.take(loaded, replace(kept, index_of={}))

    def take(self, gaussians: GaussianMap, kept: KeyframeSet) -> None:
        """Go on with a map as if it had grown here."""
        self.reset()
        self.map = gaussians
        self.keyframes = list(kept.keyframes)
        self.history, self.vignette = kept.history, kept.vignette
        self.depth_bend = kept.depth_bend
        self.readout_s = kept.readout_s
        self._count = kept.next_index
        self._index_of = dict(kept.index_of)


def _to_probability_image(p_dynamic: NDArray[np.float32]) -> ProbabilityImage:
    return np.asarray(np.clip(p_dynamic * 255 + 0.5, 0, 255), np.uint8)
