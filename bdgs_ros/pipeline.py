"""The whole method without ROS: the same stage objects that the nodes run."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.errors import MapError
from bdgs_ros.core.types import Keyframe, Labels, Pose, RgbdFrame, TrackingResult
from bdgs_ros.detection.detector import Detector, LateDetector
from bdgs_ros.detection.stage import DetectionStage
from bdgs_ros.mapping.mapper import Mapper
from bdgs_ros.tracking.camera_tracker import CameraTracker

_LEAST_SEEN = 0.1  # of the view; with less there is nothing to align to


@dataclass(frozen=True)
class FrameResult:
    """What came out of one frame."""

    labels: Labels
    tracking: TrackingResult


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
        self.mapper = Mapper(config.mapping, config.belief)
        self._map_width = config.mapping.width

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
        self.mapper.history.begin_run()
        self.mapper.frozen = localise
        rectified = camera.rectified()
        small = rectified.scaled(min(1.0, self._map_width / camera.width))
        view = self.mapper.view(0, start, small)
        seen = float((view.depth_m > 0).mean())
        if seen < _LEAST_SEEN:
            position = ', '.join(f'{x:.2f}' for x in start[:3, 3])
            raise MapError(
                f"'{map_file}' covers {100 * seen:.0f} % of the view from the start pose at "
                f'({position}) m; give another start pose'
            )
        self.tracker.start_from(view, self.mapper.photographs())

    def process(self, frame: RgbdFrame) -> FrameResult:
        """Take the next frame: who moves, where is the camera, what does the world look like."""
        labels = self.detection.process(frame)
        tracking = self.tracker.process(frame, labels)
        if tracking.is_keyframe:
            keyframe = Keyframe(frame, tracking.T_world_camera, labels.p_dynamic)
            self.tracker.set_model(self.mapper.process(keyframe))
        return FrameResult(labels, tracking)

    def reset(self) -> None:
        """Forget everything."""
        self.detection.reset()
        self.tracker.reset()
        self.mapper.reset()
