"""Where the camera went over the last second: what the geometric prior needs to compare frames."""

from __future__ import annotations

from typing import Protocol

from bdgs_ros.core.types import Pose, ProbabilityImage, RgbdFrame


class EgoMotion(Protocol):
    """Camera poses that are right relative to each other over a second or so."""

    def update(self, frame: RgbdFrame, p_dynamic: ProbabilityImage) -> Pose | None:
        """
        Take the next frame; return `T_odom_camera`, or None when the motion is not known.

        After None the odometry frame starts anew: earlier poses must be dropped.
        """

    def reset(self) -> None:
        """Start anew."""
