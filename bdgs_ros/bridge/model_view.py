"""The feedback from mapping to tracking: a `ModelView` as three images of one stamp."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image

from bdgs_ros.bridge import conversions, topics
from bdgs_ros.bridge.stamped import Assembler
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import ModelView, Pose

_TOPICS = (topics.MODEL_IMAGE, topics.MODEL_DEPTH, topics.MODEL_DYNAMIC)

ModelImages = dict[str, Image]


class ModelPublisher:
    """Publish model views; an empty image says that a keyframe has none."""

    def __init__(self, node: Node) -> None:
        self._publishers = {
            topic: node.create_publisher(Image, topic, topics.RELIABLE) for topic in _TOPICS
        }

    def publish(self, stamp_ns: int, view: ModelView | None) -> None:
        """Answer the keyframe of a stamp."""
        head = conversions.header(stamp_ns, '')
        if view is None:
            images = dict.fromkeys(_TOPICS, Image(header=head))
        else:
            images = {
                topics.MODEL_IMAGE: conversions.color_to_message(view.color, head),
                topics.MODEL_DEPTH: conversions.depth_to_message(view.depth_m, head),
                topics.MODEL_DYNAMIC: conversions.probability_to_message(view.p_dynamic, head),
            }
        for topic, image in images.items():
            self._publishers[topic].publish(image)


class ModelSubscription:
    """
    Collect the three images of each stamp.

    Parameters
    ----------
    node : Node
        It subscribes.
    on_model : callable
        Called with the stamp and the images, in the executor's thread.

    """

    def __init__(self, node: Node, on_model: Callable[[int, ModelImages], None]) -> None:
        self._on_model = on_model
        self._assembler: Assembler[Image] = Assembler(_TOPICS)
        for topic in _TOPICS:
            node.create_subscription(
                Image,
                topic,
                lambda message, topic=topic: self._on_image(topic, message),
                topics.RELIABLE,
            )

    def _on_image(self, topic: str, message: Image) -> None:
        stamp_ns = conversions.stamp_ns(message)
        complete = self._assembler.add(stamp_ns, topic, message)
        if complete is not None:
            self._on_model(stamp_ns, complete)


def decode_model(
    stamp_ns: int, images: ModelImages, T_world_camera: Pose, camera: PinholeCamera
) -> ModelView | None:
    """
    Turn the three images into a view, None if they are empty.

    Parameters
    ----------
    stamp_ns : int
        Of the keyframe.
    images : dict of str to Image
        By topic.
    T_world_camera : ndarray, shape (4, 4)
        Pose of the keyframe.
    camera : PinholeCamera
        Of the full image; the view is that image scaled.

    Raises
    ------
    DatasetError
        If an image has another encoding than mapping publishes.

    """
    image = images[topics.MODEL_IMAGE]
    if not image.width:
        return None
    scaled = camera
    if image.width != camera.width:
        scaled = camera.scaled(image.width / camera.width)
    return ModelView(
        stamp_ns,
        T_world_camera,
        scaled,
        conversions.color_from_message(image, topics.MODEL_IMAGE),
        conversions.depth_from_message(images[topics.MODEL_DEPTH], topics.MODEL_DEPTH).astype(
            np.float32, copy=False
        ),
        conversions.probability_from_message(images[topics.MODEL_DYNAMIC], topics.MODEL_DYNAMIC),
    )
