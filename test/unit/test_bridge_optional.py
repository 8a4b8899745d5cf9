"""Messages that the pip wheels lack, with stand-ins for their packages."""

from __future__ import annotations

import sys
from types import ModuleType, SimpleNamespace
from typing import Any
from unittest.mock import MagicMock

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = pytest.mark.ros

from bdgs_ros.bridge import conversions, optional  # noqa: E402
from bdgs_ros.core.types import Detection, Labels  # noqa: E402

HEAD = conversions.header(5, 'camera')


def provide(monkeypatch: pytest.MonkeyPatch, package: str, **types: Any) -> None:
    module = ModuleType(f'{package}.msg')
    vars(module).update(types)
    monkeypatch.setitem(sys.modules, package, ModuleType(package))
    monkeypatch.setitem(sys.modules, f'{package}.msg', module)


def test_transform_is_the_pose(monkeypatch: pytest.MonkeyPatch) -> None:
    provide(monkeypatch, 'tf2_msgs', TFMessage=lambda transforms: SimpleNamespace(t=transforms))
    node = MagicMock()
    pose = np.eye(4)
    pose[2, 3] = 2.0
    publisher = optional.TransformPublisher(node, enabled=True)
    publisher.publish(conversions.pose_stamped(pose, 5, 'map'), 'camera')
    (message,) = node.create_publisher.return_value.publish.call_args.args
    (transform,) = message.t
    assert (transform.header.frame_id, transform.child_frame_id) == ('map', 'camera')
    assert transform.transform.translation.x == pytest.approx(2.0)


@pytest.mark.parametrize('package', ['tf2_msgs', 'vision_msgs'])
def test_without_the_package_one_line_is_logged(
    monkeypatch: pytest.MonkeyPatch, package: str
) -> None:
    monkeypatch.setitem(sys.modules, package, None)
    node = MagicMock()
    if package == 'tf2_msgs':
        publisher: Any = optional.TransformPublisher(node, enabled=True)
        publisher.publish(conversions.pose_stamped(np.eye(4), 5, 'map'), 'camera')
    else:
        publisher = optional.DetectionsPublisher(node)
        publisher.publish(Labels(5, np.zeros((2, 2), np.uint8)), HEAD)
    node.create_publisher.assert_not_called()
    (text,) = node.get_logger.return_value.info.call_args.args
    assert text.startswith(f'{package} is not installed')


def test_boxes_become_centres_and_sizes(monkeypatch: pytest.MonkeyPatch) -> None:
    provide(
        monkeypatch,
        'vision_msgs',
        Detection2DArray=lambda header: SimpleNamespace(header=header, detections=[]),
        Detection2D=lambda header: MagicMock(header=header, results=[]),
        ObjectHypothesisWithPose=MagicMock,
    )
    node = MagicMock()
    publisher = optional.DetectionsPublisher(node)
    found = Detection((10.0, 20.0, 30.0, 60.0), 0.9, 0, 'person', 0.95)
    publisher.publish(Labels(5, np.zeros((2, 2), np.uint8), (found,)), HEAD)
    (message,) = node.create_publisher.return_value.publish.call_args.args
    (box,) = message.detections
    assert (box.bbox.center.position.x, box.bbox.center.position.y) == (20.0, 40.0)
    assert (box.bbox.size_x, box.bbox.size_y) == (20.0, 40.0)
    assert box.results[0].hypothesis.class_id == 'person'
