"""
ROS messages to core types and back.

Images and cameras are decoded by `data.messages`, which the offline reader of bags uses too: the
live graph and the offline run cannot see different pixels.

Poses change their frame here and nowhere else. Core has `world`, the optical frame of the first
camera; topics have `map` with x forward, y left, z up (REP 103), as a level first camera sees it.
"""

from __future__ import annotations

import sys
from collections.abc import Iterable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import Point, PoseStamped, Quaternion
from geometry_msgs.msg import Pose as PoseMsg
from nav_msgs.msg import Path
from numpy.typing import NDArray
from sensor_msgs.msg import Image
from std_msgs.msg import Header

from bdgs_ros.bridge.cdr_image import CdrImage
from bdgs_ros.core import se3
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import ColorImage, DepthImage, Pose, ProbabilityImage, StampedPose
from bdgs_ros.data.messages import (
    camera_from_message,
    color_from_message,
    depth_from_message,
    stamp_ns,
)
from bdgs_ros.data.trajectory_io import NS_PER_S

__all__ = [
    'camera_from_message',
    'color_from_message',
    'color_to_message',
    'depth_from_message',
    'depth_to_message',
    'header',
    'pose_covariance_to_message',
    'pose_from_message',
    'pose_stamped',
    'pose_to_message',
    'probability_from_message',
    'probability_to_message',
    'stamp_ns',
    'time_message',
]

_R_MAP_WORLD = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
T_MAP_WORLD: Pose = se3.from_rotation_translation(_R_MAP_WORLD, np.zeros(3))
"""Axes of `map` (x forward, y left, z up) against those of the first optical frame."""
T_WORLD_MAP: Pose = se3.inverse(T_MAP_WORLD)


def time_message(at_ns: int) -> Time:
    """Turn nanoseconds into a stamp."""
    seconds, nanoseconds = divmod(at_ns, NS_PER_S)
    return Time(sec=seconds, nanosec=nanoseconds)


def header(at_ns: int, frame_id: str) -> Header:
    """Make a header."""
    return Header(stamp=time_message(at_ns), frame_id=frame_id)


def color_to_message(color: ColorImage, head: Header) -> Image:
    """Encode colour, shape (H, W, 3), as rgb8."""
    return _image(color, 'rgb8', head)


def depth_to_message(depth_m: DepthImage, head: Header) -> Image:
    """Encode depth in metres, shape (H, W), as 32FC1; 0 stays 0."""
    return _image(depth_m, '32FC1', head)


def probability_to_message(p_dynamic: ProbabilityImage, head: Header) -> Image:
    """Encode P(dynamic) x 255, shape (H, W), as mono8."""
    return _image(p_dynamic, 'mono8', head)


def _image(array: NDArray[Any], encoding: str, head: Header) -> Image:
    height, width = array.shape[:2]
    message = Image(
        header=head,
        height=height,
        width=width,
        encoding=encoding,
        is_bigendian=int(sys.byteorder == 'big'),
        step=array.nbytes // height if height else 0,
    )
    message.data = np.ascontiguousarray(array).tobytes()
    return message


def probability_from_message(message: Image | CdrImage, topic: str) -> ProbabilityImage:
    """
    Decode a mono8 image of P(dynamic) x 255.

    Raises
    ------
    DatasetError
        If the image has another encoding.

    """
    if message.encoding not in ('mono8', '8UC1'):
        raise DatasetError(
            f"topic '{topic}': expected probabilities encoded as mono8, "
            f"received '{message.encoding}'"
        )
    rows = np.frombuffer(memoryview(message.data), np.uint8)
    rows = rows[: message.height * message.step].reshape(message.height, message.step)
    return np.ascontiguousarray(rows[:, : message.width])


def pose_to_message(T_world_camera: Pose) -> PoseMsg:
    """Turn a camera pose in core's world into a message in `map`."""
    position, quat_xyzw = se3.to_position_quat_xyzw(T_MAP_WORLD @ T_world_camera)
    x, y, z, w = (float(value) for value in quat_xyzw)
    return PoseMsg(
        position=Point(x=float(position[0]), y=float(position[1]), z=float(position[2])),
        orientation=Quaternion(x=x, y=y, z=z, w=w),
    )


def pose_from_message(pose: PoseMsg) -> Pose:
    """Turn a message in `map` into a camera pose in core's world, shape (4, 4)."""
    position = np.array([pose.position.x, pose.position.y, pose.position.z])
    rotation = pose.orientation
    quat_xyzw = np.array([rotation.x, rotation.y, rotation.z, rotation.w])
    return np.asarray(T_WORLD_MAP @ se3.from_position_quat_xyzw(position, quat_xyzw))


def pose_stamped(T_world_camera: Pose, at_ns: int, map_frame: str) -> PoseStamped:
    """Stamp a camera pose."""
    return PoseStamped(header=header(at_ns, map_frame), pose=pose_to_message(T_world_camera))


def motion_stamped(T_new_old: Pose, at_ns: int, map_frame: str) -> PoseStamped:
    """Stamp a motion of core's world, as one of `map`."""
    return pose_stamped(T_new_old @ T_WORLD_MAP, at_ns, map_frame)


def motion_from_message(message: PoseStamped) -> Pose:
    """Undo `motion_stamped`."""
    return np.asarray(pose_from_message(message.pose) @ T_MAP_WORLD)


def path_message(poses: Iterable[StampedPose], at_ns: int, map_frame: str) -> Path:
    """Join stamped camera poses to a path."""
    path = Path(header=header(at_ns, map_frame))
    path.poses = [pose_stamped(p.T_world_camera, p.stamp_ns, map_frame) for p in poses]
    return path


def poses_from_path(message: Path) -> dict[int, Pose]:
    """Return `T_world_camera` by stamp (ns)."""
    return {stamp_ns(pose): pose_from_message(pose.pose) for pose in message.poses}


def pose_covariance_to_message(
    covariance_camera: NDArray[np.float64], T_world_camera: Pose
) -> NDArray[np.float64]:
    """
    Turn a covariance in the camera's tangent into one along the axes of `map`.

    Parameters
    ----------
    covariance_camera : ndarray, shape (6, 6)
        Of (x y z, rotation vector) in the camera frame, in m^2 and rad^2.
    T_world_camera : ndarray, shape (4, 4)
        The pose it belongs to.

    Returns
    -------
    covariance : ndarray, shape (36,)
        Row-major, as PoseWithCovariance wants it.

    """
    rotation = _R_MAP_WORLD @ T_world_camera[:3, :3]
    turn = np.zeros((6, 6))
    turn[:3, :3] = rotation
    turn[3:, 3:] = rotation
    return np.asarray(turn @ covariance_camera @ turn.T).reshape(-1)
