"""
Ground truth in the ROS 1 bags of TUM and OpenLORIS, where it is spread over tf.

TUM: `/tf` moves `/kinect` in `/world`, and carries the chain from `/kinect` to the camera.
OpenLORIS: `/gt` moves `base_link` in `gt_map`, as tf messages (PoseStamped is accepted as well),
and `/tf_static` carries the chain from `base_link` to `d400_color`.
"""

from __future__ import annotations

import logging
from typing import Any

from bdgs_ros.core.types import Pose, StampedPose, Trajectory
from bdgs_ros.data.bag import BagReader
from bdgs_ros.data.frame_tree import FrameTree, clean
from bdgs_ros.data.messages import pose_from_message, pose_from_transform, stamp_ns

_LOGGER = logging.getLogger(__name__)


def tum_ground_truth(reader: BagReader, camera_frame: str) -> Trajectory | None:
    """Follow `world -> kinect -> ... -> camera` in `/tf`."""
    return _follow(reader, moving=('/tf',), fixed=('/tf', '/tf_static'),
                   body='kinect', parent='world', camera_frame=camera_frame)  # fmt: skip


def openloris_ground_truth(reader: BagReader, camera_frame: str) -> Trajectory | None:
    """Follow `gt_map -> base_link` in `/gt`, then `/tf_static` to the camera."""
    return _follow(reader, moving=('/gt',), fixed=('/tf_static',),
                   body='base_link', parent=None, camera_frame=camera_frame)  # fmt: skip


def _follow(
    reader: BagReader,
    moving: tuple[str, ...],
    fixed: tuple[str, ...],
    body: str,
    parent: str | None,
    camera_frame: str,
) -> Trajectory | None:
    tree = FrameTree()
    poses: dict[int, Pose] = {}
    for raw, message in reader.messages([t for t in {*moving, *fixed} if t in reader.topics]):
        for at_ns, frame, child, T_frame_child in _edges(message, body):
            is_body = child == body and parent in (None, frame)
            if is_body and raw.topic in moving:
                poses.setdefault(at_ns, T_frame_child)
            elif raw.topic in fixed:
                tree.add(frame, child, T_frame_child)
    if not poses:
        return None
    T_body_camera = tree.lookup(body, camera_frame)
    if T_body_camera is None:
        _LOGGER.warning(
            "'%s': ground truth left out, no chain of transforms from '%s' to '%s'; found %s",
            reader.path, body, camera_frame, tree.describe(),
        )  # fmt: skip
        return None
    return Trajectory(
        tuple(StampedPose(at_ns, poses[at_ns] @ T_body_camera) for at_ns in sorted(poses))
    )


def _edges(message: Any, body: str) -> list[tuple[int, str, str, Pose]]:
    """Return (stamp, parent, child, T_parent_child) of a tf message or a PoseStamped."""
    if hasattr(message, 'pose'):
        pose = pose_from_message(message.pose)
        return [(stamp_ns(message), clean(message.header.frame_id), body, pose)]
    return [
        (
            stamp_ns(edge),
            clean(edge.header.frame_id),
            clean(edge.child_frame_id),
            pose_from_transform(edge.transform),
        )
        for edge in message.transforms
    ]
