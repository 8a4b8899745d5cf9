"""Messages to core types and back."""

from __future__ import annotations

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = pytest.mark.ros

from sensor_msgs.msg import CameraInfo, Image, TimeReference  # noqa: E402

from bdgs_ros.bridge import conversions, topics  # noqa: E402
from bdgs_ros.bridge.cloud import cloud_from_map  # noqa: E402
from bdgs_ros.bridge.frames import FrameDecoder, RawFrame  # noqa: E402
from bdgs_ros.bridge.model_view import decode_model, readout_from_message, readout_to_message  # noqa: E402
from bdgs_ros.bridge.status import (  # noqa: E402
    FrameState,
    FrameStatus,
    status_from_message,
    status_to_message,
)
from bdgs_ros.core import se3  # noqa: E402
from bdgs_ros.core.camera import PinholeCamera  # noqa: E402
from bdgs_ros.core.errors import DatasetError  # noqa: E402

HEAD = conversions.header(1_500_000_003, 'camera')


@pytest.fixture
def rng() -> np.random.Generator:
    return np.random.default_rng(3)


def test_stamps_keep_every_nanosecond() -> None:
    assert conversions.stamp_ns(Image(header=HEAD)) == 1_500_000_003


def test_images_come_back_bit_for_bit(rng: np.random.Generator) -> None:
    color = rng.integers(0, 256, (7, 5, 3), dtype=np.uint8)
    depth = rng.uniform(0, 5, (7, 5)).astype(np.float32)
    p_dynamic = rng.integers(0, 256, (7, 5), dtype=np.uint8)
    there = conversions.color_to_message(color, HEAD)
    assert np.array_equal(conversions.color_from_message(there, '/c'), color)
    there = conversions.depth_to_message(depth, HEAD)
    assert np.array_equal(conversions.depth_from_message(there, '/d'), depth)
    there = conversions.probability_to_message(p_dynamic, HEAD)
    assert np.array_equal(conversions.probability_from_message(there, '/p'), p_dynamic)


def padded(array: np.ndarray, encoding: str, padding: int, big: bool = False) -> Image:
    rows = array.reshape(array.shape[0], -1)
    data = rows.astype(rows.dtype.newbyteorder('>')) if big else rows
    raw = data.view(np.uint8).reshape(array.shape[0], -1)
    raw = np.hstack([raw, np.full((array.shape[0], padding), 99, np.uint8)])
    message = Image(
        header=HEAD,
        height=array.shape[0],
        width=array.shape[1],
        encoding=encoding,
        is_bigendian=int(big),
        step=raw.shape[1],
    )
    message.data = raw.tobytes()
    return message


@pytest.mark.parametrize('big', [False, True])
def test_depth_in_millimetres_with_padding_and_byte_order(
    rng: np.random.Generator, big: bool
) -> None:
    mm = rng.integers(0, 6000, (4, 6), dtype=np.uint16)
    decoded = conversions.depth_from_message(padded(mm, '16UC1', 5, big), '/d')
    assert decoded == pytest.approx(mm / 1000, abs=1e-6)


@pytest.mark.parametrize(
    ('encoding', 'order'),
    [('bgr8', [2, 1, 0]), ('rgba8', [0, 1, 2, 3]), ('bgra8', [2, 1, 0, 3]), ('rgb8', [0, 1, 2])],
)
def test_colour_orders(rng: np.random.Generator, encoding: str, order: list[int]) -> None:
    rgba = rng.integers(0, 256, (4, 6, 4), dtype=np.uint8)
    message = padded(np.ascontiguousarray(rgba[..., order]), encoding, 3)
    assert np.array_equal(conversions.color_from_message(message, '/c'), rgba[..., :3])


def test_grey_becomes_colour(rng: np.random.Generator) -> None:
    grey = rng.integers(0, 256, (4, 6), dtype=np.uint8)
    decoded = conversions.color_from_message(padded(grey, 'mono8', 0), '/c')
    assert np.array_equal(decoded, np.repeat(grey[..., None], 3, axis=2))


def test_depth_that_is_not_a_number_is_invalid() -> None:
    depth = np.array([[1.0, np.nan], [np.inf, -2.0]], np.float32)
    decoded = conversions.depth_from_message(padded(depth, '32FC1', 0), '/d')
    assert np.array_equal(decoded, np.array([[1.0, 0], [0, 0]], np.float32))


def test_an_unknown_encoding_is_named_with_its_topic() -> None:
    message = padded(np.zeros((2, 2), np.uint8), 'yuv422', 0)
    with pytest.raises(DatasetError, match=r"'/robot/color'.*expected.*rgb8.*'yuv422'"):
        conversions.color_from_message(message, '/robot/color')


def test_pose_round_trip_and_rep103_axes(rng: np.random.Generator) -> None:
    pose = se3.exp(rng.normal(size=6))
    back = conversions.pose_from_message(conversions.pose_to_message(pose))
    assert back == pytest.approx(pose, abs=1e-12)
    ahead = np.eye(4)
    ahead[2, 3] = 1.0  # forward along the optical axis
    ahead[1, 3] = 0.5  # down in the image
    position = conversions.pose_to_message(ahead).position
    assert (position.x, position.y, position.z) == pytest.approx((1.0, 0.0, -0.5))


def test_covariance_turns_with_the_axes() -> None:
    in_camera = np.diag([1.0, 2.0, 3.0, 4.0, 5.0, 6.0])  # right, down, forward
    in_map = conversions.pose_covariance_to_message(in_camera, np.eye(4)).reshape(6, 6)
    assert np.diag(in_map) == pytest.approx([3, 1, 2, 6, 4, 5])  # forward, left, up


def test_status_round_trip() -> None:
    status = FrameStatus(1_500_000_003, FrameState.LOST, True, 0.25, 0.5, 12.5, 30.25)
    assert status_from_message(status_to_message(status, 'camera')) == status


def info(width: int = 6, height: int = 4) -> CameraInfo:
    return CameraInfo(
        header=HEAD,
        width=width,
        height=height,
        k=[5.0, 0.0, 2.5, 0.0, 5.0, 1.5, 0.0, 0.0, 1.0],
        distortion_model='plumb_bob',
        d=[0.0] * 5,
    )


def raw(depth: np.ndarray, encoding: str, camera: CameraInfo | None = None) -> RawFrame:
    color = padded(np.full((4, 6, 3), 50, np.uint8), 'rgb8', 0)
    return RawFrame(1, color, padded(depth, encoding, 0), camera or info(), 0.0)


def test_a_frame_is_decoded() -> None:
    frame = FrameDecoder('/c', '/d', '/i').decode(raw(np.full((4, 6), 1500, np.uint16), '16UC1'))
    assert frame.depth_m == pytest.approx(np.full((4, 6), 1.5))
    assert frame.camera.fx == 5.0


@pytest.mark.parametrize('nothing', [0.0, np.nan])
def test_a_frame_without_depth_is_decoded_and_says_so(nothing: float) -> None:
    decoder = FrameDecoder('/c', '/d', '/i')
    frame = decoder.decode(raw(np.full((4, 6), nothing, np.float32), '32FC1'))
    assert not frame.depth_m.any()
    assert "'/d'" in decoder.lack_of_depth(frame)
    seen = decoder.decode(raw(np.ones((4, 6), np.float32), '32FC1'))
    assert decoder.lack_of_depth(seen) == ''


@pytest.mark.parametrize(
    ('depth', 'encoding', 'words'),
    [
        (np.ones((2, 3), np.float32), '32FC1', "'/d'.*expected.*6x4.*received 3x2"),
        (np.ones((4, 6), np.uint8), 'mono8', "'/d'.*expected.*16UC1.*received 'mono8'"),
        (np.full((4, 6), 1500, np.float32), '32FC1', "'/d'.*more than 30 m.*scale"),
        (np.full((4, 6), 2, np.uint16), '16UC1', "'/d'.*less than 0.02 m.*scale"),
    ],
)
def test_unusable_depth_is_refused_by_topic(depth: np.ndarray, encoding: str, words: str) -> None:
    with pytest.raises(DatasetError, match=words):
        FrameDecoder('/c', '/d', '/i').decode(raw(depth, encoding))


def test_an_uncalibrated_camera_is_refused() -> None:
    blank = CameraInfo(header=HEAD, width=6, height=4)
    with pytest.raises(DatasetError, match=r"'/i'.*not calibrated"):
        FrameDecoder('/c', '/d', '/i').decode(raw(np.ones((4, 6), np.float32), '32FC1', blank))


def test_model_view_round_trip(rng: np.random.Generator) -> None:
    color = rng.integers(0, 256, (2, 3, 3), dtype=np.uint8)
    depth = rng.uniform(0, 5, (2, 3)).astype(np.float32)
    p_dynamic = rng.integers(0, 256, (2, 3), dtype=np.uint8)
    pose = se3.exp(np.array([0.1, 0.2, -0.3, 0.3, 0.2, 0.1]))
    images = {
        topics.MODEL_IMAGE: conversions.color_to_message(color, HEAD),
        topics.MODEL_DEPTH: conversions.depth_to_message(depth, HEAD),
        topics.MODEL_DYNAMIC: conversions.probability_to_message(p_dynamic, HEAD),
        topics.MODEL_POSE: conversions.pose_stamped(pose, 7, 'map'),
        topics.MODEL_READOUT: readout_to_message(-0.0255, HEAD),
    }
    camera = PinholeCamera(6, 4, 5.0, 5.0, 2.5, 1.5)
    view = decode_model(7, images, camera)
    assert view is not None
    np.testing.assert_allclose(view.T_world_camera, pose, atol=1e-12)
    assert view.camera == camera.scaled(0.5)
    assert np.array_equal(view.color, color)
    assert np.array_equal(view.depth_m, depth)
    assert np.array_equal(view.p_dynamic, p_dynamic)
    assert view.readout_s == pytest.approx(-0.0255, abs=1e-9)


def test_an_unknown_readout_stays_unknown() -> None:
    assert readout_from_message(readout_to_message(None, HEAD)) is None
    assert readout_from_message(TimeReference(header=HEAD)) is None


def test_an_empty_model_image_means_no_model() -> None:
    images = dict.fromkeys(
        (topics.MODEL_IMAGE, topics.MODEL_DEPTH, topics.MODEL_DYNAMIC), Image(header=HEAD)
    )
    camera = PinholeCamera(6, 4, 5.0, 5.0, 2.5, 1.5)
    assert decode_model(7, images, camera) is None


class TinyMap:
    means = np.array([[0, 0, 2.0], [1, 0, 2], [0, 1, 2]], np.float32)
    colors = np.array([[1, 0, 0], [0, 1, 0], [0, 0, 1.0]], np.float32)
    log_scales = np.log(np.full((3, 3), 0.02, np.float32))
    logit_opacities = np.zeros(3, np.float32)
    p_dynamic = np.array([0.1, 0.5, 0.9], np.float32)

    def __len__(self) -> int:
        return 3


def test_map_cloud_has_every_field() -> None:
    cloud = cloud_from_map(TinyMap(), 0.1, HEAD)
    assert [f.name for f in cloud.fields] == [
        'x', 'y', 'z', 'rgb', 'opacity', 'scale', 'p_dynamic', 'label',
    ]  # fmt: skip
    rows = np.frombuffer(bytes(cloud.data), np.uint8).reshape(3, cloud.point_step)
    floats = np.ascontiguousarray(rows[:, :28]).view('<f4')
    assert floats[:, :3] == pytest.approx(np.array([[2, 0, 0], [2, -1, 0], [2, 0, -1.0]]))
    assert floats[:, 4:7] == pytest.approx(
        np.array([[0.5, 0.02, 0.1], [0.5, 0.02, 0.5], [0.5, 0.02, 0.9]]), rel=1e-5
    )
    assert rows[:, 28].tolist() == [0, 1, 2]
    packed = np.ascontiguousarray(floats[:, 3]).view(np.uint32)
    assert [hex(v) for v in packed] == ['0xff0000', '0xff00', '0xff']
