"""The whole method without ROS: the same stage objects that the nodes run."""

from __future__ import annotations

from dataclasses import dataclass

from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.types import Keyframe, Labels, RgbdFrame, TrackingResult
from bdgs_ros.detection.stage import DetectionStage
from bdgs_ros.mapping.mapper import Mapper
from bdgs_ros.tracking.camera_tracker import CameraTracker


@dataclass(frozen=True)
class FrameResult:
    """What came out of one frame."""

    labels: Labels
    tracking: TrackingResult


class BdgsSlam:
    """Bayesian dynamic Gaussian-splatting SLAM, section 3 of the paper."""

    def __init__(self, config: BdgsConfig) -> None:
        self.detection = DetectionStage(config.detection)
        self.tracker = CameraTracker(config.tracking)
        self.mapper = Mapper(config.mapping, config.belief)

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
