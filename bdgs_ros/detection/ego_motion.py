"""Where the camera went over the last seconds, so that the geometric prior can compare frames."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.config.detection import GeometricConfig
from bdgs_ros.core.config.tracking import AlignConfig
from bdgs_ros.core.types import Pose, ProbabilityImage, RgbdFrame
from bdgs_ros.tracking.align import Aligner, ImagePyramid


class EgoMotion(Protocol):
    """Camera poses that are right relative to each other over a few seconds."""

    def update(self, frame: RgbdFrame, p_dynamic: ProbabilityImage) -> Pose | None:
        """
        Take the next frame; return `T_odom_camera`, or None when the motion is not known.

        After None the odometry frame starts anew: earlier poses must be dropped.
        """

    def reset(self) -> None:
        """Start anew."""


@dataclass(frozen=True)
class _Anchor:
    stamp_ns: int
    T_odom_camera: Pose
    pyramid: ImagePyramid


_ITERATIONS = 8  # registration by depth alone takes the rest
_MIN_INLIERS = 0.25  # fewer: the pose follows something that moves
_MIN_COVERAGE = 0.04  # less static image compared: a pose from it is chance
_MIN_OVERLAP = 0.8  # less of the anchor in view: the next frames get a new one
_MAX_ACCELERATION = 30.0  # m/s^2 and rad/s^2: more, and the pose has jumped onto something else
_MAX_MISSES = 5  # frames at constant velocity before the motion is unknown


class DirectEgoMotion:
    """
    Coarse direct alignment to an anchor frame, at constant velocity between frames.

    The stage has its own small odometry, so that it runs in its own process without waiting for
    the tracker (which waits for it).

    Parameters
    ----------
    config : GeometricConfig
        `width` is the finest image that is aligned.

    """

    def __init__(self, config: GeometricConfig) -> None:
        self._config = config
        self._aligner = Aligner(AlignConfig(fine_width=config.width, max_iterations=_ITERATIONS))
        self.reset()

    def reset(self) -> None:
        """Start anew."""
        self._anchor: _Anchor | None = None
        self._T_odom_camera = se3.identity()
        self._misses = 0
        self._last_ns = 0
        self._step: Pose | None = None  # T_last_current of the last pair; None: not known yet

    @property
    def predicted(self) -> Pose:
        """`T_odom_camera` of the next frame at constant velocity."""
        step = se3.identity() if self._step is None else self._step
        return self._T_odom_camera @ step

    def update(self, frame: RgbdFrame, p_dynamic: ProbabilityImage) -> Pose | None:
        """
        Return `T_odom_camera` of the next frame, or None when it cannot be aligned.

        Parameters
        ----------
        frame : RgbdFrame
            Newer than the last.
        p_dynamic : ndarray, shape (H, W), uint8
            What is known to move and is left out.

        """
        current = self._aligner.pyramid(frame.color, frame.depth_m, p_dynamic, frame.camera)
        if self._anchor is None:
            self._anchor = _Anchor(frame.stamp_ns, self._T_odom_camera, current)
            self._last_ns = frame.stamp_ns
            return self._T_odom_camera
        guess = self.predicted
        result = self._aligner.align(
            self._anchor.pyramid, current, se3.inverse(guess) @ self._anchor.T_odom_camera
        )
        if result.inlier_ratio < _MIN_INLIERS or result.coverage < _MIN_COVERAGE:
            return self._coast(guess)
        pose = self._anchor.T_odom_camera @ se3.inverse(result.T_current_reference)
        if self._jumps(guess, pose, (frame.stamp_ns - self._last_ns) * 1e-9):
            return self._coast(guess)
        if self._misses == 0:  # else the way since the last good frame is not that of one frame
            self._step = se3.inverse(self._T_odom_camera) @ pose
        self._misses, self._last_ns = 0, frame.stamp_ns
        self._T_odom_camera = se3.orthonormalise(pose)
        age_s = (frame.stamp_ns - self._anchor.stamp_ns) * 1e-9
        if age_s > self._config.lag or result.overlap < _MIN_OVERLAP:
            self._anchor = _Anchor(frame.stamp_ns, self._T_odom_camera, current)
        return self._T_odom_camera

    def _jumps(self, guess: Pose, pose: Pose, elapsed_s: float) -> bool:
        """Tell whether a pose asks for too much acceleration since the last good frame."""
        if self._step is None:
            return False
        surprise = se3.log(se3.inverse(guess) @ pose)
        most = max(float(np.linalg.norm(surprise[:3])), float(np.linalg.norm(surprise[3:])))
        return most > _MAX_ACCELERATION * elapsed_s**2

    def _coast(self, guess: Pose) -> Pose | None:
        """Believe the constant velocity for a few frames, then give up."""
        self._misses += 1
        if self._misses > _MAX_MISSES:
            self.reset()
            return None
        self._T_odom_camera = se3.orthonormalise(guess)
        return self._T_odom_camera
