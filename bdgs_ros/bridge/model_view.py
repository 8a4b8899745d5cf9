"""The feedback from mapping to tracking: a `ModelView` as messages of one stamp."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
from builtin_interfaces.msg import Time
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import Image, TimeReference
from std_msgs.msg import Header

from bdgs_ros.bridge import conversions, topics
from bdgs_ros.bridge.stamped import Assembler
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import ModelView
from bdgs_ros.data.trajectory_io import seconds_to_ns

_NS_PER_S = 1_000_000_000
_IMAGES = (topics.MODEL_IMAGE, topics.MODEL_DEPTH, topics.MODEL_DYNAMIC)
_TYPES: dict[str, Any] = {
    **dict.fromkeys(_IMAGES, Image),
    topics.MODEL_POSE: PoseStamped,
    topics.MODEL_READOUT: TimeReference,
}
_MEASURED = 'measured'

ModelMessages = dict[str, Any]
"""By topic: three Image, a PoseStamped, and a TimeReference: how long the shutter reads out."""


class ModelPublisher:
    """Publish model views; an empty image says that a keyframe has none."""

    def __init__(self, node: Node, map_frame: str) -> None:
        self._map_frame = map_frame
        self._publishers = {
            topic: node.create_publisher(kind, topic, topics.MODELS)
            for topic, kind in _TYPES.items()
        }

    def publish(self, stamp_ns: int, view: ModelView | None) -> None:
        """Answer the keyframe of a stamp."""
        head = conversions.header(stamp_ns, '')
        if view is None:
            messages = {topic: kind(header=head) for topic, kind in _TYPES.items()}
        else:
            pose = conversions.pose_stamped(view.T_world_camera, stamp_ns, self._map_frame)
            messages = {
                topics.MODEL_IMAGE: conversions.color_to_message(view.color, head),
                topics.MODEL_DEPTH: conversions.depth_to_message(view.depth_m, head),
                topics.MODEL_DYNAMIC: conversions.probability_to_message(view.p_dynamic, head),
                topics.MODEL_POSE: pose,
                topics.MODEL_READOUT: readout_to_message(view.readout_s, head),
            }
        for topic, message in messages.items():
            self._publishers[topic].publish(message)


class ModelSubscription:
    """
    Collect the messages of each stamp.

    Parameters
    ----------
    node : Node
        It subscribes.
    on_model : callable
        Called with the stamp and the messages, in the executor's thread.

    """

    def __init__(self, node: Node, on_model: Callable[[int, ModelMessages], None]) -> None:
        self._on_model = on_model
        self._assembler: Assembler[Any] = Assembler(tuple(_TYPES))
        for topic, kind in _TYPES.items():
            node.create_subscription(
                kind,
                topic,
                lambda message, topic=topic: self._on_message(topic, message),
                topics.MODELS,
            )

    def _on_message(self, topic: str, message: Any) -> None:
        stamp_ns = conversions.stamp_ns(message)
        complete = self._assembler.add(stamp_ns, topic, message)
        if complete is not None:
            self._on_model(stamp_ns, complete)


def decode_model(
    stamp_ns: int, messages: ModelMessages, camera: PinholeCamera
) -> ModelView | None:
    """
    Turn the messages into a view, None if they are empty.

    Parameters
    ----------
    stamp_ns : int
        Of the keyframe.
    messages : dict
        By topic.
    camera : PinholeCamera
        Of the full image; the view is that image scaled.

    Raises
    ------
    DatasetError
        If an image has another encoding than mapping publishes.

    """
    image = messages[topics.MODEL_IMAGE]
    if not image.width:
        return None
    scaled = camera
    if image.width != camera.width:
        scaled = camera.scaled(image.width / camera.width)
    return ModelView(
        stamp_ns,
        conversions.pose_from_message(messages[topics.MODEL_POSE].pose),
        scaled,
        conversions.color_from_message(image, topics.MODEL_IMAGE),
        conversions.depth_from_message(messages[topics.MODEL_DEPTH], topics.MODEL_DEPTH).astype(
            np.float32, copy=False
        ),
        conversions.probability_from_message(messages[topics.MODEL_DYNAMIC], topics.MODEL_DYNAMIC),
        readout_from_message(messages[topics.MODEL_READOUT]),
    )


def readout_to_message(readout_s: float | None, head: Header) -> TimeReference:
    """Return the time from first row to last; its `source` is empty while it is unknown."""
    if readout_s is None:
        return TimeReference(header=head)
    seconds, nanoseconds = divmod(seconds_to_ns(readout_s), _NS_PER_S)
    time_ref = Time(sec=seconds, nanosec=nanoseconds)
    return TimeReference(header=head, time_ref=time_ref, source=_MEASURED)


def readout_from_message(message: TimeReference) -> float | None:
    """Undo `readout_to_message`."""
    if message.source != _MEASURED:
        return None
    return float(message.time_ref.sec + 1e-9 * message.time_ref.nanosec)
