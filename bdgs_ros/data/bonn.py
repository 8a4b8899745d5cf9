"""
The BONN RGB-D Dynamic dataset: TUM layout, one camera, ground truth of a marker body.

Palazzolo et al., "ReFusion: 3D Reconstruction in Dynamic Environments for RGB-D Cameras
Exploiting Residuals", IROS 2019.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import Pose, StampedPose, Trajectory
from bdgs_ros.data.camera_file import RecordedCamera
from bdgs_ros.data.tum import DEPTH_SCALE, FolderRecording, read_ground_truth

CAMERA = RecordedCamera(
    PinholeCamera(
        640,
        480,
        542.822841,
        542.576870,
        315.593520,
        237.756098,
        (0.039903, -0.099343, -0.000730, -0.000144, 0.0),
    ),
    DEPTH_SCALE,
)
_MARKER_CAMERA_QUAT_XYZW = np.array([-0.1287, 0.8866, -0.4396, 0.0634])


class BonnGroundTruth:
    """
    Turn the poses of the marker body into poses of the camera.

    `T_world_camera = T_world_marker * C` with a rotation `C` that was fitted by reprojecting
    static depth. The lever arm, about a centimetre, is not known well enough to be corrected, so
    positions stay as published: the figures of others are for those positions.
    """

    def __init__(self) -> None:
        self.T_marker_camera: Pose = se3.from_position_quat_xyzw(
            np.zeros(3), _MARKER_CAMERA_QUAT_XYZW
        )

    def correct(self, T_world_marker: Trajectory) -> Trajectory:
        """Return the trajectory of the camera, positions unchanged."""
        return Trajectory(
            tuple(
                StampedPose(pose.stamp_ns, pose.T_world_camera @ self.T_marker_camera)
                for pose in T_world_marker.poses
            )
        )


def open_bonn(folder: Path, camera: RecordedCamera = CAMERA) -> FolderRecording:
    """Open a BONN sequence."""
    marker = read_ground_truth(folder)
    corrected = None if marker is None else BonnGroundTruth().correct(marker)
    return FolderRecording(folder, camera, ground_truth=corrected)
