"""Which poses the map is rendered at: the newest now and then while it grows, each when frozen."""

from __future__ import annotations

from collections import Counter
from contextlib import nullcontext
from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')

from bdgs_ros.bridge import conversions, topics
from bdgs_ros.bridge.map_output import MapOutput
from bdgs_ros.bridge.node_config import MappingNodeConfig
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera

CAMERA = PinholeCamera(640, 480, 500.0, 500.0, 319.5, 239.5)


class Publisher:
    def __init__(self):
        self.listeners = 1
        self.sent = []

    def get_subscription_count(self):
        return self.listeners

    def publish(self, message):
        self.sent.append(message)


class FakeNode:
    def __init__(self):
        self.publishers = {}

    def create_publisher(self, kind, topic, qos):
        return self.publishers.setdefault(topic, Publisher())


class FakeMapper:
    """Paints the depth of the camera's own position along z."""

    def __init__(self, frozen):
        self.frozen, self.map = frozen, [0]

    def render(self, T_world_camera, camera):
        ones = np.ones(camera.shape, np.float32)
        return SimpleNamespace(
            color=np.dstack([0.5 * ones] * 3),
            depth=T_world_camera[2, 3] * ones,
            silhouette=ones,
            p_dynamic=0.25 * ones,
        )

    render_everything = render


def rig(**changes):
    node, counts = FakeNode(), Counter()
    health = SimpleNamespace(counts=counts, timed=lambda name: nullcontext())
    output = MapOutput(node, replace(MappingNodeConfig(), **changes), health)
    output.see_through(CAMERA, 'camera')
    return node, counts, output


def feed(output, frozen, count=5):
    for k in range(count):
        pose = se3.identity()
        pose[2, 3] = 1.0 + k
        output.note_pose(conversions.pose_stamped(pose, 100 + k, 'map'), frozen=frozen)


def drain(output, mapper):
    calls = 1
    while output.render(mapper):
        calls += 1
    return calls


def stamps(node, topic=topics.RENDERED_IMAGE):
    return [conversions.stamp_ns(message) for message in node.publishers[topic].sent]


def test_lockstep_shows_a_frozen_map_from_every_pose():
    node, counts, output = rig(mode='lockstep')
    feed(output, frozen=True)
    assert drain(output, FakeMapper(frozen=True)) == 5
    for topic in (topics.RENDERED_IMAGE, topics.RENDERED_DEPTH, topics.DYNAMIC_PROBABILITY):
        assert stamps(node, topic) == [100, 101, 102, 103, 104]
    depths = [
        conversions.depth_from_message(message, 'd')[0, 0]
        for message in node.publishers[topics.RENDERED_DEPTH].sent
    ]
    assert depths == pytest.approx([1, 2, 3, 4, 5])
    assert counts['renders_left_out'] == 0
    image = node.publishers[topics.RENDERED_IMAGE].sent[0]
    assert (image.width, image.height, image.header.frame_id) == (320, 240, 'camera')


def test_real_time_shows_a_frozen_map_from_the_newest_pose_and_counts_the_others():
    node, counts, output = rig(mode='realtime')
    feed(output, frozen=True)
    drain(output, FakeMapper(frozen=True))
    assert stamps(node) == [104]
    assert counts['renders_left_out'] == 4


def test_a_map_that_grows_is_shown_at_its_rate():
    node, counts, output = rig(mode='lockstep', render_rate=0.01)
    mapper = FakeMapper(frozen=False)
    for _ in range(2):
        feed(output, frozen=False)
        assert drain(output, mapper) == 1
    assert stamps(node) == [104]
    assert counts['renders_left_out'] == 0


@pytest.mark.parametrize('rate', [0.0, 5.0])
def test_nothing_is_rendered_for_nobody(rate):
    node, counts, output = rig(render_rate=rate)
    for publisher in node.publishers.values():
        publisher.listeners = int(rate == 0)
    feed(output, frozen=True)
    drain(output, FakeMapper(frozen=True))
    assert stamps(node) == []
    assert counts['renders_left_out'] == 0


def test_poses_wait_until_the_camera_is_known():
    node, _, output = rig(mode='lockstep')
    output._camera = None
    feed(output, frozen=True)
    assert not output.render(FakeMapper(frozen=True))
    output.see_through(CAMERA, 'camera')
    drain(output, FakeMapper(frozen=True))
    assert len(stamps(node)) == 5
