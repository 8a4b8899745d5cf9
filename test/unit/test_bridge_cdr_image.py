"""Images read from their bytes are those that rclpy makes of them."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')

from rclpy.serialization import serialize_message
from sensor_msgs.msg import Image

from bdgs_ros.bridge import conversions
from bdgs_ros.bridge.cdr_image import image_from_cdr
from bdgs_ros.core.errors import DatasetError


def message(frame_id: str) -> Image:
    pixels = np.random.default_rng(0).integers(0, 255, (3, 5, 3), np.uint8)
    return conversions.color_to_message(
        pixels, conversions.header(1_700_000_003_000_000_007, frame_id)
    )


@pytest.mark.parametrize('frame_id', ['', 'a', 'cam', 'camera_color_optical_frame', 'öä'])
def test_fields_and_pixels(frame_id: str) -> None:
    sent = message(frame_id)
    image = image_from_cdr(bytes(serialize_message(sent)))
    for name in ('height', 'width', 'encoding', 'is_bigendian', 'step'):
        assert getattr(image, name) == getattr(sent, name)
    assert conversions.stamp_ns(image) == conversions.stamp_ns(sent)
    assert image.header.frame_id == frame_id
    assert (
        conversions.color_from_message(image, 't') == conversions.color_from_message(sent, 't')
    ).all()


def test_the_other_byte_order() -> None:
    from rosbags.typesys import Stores, get_typestore

    store = get_typestore(Stores.ROS2_JAZZY)
    sent = store.deserialize_cdr(bytes(serialize_message(message('cam'))), 'sensor_msgs/msg/Image')
    big = bytes(store.serialize_cdr(sent, 'sensor_msgs/msg/Image', little_endian=False))
    image = image_from_cdr(big)
    assert (image.width, image.height, image.encoding) == (5, 3, 'rgb8')
    assert bytes(image.data) == bytes(sent.data)


@pytest.mark.parametrize('length', [0, 3, 10, 30, 60])
def test_a_cut_message_is_refused(length: int) -> None:
    data = bytes(serialize_message(message('cam')))[:length]
    with pytest.raises(DatasetError, match=f'{length} bytes is no sensor_msgs/Image'):
        image_from_cdr(data)
