"""The whole method without ROS: the same stage objects that the nodes run."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.back_end.back_end import BackEnd
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.images import fitted, halved
from bdgs_ros.core.types import (
    Keyframe,
    Labels,
    ModelView,
    Pose,
    RgbdFrame,
    TrackingResult,
    TrackingStatus,
)
from bdgs_ros.detection.detector import Detector, LateDetector
from bdgs_ros.detection.stage import DetectionStage
from bdgs_ros.mapping.entrance import check_entrance, entrance
from bdgs_ros.mapping.mapper import Mapper
from bdgs_ros.tracking.camera_tracker import CameraTracker
from bdgs_ros.tracking.piece import Explorer, Piece
from bdgs_ros.tracking.registration import RegistrationWatch
from bdgs_ros.tracking.shutter import straightened


@dataclass(frozen=True)
class FrameResult:
    """What came out of one frame."""

    labels: Labels
    tracking: TrackingResult
    gave_up: bool = False
    """All poses before this frame are in a world that is no more."""


class BdgsSlam:
    """
    Bayesian dynamic Gaussian-splatting SLAM, section 3 of the paper.

    Parameters
    ----------
    config : BdgsConfig
        All parameters.
    detector : Detector or LateDetector, optional
        Used instead of the one that the configuration names.

    """

    def __init__(
        self, config: BdgsConfig, detector: Detector | LateDetector | None = None
    ) -> None:
        self.detection = DetectionStage(config.detection, detector)
        self.tracker = CameraTracker(config.tracking)
        self.explorer = Explorer(config.tracking)
        self.registration = RegistrationWatch(config.tracking.registration)
        self.mapper = Mapper(config.mapping, config.belief)
        self.back_end = BackEnd(config.back_end)
        self._width, self._map_width = config.camera.width, config.mapping.width

    def start_from(
        self,
        map_file: Path,
        camera: PinholeCamera,
        T_world_camera: Pose | None = None,
        *,
        localise: bool = False,
    ) -> None:
        """
        Continue from a saved map instead of making a new one.

        Parameters
        ----------
        map_file : Path
            `map.ply`; keyframes beside it are used too.
        camera : PinholeCamera
            Of the frames to come.
        T_world_camera : ndarray, shape (4, 4), optional
            About where the camera starts, in the world of the map; by default its origin. It may
            be anywhere if the map was saved with its keyframes.
        localise : bool
            Leave the map as it is.

        Raises
        ------
        MapError
            If the map cannot be read, or shows nothing from there.

        """
        start = se3.identity() if T_world_camera is None else T_world_camera
        self.reset()
        self.mapper.load(map_file)
        self.back_end.start_from(self.mapper.readout_s)
        self.mapper.history.begin_run()
        self.mapper.frozen = localise
        view = entrance(self.mapper, start, camera.rectified(), self._map_width)
        check_entrance(view, map_file)
        self.tracker.start_from(view, self.mapper.photographs())
        self.explorer.reset(is_known=True)

    def process(self, frame: RgbdFrame) -> FrameResult:
        """Take the next frame: who moves, where is the camera, what does the world look like."""
        labels = self.detection.process(frame)
        self.registration.add(frame)
        moved = self.tracker.take_move()
        if moved is not None:
            self.mapper.history.note_move(frame.stamp_ns, moved)
        frame = halved(frame, self._width)
        fitting = fitted(labels, frame)
        tracking = self.tracker.process(frame, fitting)
        self.tracker.rest()
        piece = self.explorer.follow(frame, fitting, tracking)
        if piece is not None:
            self._take_piece(piece)
        if tracking.status is TrackingStatus.OK:
            self.back_end.observe(frame.stamp_ns, tracking.T_world_camera)
        if tracking.is_keyframe:
            p_dynamic = fitting.p_dynamic
            if tracking.p_moving is not None:
                p_dynamic = np.maximum(p_dynamic, tracking.p_moving)
            keyframe = Keyframe(frame, tracking.T_world_camera, p_dynamic)
            self.tracker.set_model(take_keyframe(self.back_end, self.mapper, keyframe))
            self.tracker.note_keyframes(self.mapper.keyframe_poses())
        return FrameResult(labels, tracking, piece is not None and piece.is_new_world)

    def _take_piece(self, piece: Piece) -> None:
        """Make a piece of map that was seen while the camera was lost a part of the world."""
        if piece.is_new_world:
            self.back_end.reset()
            self.mapper.reset()
            self.tracker.start_from(piece.entrance())
        self.tracker.learn(piece.keyframes, piece.covariances)
        self.mapper.history.join(piece.poses)
        if not self.mapper.frozen:
            for keyframe in piece.keyframes:
                take_keyframe(self.back_end, self.mapper, keyframe)
            self.tracker.note_keyframes(self.mapper.keyframe_poses())

    def reset(self) -> None:
        """Forget everything."""
        self.back_end.reset()
        self.detection.reset()
        self.tracker.reset()
        self.explorer.reset()
        self.registration.reset()
        self.mapper.reset()


def take_keyframe(back_end: BackEnd, mapper: Mapper, keyframe: Keyframe) -> ModelView | None:
    """
    Make a keyframe agree with the earlier ones, then take it into the map.

    Parameters
    ----------
    back_end, mapper : BackEnd, Mapper
        They are changed.
    keyframe : Keyframe
        As tracking gave it.

    Returns
    -------
    view : ModelView or None
        See `Mapper.process`. Its pose has the corrections, and tracking follows it.

    """
    if not mapper.grows:
        return mapper.process(keyframe)
    adjustment = adjust(back_end, keyframe, mapper.keyframe_poses())
    adjustment.apply(mapper)
    return mapper.process(adjustment.ready(keyframe, mapper))


@dataclass(frozen=True)
class Adjustment:
    """What the back end says when a keyframe comes."""

    stamp_ns: int
    tracked: Pose
    """`T_world_camera` of the keyframe as tracking gave it."""
    transforms: dict[int, Pose]
    """See `BackEnd.process`."""
    readout_s: float
    sweep: NDArray[np.float64]
    """Motion while the keyframe was read out, (rho, phi) in its frame, [6]."""

    def moved(self, poses: Mapping[int, Pose]) -> dict[int, Pose]:
        """Return poses of keyframes by stamp after this, the new one with them."""
        return {
            stamp_ns: self.transforms[stamp_ns] @ pose if stamp_ns in self.transforms else pose
            for stamp_ns, pose in {**poses, self.stamp_ns: self.tracked}.items()
        }

    def apply(self, mapper: Mapper) -> None:
        """Move the map and the keyframes; the new one is not in the map yet."""
        mapper.announce(self.stamp_ns, self.tracked)
        mapper.correct_poses(self.transforms)
        mapper.readout_s = self.readout_s

    def ready(self, keyframe: Keyframe, mapper: Mapper) -> Keyframe:
        """Return the new keyframe where it is now, as a global shutter had seen it."""
        pose = mapper.keyframe_poses()[self.stamp_ns]
        frame, p_dynamic = straightened(keyframe.frame, keyframe.p_dynamic, self.sweep)
        return Keyframe(frame, pose, p_dynamic)


def adjust(
    back_end: BackEnd,
    keyframe: Keyframe,
    poses: Mapping[int, Pose],
    T_placed_tracked: Pose | None = None,
) -> Adjustment:
    """
    Ask the back end about a keyframe newer than all others, which are at `poses` now.

    `T_placed_tracked` moves it there from the world that tracking was in, if that is another.
    """
    stamp_ns = keyframe.frame.stamp_ns
    if T_placed_tracked is None:
        transforms = back_end.process(keyframe, poses)
    else:
        T_world_camera = T_placed_tracked @ keyframe.T_world_camera
        transforms = back_end.process(replace(keyframe, T_world_camera=T_world_camera), poses)
        T_new_placed = transforms.get(stamp_ns, se3.identity())
        transforms = {**transforms, stamp_ns: T_new_placed @ T_placed_tracked}
    sweep = back_end.sweep(stamp_ns)
    return Adjustment(stamp_ns, keyframe.T_world_camera, transforms, back_end.readout_s, sweep)
