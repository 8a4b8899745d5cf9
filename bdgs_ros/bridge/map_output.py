"""Publish what the map looks like: rendered where the camera is, and as a point cloud."""

from __future__ import annotations

import time
from collections import deque

import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2
from std_msgs.msg import Header

from bdgs_ros.bridge import conversions, topics
from bdgs_ros.bridge.cloud import cloud_from_map
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.node_config import MappingNodeConfig
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import Pose
from bdgs_ros.mapping.mapper import Mapper

_SEEN = 0.5
"""Silhouette below which the map knows nothing."""
_WAITING = 1000
"""Poses that may wait to be rendered in lockstep."""


class MapOutput:
    """
    Renders and clouds, only while somebody listens.

    A map that grows is rendered at the latest pose, no faster than asked for. A frozen one, when
    mapping has nothing else to do, is rendered at every pose: in lockstep at each, in real time
    always at the newest, and those left out are counted.

    Parameters
    ----------
    node : Node
        It publishes.
    config : MappingNodeConfig
        Rates and frame ids.
    health : Health
        Gets counts and times.

    """

    def __init__(self, node: Node, config: MappingNodeConfig, health: Health) -> None:
        self._node = node
        self._config = config
        self._health = health
        self._image = node.create_publisher(Image, topics.RENDERED_IMAGE, topics.RELIABLE)
        self._depth = node.create_publisher(Image, topics.RENDERED_DEPTH, topics.RELIABLE)
        self._dynamic = node.create_publisher(Image, topics.DYNAMIC_PROBABILITY, topics.RELIABLE)
        self._map = node.create_publisher(PointCloud2, topics.MAP, topics.LATCHED)
        self._poses: deque[PoseStamped] = deque(maxlen=_WAITING if config.lockstep else 1)
        self._camera: tuple[PinholeCamera, str] | None = None
        self._rendered_s = -np.inf
        self._mapped_s = -np.inf
        self._map_version = -1

    def see_through(self, camera: PinholeCamera, frame_id: str) -> None:
        """Render with the camera of the images, at the size asked for, from now on."""
        width = min(self._config.render_width, self._config.mapping.width, camera.width)
        self._camera = camera.scaled(width / camera.width), frame_id

    def note_pose(self, message: PoseStamped, *, frozen: bool) -> None:
        """Take a pose to render at."""
        full = len(self._poses) == self._poses.maxlen
        self._health.counts['renders_left_out'] += frozen and full and self._is_wanted()
        self._poses.append(message)

    def forget(self) -> None:
        """Render at none of the poses that wait."""
        self._poses.clear()

    def render(self, mapper: Mapper) -> bool:
        """Publish static map and posterior from a pose that is due; return if more are."""
        if not (self._is_wanted() and len(mapper.map)):
            self._poses.clear()
            return False
        now = time.monotonic()
        due = mapper.frozen or now - self._rendered_s >= 1.0 / self._config.render_rate
        if not (due and self._poses and self._camera):
            return False
        message = self._poses.popleft() if mapper.frozen else self._poses.pop()
        if not mapper.frozen:
            self._poses.clear()
        self._rendered_s = now
        with self._health.timed('render'):
            self._publish(mapper, message)
        return mapper.frozen and bool(self._poses)

    def _is_wanted(self) -> bool:
        publishers = (self._image, self._depth, self._dynamic)
        listened = any(publisher.get_subscription_count() for publisher in publishers)
        return listened and self._config.render_rate > 0

    def _publish(self, mapper: Mapper, message: PoseStamped) -> None:
        assert self._camera is not None
        camera, frame_id = self._camera
        T_world_camera = conversions.pose_from_message(message.pose)
        head = conversions.header(conversions.stamp_ns(message), frame_id)
        rendered = mapper.render(T_world_camera, camera)
        color = np.clip(rendered.color * 255 + 0.5, 0, 255).astype(np.uint8)
        known = rendered.silhouette > _SEEN
        depth_m = np.where(known, rendered.depth / np.maximum(rendered.silhouette, _SEEN), 0)
        self._image.publish(conversions.color_to_message(color, head))
        self._depth.publish(conversions.depth_to_message(depth_m.astype(np.float32), head))
        if self._dynamic.get_subscription_count():
            self._publish_dynamic(mapper, T_world_camera, camera, head)

    def _publish_dynamic(
        self, mapper: Mapper, T_world_camera: Pose, camera: PinholeCamera, head: Header
    ) -> None:
        everything = mapper.render_everything(T_world_camera, camera)
        posterior = everything.p_dynamic / np.maximum(everything.silhouette, 1e-6)
        posterior = np.where(everything.silhouette > _SEEN, posterior, 0)
        image = np.clip(posterior * 255 + 0.5, 0, 255).astype(np.uint8)
        self._dynamic.publish(conversions.probability_to_message(image, head))

    def publish_map(self, mapper: Mapper, version: int, margin: float) -> None:
        """Publish the cloud, if the map has changed and it is time."""
        now = time.monotonic()
        due = version != self._map_version and now - self._mapped_s >= self._config.map_period_s
        if not due or not self._map.get_subscription_count():
            return
        self._mapped_s, self._map_version = now, version
        head = conversions.header(0, self._config.map_frame)
        head.stamp = self._node.get_clock().now().to_msg()
        self._map.publish(cloud_from_map(mapper.map, margin, head))
