"""
Where the camera is, frame by frame, section 3.1 of the paper.

Predict, align to the last keyframe, see what moves, refine against the rendered static map,
decide whether the pose can be trusted and whether the frame becomes a keyframe.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.config import TrackingConfig
from bdgs_ros.core.types import (
    Labels,
    ModelView,
    Pose,
    ProbabilityImage,
    RgbdFrame,
    TrackingResult,
    TrackingStatus,
)
from bdgs_ros.tracking.align import Aligner, AlignResult, ImagePyramid
from bdgs_ros.tracking.motion import MotionPredictor
from bdgs_ros.tracking.movers import MoverMask

_log = logging.getLogger(__name__)

_START_SIGMA_M = 0.3  # how well the start in a known map is known
_START_SIGMA_RAD = 0.3
_MOST_TRACKED = 32  # keyframes; mapping that is further behind corrects nothing


@dataclass(frozen=True)
class Reference:
    """An image with depth and known pose that frames are aligned to."""

    T_world_camera: Pose
    pyramid: ImagePyramid


@dataclass(frozen=True)
class Estimate:
    """One alignment, as a pose in world."""

    T_world_camera: Pose
    quality: AlignResult


class CameraTracker:
    """Camera pose of every frame, relative to keyframes and to the static map."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._aligner = Aligner(config.align)
        self._refiner = Aligner(
            replace(
                config.align,
                intensity_noise=config.refine.intensity_noise,
                depth_weight=config.refine.depth_weight,
            )
        )
        self._motion = MotionPredictor(config.motion)
        self._movers = MoverMask(config.movers)
        self._readout_s = config.readout_s  # of the camera: outlives a reset
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next frame is the first, and the origin of the world."""
        self._keyframe: Reference | None = None
        self._model: Reference | None = None
        self._tracked: dict[int, Pose] = {}  # keyframes whose view has not come yet
        self._keyframe_depth_m = 1.0
        self._frames_since_keyframe = 0
        self._world_is_known = False
        self._motion.reset()
        self._movers.reset()

    def start_from(self, view: ModelView) -> None:
        """
        Begin in a map that exists: the first frame is aligned to a view of it.

        Parameters
        ----------
        view : ModelView
            Rendered from about where the camera is. Frames are LOST until one fits to it.

        """
        self.reset()
        self.set_model(view)
        self._world_is_known = True

    def set_model(self, view: ModelView | None) -> None:
        """
        Take the static map as rendered at a keyframe, or None where there is no map.

        Mapping may have moved the keyframe a little; all that was tracked since moves with it.
        """
        if view is None:
            return
        self._follow(view)
        if view.readout_s is not None:
            self._readout_s = view.readout_s
        posterior = view.p_dynamic if self._config.refine.posterior else None
        pyramid = self._aligner.pyramid(view.color, view.depth_m, posterior, view.camera)
        self._model = Reference(view.T_world_camera, pyramid)

    def _follow(self, view: ModelView) -> None:
        tracked = self._tracked.get(view.stamp_ns)
        if tracked is None or self._keyframe is None:
            return
        T_new_old = se3.orthonormalise(view.T_world_camera @ se3.inverse(tracked))
        self._motion.move(T_new_old)
        moved = T_new_old @ self._keyframe.T_world_camera
        self._keyframe = replace(self._keyframe, T_world_camera=moved)
        self._tracked = {
            stamp_ns: T_new_old @ pose
            for stamp_ns, pose in self._tracked.items()
            if stamp_ns >= view.stamp_ns
        }

    def process(self, frame: RgbdFrame, labels: Labels | None = None) -> TrackingResult:
        """
        Estimate the camera pose of the next frame.

        Parameters
        ----------
        frame : RgbdFrame
            Newer than the last one.
        labels : Labels, optional
            Dynamic prior; without it every pixel may be static.

        Returns
        -------
        result : TrackingResult
            With status LOST the pose is the prediction and must not be used.

        """
        prior = self._prior(frame, labels)
        expected = np.maximum(prior, self._movers.expected(frame.camera.shape))
        sweep = self._readout_s * self._motion.velocity
        current = self._aligner.pyramid(frame.color, frame.depth_m, expected, frame.camera, sweep)
        if self._keyframe is None:
            first = self._enter if self._world_is_known else self._start
            return first(frame, current, prior)
        predicted, covariance = self._motion.predict(frame.stamp_ns)
        information = np.asarray(np.linalg.inv(covariance), np.float64)
        coarse = self._align(self._keyframe, current, predicted, information)
        p_dynamic = self._see_movers(prior, current, coarse)
        velocity = self._motion.velocity_with(
            frame.stamp_ns, coarse.T_world_camera, coarse.quality.covariance
        )
        current = self._aligner.with_dynamic(current, p_dynamic, self._readout_s * velocity)
        fine = self._refine(current, coarse, information)
        return self._conclude(frame, current, coarse.quality.overlap, fine, p_dynamic, predicted)

    def _prior(self, frame: RgbdFrame, labels: Labels | None) -> ProbabilityImage:
        if labels is None or not self._config.masked:
            return np.zeros(frame.camera.shape, np.uint8)
        return labels.p_dynamic

    def _start(
        self, frame: RgbdFrame, current: ImagePyramid, p_dynamic: ProbabilityImage
    ) -> TrackingResult:
        """Make the first frame the origin of the world and a keyframe."""
        T_world_camera, covariance = se3.identity(), 1e-6 * np.eye(6)
        self._motion.update(frame.stamp_ns, T_world_camera, covariance)
        self._become_keyframe(frame, T_world_camera, current)
        return TrackingResult(
            frame.stamp_ns,
            TrackingStatus.OK,
            T_world_camera,
            covariance,
            True,
            p_dynamic,
            1.0,
            1.0,
        )

    def _enter(
        self, frame: RgbdFrame, current: ImagePyramid, prior: ProbabilityImage
    ) -> TrackingResult:
        """Find the first frame in the known map, and make it a keyframe."""
        assert self._model is not None
        guess = self._model.T_world_camera
        information = np.diag(1 / np.array([_START_SIGMA_M**2] * 3 + [_START_SIGMA_RAD**2] * 3))
        coarse = self._align(self._model, current, guess, information)
        p_dynamic = self._see_movers(prior, current, coarse)
        current = self._aligner.with_dynamic(current, p_dynamic)
        estimate = self._refine(current, coarse, information)
        quality = estimate.quality
        if not self._is_good(quality):
            return self._lost(frame, guess, p_dynamic, quality)
        self._motion.update(frame.stamp_ns, estimate.T_world_camera, quality.covariance)
        self._become_keyframe(frame, estimate.T_world_camera, current)
        return _tracked(frame, estimate, True, p_dynamic, quality.overlap)

    def _align(
        self,
        reference: Reference,
        current: ImagePyramid,
        guess: Pose,
        information: NDArray[np.float64],
        fine_only: bool = False,
    ) -> Estimate:
        aligner = self._refiner if fine_only else self._aligner
        T_current_reference = se3.inverse(guess) @ reference.T_world_camera
        quality = aligner.align(
            reference.pyramid, current, T_current_reference, fine_only, information
        )
        T_world_camera = reference.T_world_camera @ se3.inverse(quality.T_current_reference)
        return Estimate(se3.orthonormalise(T_world_camera), quality)

    def _see_movers(
        self, prior: ProbabilityImage, current: ImagePyramid, coarse: Estimate
    ) -> ProbabilityImage:
        """Join the prior with what stands nearer than the static map (class-agnostic prior)."""
        if self._model is None or not self._config.masked:
            return prior
        T_current_model = se3.inverse(coarse.T_world_camera) @ self._model.T_world_camera
        maps = self._aligner.residual_maps(self._model.pyramid, current, T_current_model)
        return np.maximum(prior, self._movers.update(maps, prior.shape))

    def _refine(
        self, current: ImagePyramid, coarse: Estimate, information: NDArray[np.float64]
    ) -> Estimate:
        """Align to the rendered static map, starting from the coarse pose."""
        if self._model is None or not self._config.refine.enabled:
            return coarse
        fine = self._align(
            self._model, current, coarse.T_world_camera, information, fine_only=True
        )
        return fine if self._is_good(fine.quality) else coarse

    def _is_good(self, quality: AlignResult) -> bool:
        # A covered lens agrees with everything at gain 0.
        return (
            quality.inlier_ratio >= self._config.lost_inlier_ratio
            and quality.coverage >= self._config.lost_coverage
            and 1 / self._config.lost_gain < quality.gain < self._config.lost_gain
        )

    def _conclude(
        self,
        frame: RgbdFrame,
        current: ImagePyramid,
        overlap: float,
        estimate: Estimate,
        p_dynamic: ProbabilityImage,
        predicted: Pose,
    ) -> TrackingResult:
        quality = estimate.quality
        self._frames_since_keyframe += 1
        if not self._is_good(quality):
            return self._lost(frame, predicted, p_dynamic, quality)
        self._motion.update(frame.stamp_ns, estimate.T_world_camera, quality.covariance)
        is_keyframe = self._needs_keyframe(estimate.T_world_camera, overlap)
        if is_keyframe:
            self._become_keyframe(frame, estimate.T_world_camera, current)
        return _tracked(frame, estimate, is_keyframe, p_dynamic, overlap)

    def _lost(
        self,
        frame: RgbdFrame,
        predicted: Pose,
        p_dynamic: ProbabilityImage,
        quality: AlignResult,
    ) -> TrackingResult:
        """Report loss; the next frames try again from where the camera was last seen."""
        _log.warning(
            'lost at stamp %d ns: %.0f %% inliers on %.0f %% of the image, exposure gain %.2f',
            frame.stamp_ns,
            100 * quality.inlier_ratio,
            100 * quality.coverage,
            quality.gain,
        )
        return TrackingResult(
            frame.stamp_ns,
            TrackingStatus.LOST,
            predicted,
            quality.covariance,
            False,
            p_dynamic,
            quality.inlier_ratio,
            quality.overlap,
        )

    def _needs_keyframe(self, T_world_camera: Pose, overlap: float) -> bool:
        """
        Choose by translation over depth, rotation, overlap and age, all against the last keyframe.

        The model view may be of an older one, when mapping is behind.
        """
        assert self._keyframe is not None
        rules = self._config.keyframe
        T_keyframe_current = se3.inverse(self._keyframe.T_world_camera) @ T_world_camera
        move = float(np.linalg.norm(T_keyframe_current[:3, 3])) / self._keyframe_depth_m
        turn = np.rad2deg(se3.rotation_angle_rad(T_keyframe_current))
        return bool(
            move > rules.translation
            or turn > rules.rotation_deg
            or overlap < rules.overlap
            or self._frames_since_keyframe >= rules.max_interval
        )

    def _become_keyframe(
        self, frame: RgbdFrame, T_world_camera: Pose, pyramid: ImagePyramid
    ) -> None:
        self._keyframe = Reference(T_world_camera, pyramid)
        self._tracked[frame.stamp_ns] = T_world_camera
        if len(self._tracked) > _MOST_TRACKED:
            del self._tracked[min(self._tracked)]
        self._keyframe_depth_m = _median_depth(frame.depth_m)
        self._frames_since_keyframe = 0


def _tracked(
    frame: RgbdFrame,
    estimate: Estimate,
    is_keyframe: bool,
    p_dynamic: ProbabilityImage,
    overlap: float,
) -> TrackingResult:
    return TrackingResult(
        frame.stamp_ns,
        TrackingStatus.OK,
        estimate.T_world_camera,
        estimate.quality.covariance,
        is_keyframe,
        p_dynamic,
        estimate.quality.inlier_ratio,
        overlap,
    )


def _median_depth(depth_m: NDArray[np.float32]) -> float:
    valid = depth_m[depth_m > 0]
    return float(np.median(valid)) if len(valid) else 1.0
