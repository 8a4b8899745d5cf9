"""Publish what the map looks like: rendered at the latest pose, and as a point cloud."""

from __future__ import annotations

import time
from dataclasses import dataclass

import numpy as np
from rclpy.node import Node
from sensor_msgs.msg import Image, PointCloud2

from bdgs_ros.bridge import conversions, topics
from bdgs_ros.bridge.cloud import cloud_from_map
from bdgs_ros.bridge.node_config import MappingNodeConfig
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import Pose
from bdgs_ros.mapping.mapper import Mapper

_SEEN = 0.5
"""Silhouette below which the map knows nothing."""


@dataclass(frozen=True)
class Viewpoint:
    """Where to render from."""

    stamp_ns: int
    T_world_camera: Pose
    camera: PinholeCamera
    frame_id: str


class MapOutput:
    """
    Renders and clouds, only while somebody listens and no faster than asked for.

    Parameters
    ----------
    node : Node
        It publishes.
    config : MappingNodeConfig
        Rates and frame ids.

    """

    def __init__(self, node: Node, config: MappingNodeConfig) -> None:
        self._node = node
        self._config = config
        self._image = node.create_publisher(Image, topics.RENDERED_IMAGE, topics.RELIABLE)
        self._depth = node.create_publisher(Image, topics.RENDERED_DEPTH, topics.RELIABLE)
        self._dynamic = node.create_publisher(Image, topics.DYNAMIC_PROBABILITY, topics.RELIABLE)
        self._map = node.create_publisher(PointCloud2, topics.MAP, topics.LATCHED)
        self._rendered_s = -np.inf
        self._rendered_ns: int | None = None
        self._mapped_s = -np.inf
        self._map_version = -1

    def render(self, mapper: Mapper, viewpoint: Viewpoint | None) -> None:
        """Publish the static map and the posterior as seen from a viewpoint, if it is time."""
        rate = self._config.render_rate
        if viewpoint is None or not rate or viewpoint.stamp_ns == self._rendered_ns:
            return
        now = time.monotonic()
        publishers = (self._image, self._depth, self._dynamic)
        wanted = any(publisher.get_subscription_count() for publisher in publishers)
        if not wanted or now - self._rendered_s < 1.0 / rate or not len(mapper.map):
            return
        self._rendered_s, self._rendered_ns = now, viewpoint.stamp_ns
        rendered = mapper.render(viewpoint.T_world_camera, viewpoint.camera)
        head = conversions.header(viewpoint.stamp_ns, viewpoint.frame_id)
        color = np.clip(rendered.color * 255 + 0.5, 0, 255).astype(np.uint8)
        known = rendered.silhouette > _SEEN
        depth_m = np.where(known, rendered.depth / np.maximum(rendered.silhouette, _SEEN), 0)
        self._image.publish(conversions.color_to_message(color, head))
        self._depth.publish(conversions.depth_to_message(depth_m.astype(np.float32), head))
        self._publish_dynamic(mapper, viewpoint)

    def _publish_dynamic(self, mapper: Mapper, viewpoint: Viewpoint) -> None:
        if not self._dynamic.get_subscription_count():
            return
        everything = mapper.render_everything(viewpoint.T_world_camera, viewpoint.camera)
        posterior = everything.p_dynamic / np.maximum(everything.silhouette, 1e-6)
        posterior = np.where(everything.silhouette > _SEEN, posterior, 0)
        image = np.clip(posterior * 255 + 0.5, 0, 255).astype(np.uint8)
        head = conversions.header(viewpoint.stamp_ns, viewpoint.frame_id)
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
