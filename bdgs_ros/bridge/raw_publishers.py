"""Publish serialised messages untouched; packed images of the camera unpacked."""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import Any

from rclpy.duration import Duration
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.qos import QoSProfile

from bdgs_ros.bridge import topics
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.bag_cursor import RawMessage
from bdgs_ros.data.bag_recording import TopicLayout
from bdgs_ros.data.messages import (
    COMPRESSED_IMAGE,
    IMAGE,
    unpacked_color,
    unpacked_depth,
)

Unpack = Callable[[bytes, str], bytes]


def message_class(msgtype: str) -> Any:
    """Return the class of a type name such as `sensor_msgs/msg/Image`; ImportError if unknown."""
    package, _, name = msgtype.split('/')
    try:
        return getattr(import_module(f'{package}.msg'), name)
    except AttributeError as error:
        raise ImportError(f'{package} has no message {name}') from error


class RawPublishers:
    """
    A publisher for every topic of a bag; the camera's topics get the names that the graph uses.

    Parameters
    ----------
    node : Node
        It publishes.
    bag_topics : dict of str to str
        Type name by topic.
    layout : TopicLayout
        Which of them are the camera's.
    qos : QoSProfile
        For all of them.

    """

    def __init__(
        self, node: Node, bag_topics: dict[str, str], layout: TopicLayout, qos: QoSProfile
    ) -> None:
        self._logger = node.get_logger()
        renamed = {
            layout.color: topics.COLOR,
            layout.depth: topics.DEPTH,
            layout.info: topics.COLOR_INFO,
        }
        self._publishers: dict[str, Publisher] = {}
        self._unpack: dict[str, Unpack] = {
            topic: unpack
            for topic, unpack in (
                (layout.color, unpacked_color),
                (layout.depth, unpacked_depth),
            )
            if bag_topics.get(topic) == COMPRESSED_IMAGE
        }
        for topic, msgtype in bag_topics.items():
            try:
                kind = message_class(IMAGE if topic in self._unpack else msgtype)
            except ImportError as error:
                node.get_logger().warning(f"'{topic}' is not replayed: {error}")
                continue
            name = renamed.get(topic, topic)
            self._publishers[topic] = node.create_publisher(kind, name, qos)
        if layout.info not in self._publishers:
            node.get_logger().warning(f"the bag has no camera_info on '{layout.info}'")
        self._camera = [
            self._publishers[t]
            for t in (layout.color, layout.depth, layout.info)
            if t in self._publishers
        ]

    def publish(self, message: RawMessage) -> None:
        """Send the bytes as they are, or the image that is packed in them, if it can be read."""
        publisher, unpack = (
            known.get(message.topic) for known in (self._publishers, self._unpack)
        )
        if publisher is None:
            return
        data = bytes(message.data)
        try:
            publisher.publish(data if unpack is None else unpack(data, message.topic))
        except DatasetError as error:
            self._logger.warning(f'an image is not replayed: {error}')

    def subscribers(self) -> int:
        """Return how many subscribers every camera topic has at least."""
        return min(int(publisher.get_subscription_count()) for publisher in self._camera)

    def wait_delivered(self, timeout_s: float) -> None:
        """Wait until reliable subscribers have everything."""
        for publisher in self._camera:
            publisher.wait_for_all_acked(Duration(seconds=timeout_s))
