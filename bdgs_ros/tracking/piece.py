"""
What a lost camera sees meanwhile: a piece of map of its own, until it is known where that is.

The camera is followed on from where it was lost, in a world of its own. Its poses are nobody's
until the camera is found in the map again; then the piece's place is known, too, and its keyframes
and poses belong to the map as if it never had been lost (the atlas of ORB-SLAM3 [1]_). A world
that was hardly seen before the loss, because people stood in the view or there was nothing to
see, may never be found again: once the piece has been followed for longer, it takes its place.

References
----------
.. [1] C. Campos, R. Elvira, J. J. Gomez Rodriguez, J. M. M. Montiel, J. D. Tardos, "ORB-SLAM3: An
   Accurate Open-Source Library for Visual, Visual-Inertial, and Multimap SLAM", IEEE Transactions
   on Robotics 37(6), 2021.

"""

from __future__ import annotations

import logging
from dataclasses import dataclass, field, replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.config import TrackingConfig
from bdgs_ros.core.images import thinned
from bdgs_ros.core.types import (
    DYNAMIC_THRESHOLD,
    Keyframe,
    Labels,
    ModelView,
    Pose,
    RgbdFrame,
    StampedPose,
    TrackingResult,
    TrackingStatus,
)
from bdgs_ros.tracking.camera_tracker import CameraTracker
from bdgs_ros.tracking.covariance import chained

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]

_LONGEST_STEP_S = 0.5  # between two frames that count as followed


@dataclass(frozen=True)
class Piece:
    """Frames that were followed while the camera was lost."""

    poses: tuple[StampedPose, ...] = ()
    """Of every frame but those that the piece lost itself."""
    keyframes: tuple[Keyframe, ...] = ()
    covariances: tuple[Array, ...] = ()
    """Of the keyframes' poses, each of shape (6, 6)."""
    is_new_world: bool = False
    """Everything before is given up."""

    def with_frame(self, frame: RgbdFrame, result: TrackingResult, most: int) -> Piece:
        """Return it with a frame more, and of the keyframes the newest."""
        poses = (*self.poses, StampedPose(frame.stamp_ns, result.T_world_camera))
        if not result.is_keyframe:
            return replace(self, poses=poses)
        keyframe = Keyframe(frame, result.T_world_camera, result.p_dynamic)
        return replace(
            self,
            poses=poses,
            keyframes=(*self.keyframes, keyframe)[-most:],
            covariances=(*self.covariances, result.covariance)[-most:],
        )

    def placed(self, T_world_piece: Pose, T_world_camera: Pose, covariance: Array) -> Piece:
        """
        Return it in the world.

        Parameters
        ----------
        T_world_piece : ndarray, shape (4, 4)
            Where its origin is.
        T_world_camera : ndarray, shape (4, 4)
            By which pose that is known.
        covariance : ndarray, shape (6, 6)
            Of that pose, in the world and in the piece together.

        """
        keyframes = tuple(
            replace(k, T_world_camera=se3.orthonormalise(T_world_piece @ k.T_world_camera))
            for k in self.keyframes
        )
        T_camera_world = se3.inverse(T_world_camera)
        return replace(
            self,
            poses=tuple(
                StampedPose(p.stamp_ns, se3.orthonormalise(T_world_piece @ p.T_world_camera))
                for p in self.poses
            ),
            keyframes=keyframes,
            covariances=tuple(
                chained(covariance, T_camera_world @ keyframe.T_world_camera, own)
                for keyframe, own in zip(keyframes, self.covariances, strict=True)
            ),
        )

    def entrance(self) -> ModelView:
        """Return its last keyframe as a view to start from."""
        frame = self.keyframes[-1].frame
        return ModelView(
            frame.stamp_ns,
            self.keyframes[-1].T_world_camera,
            frame.camera,
            frame.color,
            frame.depth_m,
            self.keyframes[-1].p_dynamic,
        )


@dataclass
class _Followed:
    """For how long a camera was followed, and how much of its view stood still."""

    seconds: float = 0.0
    _last_ns: int | None = None
    _still: float = 0.0
    _frames: int = 0

    def note(self, frame: RgbdFrame, result: TrackingResult) -> None:
        if self._last_ns is not None:
            step_s = (frame.stamp_ns - self._last_ns) * 1e-9
            self.seconds += step_s if step_s < _LONGEST_STEP_S else 0.0
        self._last_ns = frame.stamp_ns
        still = thinned(result.p_dynamic) < DYNAMIC_THRESHOLD
        self._still += float((still & (thinned(frame.depth_m) > 0)).mean())
        self._frames += 1

    @property
    def still(self) -> float:
        return self._still / max(self._frames, 1)


@dataclass
class _World:
    """What is remembered of the map that the camera was lost in."""

    seen: _Followed = field(default_factory=_Followed)
    is_known: bool = False
    """It was there before: nothing takes its place."""
    last_ns: int | None = None
    """When the camera was last known in it, or looked for first."""


class Explorer:
    """
    Follows a lost camera in a piece of map of its own.

    Parameters
    ----------
    config : TrackingConfig
        As for tracking; `piece` says how long to wait.

    """

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config.piece
        self._tracker = CameraTracker(config)
        self.reset()

    def reset(self, is_known: bool = False) -> None:
        """Forget everything; `is_known` tells of a world that was there before."""
        self._world = _World(is_known=is_known)
        self._give_up()

    def _give_up(self) -> None:
        self._tracker.reset()
        self._piece = Piece()
        self._seen = _Followed()
        self._last_ns = 0  # when the camera was last known in the piece

    @property
    def length_s(self) -> float:
        """For how long the camera has been followed in the piece; 0 where there is none."""
        return self._seen.seconds

    @property
    def keyframe_ns(self) -> int:
        """Stamp of the newest keyframe of the piece; 0 where there is none."""
        return self._piece.keyframes[-1].frame.stamp_ns if self._piece.keyframes else 0

    def follow(
        self, frame: RgbdFrame, labels: Labels | None, result: TrackingResult
    ) -> Piece | None:
        """
        Take a frame, and what tracking made of it.

        Parameters
        ----------
        frame : RgbdFrame
            Newer than the last one.
        labels : Labels, optional
            Its dynamic prior.
        result : TrackingResult
            Of the same frame.

        Returns
        -------
        piece : Piece or None
            In the world, where that has just been found out; or, with `is_new_world`, what the
            world is from now on.

        """
        if not self._config.enabled:
            return None
        if result.status is TrackingStatus.OK:
            return self._on_found(frame, labels, result)
        world = self._world
        world.last_ns = frame.stamp_ns if world.last_ns is None else world.last_ns
        if (frame.stamp_ns - world.last_ns) * 1e-9 < self._config.patience_s:
            return None
        self._track(frame, labels)
        if not self._outlives():
            return None
        _log.warning(
            'a world that was seen for %.1f s is given up for one that was for %.1f s',
            world.seen.seconds,
            self._seen.seconds,
        )
        piece = replace(self._piece, is_new_world=True)
        self._world = _World(seen=self._seen)
        self._give_up()
        return piece

    def _on_found(
        self, frame: RgbdFrame, labels: Labels | None, result: TrackingResult
    ) -> Piece | None:
        """Note that the world is seen; join the piece if there is one."""
        self._world.seen.note(frame, result)
        self._world.last_ns = frame.stamp_ns
        if not self._piece.poses:
            return None
        own = self._track(frame, labels)
        piece = self._piece
        self._give_up()
        if own is None:
            _log.warning('where the piece of map is cannot be told; %d poses', len(piece.poses))
            return None
        T_world_piece = result.T_world_camera @ se3.inverse(own.T_world_camera)
        _log.warning(
            'a piece of map is joined: %d poses, %d keyframes',
            len(piece.poses),
            len(piece.keyframes),
        )
        both = result.covariance + own.covariance
        before = replace(piece, poses=piece.poses[:-1])  # this frame has its pose already
        if before.keyframes and before.keyframes[-1].frame.stamp_ns == frame.stamp_ns:
            before = replace(
                before, keyframes=before.keyframes[:-1], covariances=before.covariances[:-1]
            )
        return before.placed(T_world_piece, result.T_world_camera, both)

    def _track(self, frame: RgbdFrame, labels: Labels | None) -> TrackingResult | None:
        """Follow the camera in the piece; where that is lost as well, another one begins."""
        result = self._tracker.process(frame, labels)
        self._tracker.rest()
        if result.status is TrackingStatus.OK:
            self._piece = self._piece.with_frame(frame, result, self._config.keyframes)
            self._seen.note(frame, result)
            self._last_ns = frame.stamp_ns
            return result
        if (frame.stamp_ns - self._last_ns) * 1e-9 >= self._config.patience_s:
            self._give_up()
        return None

    def _outlives(self) -> bool:
        """Return whether the piece is more of a world than what was seen before."""
        world, config = self._world, self._config
        if world.is_known or world.seen.seconds > config.young_s:
            return False
        is_doubtful = world.seen.seconds < config.least_s or world.seen.still < config.still
        least_s = max(world.seen.seconds, config.least_s)
        return is_doubtful and self._seen.seconds > least_s and self._seen.still >= config.still
