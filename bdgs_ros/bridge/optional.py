"""Publishers of message types that the pip wheels of ROS lack: silent where they are missing."""

from __future__ import annotations

from importlib import import_module
from typing import Any

from geometry_msgs.msg import PoseStamped, TransformStamped, Vector3
from rclpy.node import Node
from std_msgs.msg import Header

from bdgs_ros.bridge import topics
from bdgs_ros.core.types import Labels


def _messages(node: Node, package: str, consequence: str) -> Any | None:
    """Import a package's messages, or say once what will be missing."""
    try:
        return import_module(f'{package}.msg')
    except ImportError:
        node.get_logger().info(f'{package} is not installed: {consequence}')
        return None


class TransformPublisher:
    """`map` to camera on /tf."""

    def __init__(self, node: Node, enabled: bool) -> None:
        self._types = _messages(node, 'tf2_msgs', 'no tf, use bdgs/pose') if enabled else None
        if self._types is not None:
            self._publisher = node.create_publisher(
                self._types.TFMessage, topics.TF, topics.RELIABLE
            )

    def publish(self, pose: PoseStamped, child_frame: str) -> None:
        """Publish a camera pose as a transform."""
        if self._types is None:
            return
        transform = TransformStamped(header=pose.header, child_frame_id=child_frame)
        position = pose.pose.position
        transform.transform.translation = Vector3(x=position.x, y=position.y, z=position.z)
        transform.transform.rotation = pose.pose.orientation
        self._publisher.publish(self._types.TFMessage(transforms=[transform]))


class DetectionsPublisher:
    """The detector's boxes for people to look at."""

    def __init__(self, node: Node) -> None:
        self._types = _messages(node, 'vision_msgs', f'no {topics.DETECTIONS}')
        if self._types is not None:
            self._publisher = node.create_publisher(
                self._types.Detection2DArray, topics.DETECTIONS, topics.RELIABLE
            )

    def publish(self, labels: Labels, head: Header) -> None:
        """Publish the boxes of one image."""
        if self._types is None or not self._publisher.get_subscription_count():
            return
        message = self._types.Detection2DArray(header=head)
        for detection in labels.detections:
            message.detections.append(self._box(detection, head))
        self._publisher.publish(message)

    def _box(self, detection: Any, head: Header) -> Any:
        assert self._types is not None
        left, top, right, bottom = detection.box_xyxy
        box = self._types.Detection2D(header=head)
        box.bbox.center.position.x = (left + right) / 2
        box.bbox.center.position.y = (top + bottom) / 2
        box.bbox.size_x = right - left
        box.bbox.size_y = bottom - top
        hypothesis = self._types.ObjectHypothesisWithPose()
        hypothesis.hypothesis.class_id = detection.class_name
        hypothesis.hypothesis.score = float(detection.score)
        box.results.append(hypothesis)
        return box
