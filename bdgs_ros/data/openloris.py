"""
OpenLORIS-Scene folders: `color.txt`, `aligned_depth.txt`, `sensors.yaml`, `trans_matrix.yaml`.

Shi et al., "Are We Ready for Service Robots? The OpenLORIS-Scene Datasets for Lifelong SLAM",
ICRA 2020. Ground truth is the pose of the robot's `base_link`; the camera is a RealSense D435i.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import Pose, StampedPose, Trajectory
from bdgs_ros.data.camera_file import RecordedCamera
from bdgs_ros.data.frame_tree import FrameTree
from bdgs_ros.data.tum import FolderRecording, read_ground_truth

CAMERA_FRAME = 'd400_color_optical_frame'
BASE_FRAME = 'base_link'
DEPTH_SCALE = 1000.0
SENSORS_FILE = 'sensors.yaml'
_TRANSFORMS_FILE = 'trans_matrix.yaml'


def open_openloris(folder: Path, camera: RecordedCamera | None = None) -> FolderRecording:
    """Open an OpenLORIS sequence with the D435i's colour and aligned depth."""
    base = read_ground_truth(folder)
    truth = None
    if base is not None:
        truth = body_to_camera(base, read_base_to_camera(folder / _TRANSFORMS_FILE))
    return FolderRecording(
        folder,
        camera or read_sensors(folder / SENSORS_FILE),
        color_list='color.txt',
        depth_list='aligned_depth.txt',
        ground_truth=truth,
    )


def body_to_camera(T_world_body: Trajectory, T_body_camera: Pose) -> Trajectory:
    """Return the trajectory of a camera that is fixed to a body."""
    return Trajectory(
        tuple(
            StampedPose(pose.stamp_ns, pose.T_world_camera @ T_body_camera)
            for pose in T_world_body.poses
        )
    )


def read_sensors(path: Path) -> RecordedCamera:
    """Read the colour camera from `sensors.yaml`; its intrinsics are in the order fx cx fy cy."""
    storage = _open(path)
    try:
        section = storage.getNode(CAMERA_FRAME)
        fx, cx, fy, cy = _matrix(path, section, 'intrinsics', 4)
        width, height = (int(section.getNode(key).real()) for key in ('width', 'height'))
        distortion = (0.0,) * 5
        if not section.getNode('distortion_coefficients').empty():
            k1, k2, p1, p2, k3 = _matrix(path, section, 'distortion_coefficients', 5)
            distortion = (k1, k2, p1, p2, k3)
    finally:
        storage.release()
    return RecordedCamera(PinholeCamera(width, height, fx, fy, cx, cy, distortion), DEPTH_SCALE)


def read_base_to_camera(path: Path) -> Pose:
    """Read `T_base_camera` from the tree of transforms in `trans_matrix.yaml`."""
    storage = _open(path)
    try:
        tree = FrameTree()
        rows = storage.getNode('trans_matrix')
        for index in range(rows.size()):
            row = rows.at(index)
            tree.add(
                row.getNode('parent_frame').string(),
                row.getNode('child_frame').string(),
                np.array(_matrix(path, row, 'matrix', 16)).reshape(4, 4),
            )
    finally:
        storage.release()
    T_base_camera = tree.lookup(BASE_FRAME, CAMERA_FRAME)
    if T_base_camera is None:
        raise DatasetError(
            f"'{path}' has no chain of transforms from '{BASE_FRAME}' to '{CAMERA_FRAME}'; "
            f'it knows {tree.describe()}'
        )
    return T_base_camera


def _open(path: Path) -> Any:
    try:
        storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_READ)
        if path.is_file() and storage.isOpened():
            return storage
        reason = 'it is missing or empty'
    except (cv2.error, SystemError) as error:  # OpenCV 5 raises the second for bad yaml
        reason = str(error)
    raise DatasetError(f"cannot read the OpenLORIS calibration '{path}': {reason}")


def _matrix(path: Path, node: Any, key: str, size: int) -> list[float]:
    value = None if node.empty() or node.getNode(key).empty() else node.getNode(key).mat()
    if value is None or value.size != size:
        found = 'nothing' if value is None else f'{value.size} numbers'
        raise DatasetError(
            f"'{path}': expected {size} numbers under '{key}' of '{CAMERA_FRAME}' or a "
            f'transform, found {found}'
        )
    return [float(number) for number in np.asarray(value).reshape(-1)]
