"""Publish what tracking found: pose, odometry, path, tf and keyframes."""

from __future__ import annotations

import time
from functools import partial
from typing import BinaryIO

from geometry_msgs.msg import PoseStamped, Vector3
from nav_msgs.msg import Odometry, Path
from rclpy.node import Node
from sensor_msgs.msg import Image

from bdgs_ros.bridge import conversions, topics
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.node_config import TrackingNodeConfig
from bdgs_ros.bridge.optional import TransformPublisher
from bdgs_ros.core import se3
from bdgs_ros.core.types import Pose, StampedPose, TrackingResult, Trajectory
from bdgs_ros.journal.folder import poses_file, use
from bdgs_ros.journal.poses import PoseJournal, read_told
from bdgs_ros.tracking.piece import Piece

_PATH_POSES = 2000
_POLL_S = 0.02
_NOWHERE = 'piece'  # a frame that nobody knows the place of


class PoseOutput:
    """
    The trajectory so far, and its topics.

    Parameters
    ----------
    node : Node
        It publishes.
    config : TrackingNodeConfig
        Frame ids and periods; the journal.
    health : Health
        Gets what is wrong with the journal.

    Raises
    ------
    JournalError
        If the trajectory shall go on with a journal that is none.

    """

    def __init__(self, node: Node, config: TrackingNodeConfig, health: Health) -> None:
        self._config = config
        self._poses: list[StampedPose] = []
        self._previous: StampedPose | None = None  # none after a restart
        self._used: BinaryIO | None = None
        self._journal = self._begin_journal(health)
        self._path_sent_s = 0.0
        self._pose = node.create_publisher(PoseStamped, topics.POSE, topics.RELIABLE)
        self._odometry = node.create_publisher(Odometry, topics.ODOMETRY, topics.RELIABLE)
        self._path = node.create_publisher(Path, topics.PATH, topics.LATCHED)
        self._keyframe = node.create_publisher(PoseStamped, topics.KEYFRAME, topics.RELIABLE)
        self._moving = node.create_publisher(Image, topics.KEYFRAME_MOVING, topics.RELIABLE)
        self._piece = node.create_publisher(Path, topics.PIECE, topics.RELIABLE)
        self._piece_keyframe = node.create_publisher(
            PoseStamped, topics.PIECE_KEYFRAME, topics.RELIABLE
        )
        self._move = node.create_publisher(PoseStamped, topics.MOVE, topics.RELIABLE)
        self._transform = TransformPublisher(node, config.publish_tf)

    def _begin_journal(self, health: Health) -> PoseJournal | None:
        """Go on with the poses of the journal, if that is wanted, and write to it from now on."""
        folder = self._config.journal_folder
        if folder is None:
            return None
        self._used = use(folder)
        if self._config.resume:
            self._poses = read_told(poses_file(folder)).poses
        return PoseJournal(
            poses_file(folder),
            round(1e6 * self._config.journal.limit_mb),
            partial(health.set_problem, 'journal'),
            keep=self._config.resume,
        )

    @property
    def trajectory(self) -> Trajectory:
        """The poses published so far."""
        return Trajectory(tuple(self._poses))

    @property
    def newest_ns(self) -> int:
        """Stamp of the last pose; 0 before the first."""
        return self._poses[-1].stamp_ns if self._poses else 0

    def clear(self) -> None:
        """Forget the trajectory."""
        self._poses, self._previous = [], None
        if self._journal is not None:
            self._journal.restart()

    def close(self) -> None:
        """Have the last poses written."""
        if self._journal is not None:
            self._journal.close()
        if self._used is not None:
            self._used.close()

    def publish_move(self, stamp_ns: int, T_new_old: Pose) -> None:
        """Say that the poses from a frame on are in a world that has moved."""
        if self._journal is not None:
            self._journal.note_move(stamp_ns, T_new_old)
        self._move.publish(conversions.motion_stamped(T_new_old, stamp_ns, self._config.map_frame))

    def publish_piece_keyframe(self, stamp_ns: int) -> None:
        """Have the images of a frame kept: the camera is lost, and it is a keyframe of a piece."""
        self._piece_keyframe.publish(conversions.pose_stamped(se3.identity(), stamp_ns, _NOWHERE))

    def publish_piece(self, piece: Piece) -> None:
        """Say where the camera was while it was lost."""
        frame = self._config.map_frame
        if self._journal is not None:
            self._journal.note_piece(piece.poses)
        self._piece.publish(conversions.path_message(piece.poses, piece.poses[-1].stamp_ns, frame))

    def wait_for_mapping(self, patience_s: float) -> None:
        """Wait until somebody listens to keyframes: discovery may be under way."""
        deadline = time.monotonic() + patience_s
        while not self._keyframe.get_subscription_count() and time.monotonic() < deadline:
            time.sleep(_POLL_S)

    def publish(self, result: TrackingResult, image_frame: str) -> None:
        """Publish the pose of a frame that was tracked."""
        child = self._config.camera_frame or image_frame
        previous, self._previous = (
            self._previous,
            StampedPose(result.stamp_ns, result.T_world_camera),
        )
        self._poses.append(self._previous)
        if self._journal is not None:
            self._journal.note_pose(result.stamp_ns, result.T_world_camera)
        pose = conversions.pose_stamped(
            result.T_world_camera, result.stamp_ns, self._config.map_frame
        )
        self._pose.publish(pose)
        if result.is_keyframe:
            if result.p_moving is not None:  # before the keyframe, which mapping waits for
                self._moving.publish(
                    conversions.probability_to_message(result.p_moving, pose.header)
                )
            self._keyframe.publish(pose)
        self._transform.publish(pose, child)
        self._publish_odometry(result, pose, child, previous)
        self._publish_path()

    def _publish_odometry(
        self, result: TrackingResult, pose: PoseStamped, child: str, previous: StampedPose | None
    ) -> None:
        message = Odometry(header=pose.header, child_frame_id=child)
        message.pose.pose = pose.pose
        message.pose.covariance = conversions.pose_covariance_to_message(
            result.covariance, result.T_world_camera
        )
        if previous is not None:
            seconds = (result.stamp_ns - previous.stamp_ns) * 1e-9
            step = se3.inverse(previous.T_world_camera) @ result.T_world_camera
            velocity = se3.log(step) / seconds
            x, y, z, rx, ry, rz = (float(value) for value in velocity)
            message.twist.twist.linear = Vector3(x=x, y=y, z=z)
            message.twist.twist.angular = Vector3(x=rx, y=ry, z=rz)
            # the difference of two poses, each with its own error
            message.twist.covariance = (2 * result.covariance / seconds**2).reshape(-1)
        self._odometry.publish(message)

    def _publish_path(self) -> None:
        now = time.monotonic()
        due = now - self._path_sent_s >= self._config.path_period_s
        if not due or not self._path.get_subscription_count():
            return
        self._path_sent_s = now
        stride = max(1, len(self._poses) // _PATH_POSES)
        chosen = self._poses[::stride]
        frame = self._config.map_frame
        self._path.publish(conversions.path_message(chosen, chosen[-1].stamp_ns, frame))
