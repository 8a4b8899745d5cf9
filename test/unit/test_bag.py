"""Bags: whole, foreign and cut off, of ROS 2 and of ROS 1."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from data_recordings import (
    CAMERA_YAML,
    HEIGHT,
    START,
    WIDTH,
    Ros1Bag,
    color_image,
    color_ns,
    depth_units,
    pose,
    write_tum,
)
from rosbags.rosbag2 import StoragePlugin, Writer

from bdgs_ros.core import se3
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data import messages
from bdgs_ros.data.bag import header_stamp_ns, open_bag
from bdgs_ros.data.bag_recording import COLOR_TOPIC, DEPTH_TOPIC, BagSequence
from bdgs_ros.data.convert import ConvertOptions, convert
from bdgs_ros.data.layouts import open_sequence

SEQUENCE_TOPICS = ('/camera/color/camera_info', COLOR_TOPIC, DEPTH_TOPIC, '/ground_truth/pose')


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('bag')
    convert(write_tum(folder / 'walk', count=20), folder / 'walk_bag')
    return folder / 'walk_bag'


# ---- raw access


def test_topics_and_times(bag: Path) -> None:
    with open_bag(bag) as reader:
        assert reader.storage == 'mcap' and not reader.truncated
        assert sorted(reader.topics) == sorted(SEQUENCE_TOPICS)
        assert reader.topics[COLOR_TOPIC] == ('sensor_msgs/msg/Image', 20)
        assert reader.start_ns == START * 10**9
        assert reader.end_ns == START * 10**9 + color_ns(19) + 8_000_000
        assert reader.duration_s == pytest.approx(0.641, abs=0.001)


def test_raw_messages_come_in_order_and_untouched(bag: Path) -> None:
    with open_bag(bag) as reader:
        raw = list(reader.raw_messages())
        assert len(raw) == sum(info.count for info in reader.topics.values())
        assert [m.stamp_ns for m in raw] == sorted(m.stamp_ns for m in raw)
        first = next(m for m in raw if m.topic == COLOR_TOPIC)
        again = messages.serialize_image(
            first.stamp_ns, 'camera_color_optical_frame', color_image(0), 'rgb8'
        )
        assert isinstance(first.data, bytes) and first.data == again
        assert header_stamp_ns(first.data) == first.stamp_ns


def test_a_part_of_some_topics(bag: Path) -> None:
    with open_bag(bag) as reader:
        raw = list(reader.raw_messages([COLOR_TOPIC], start_s=0.1, duration_s=0.2))
        times = [(m.stamp_ns - reader.start_ns) / 1e9 for m in raw]
        assert len(times) == 6 and min(times) >= 0.1 and max(times) < 0.3
        assert not list(reader.raw_messages([COLOR_TOPIC], start_s=99))
        assert not list(reader.raw_messages([]))
        with pytest.raises(DatasetError, match=r'has no topic /nope; it has /camera/color/cam'):
            reader.raw_messages(['/nope'])


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
@pytest.mark.parametrize('compression', ['none', 'zstd'])
def test_frames_equal_those_of_the_folder(tmp_path: Path, storage: str, compression: str) -> None:
    folder = write_tum(tmp_path / 'walk', without_depth=(2,))
    options = ConvertOptions(storage=storage, compression=compression)
    convert(folder, tmp_path / 'bag', options)
    wanted, got = open_sequence(folder), BagSequence(tmp_path / 'bag')
    assert got.camera == wanted.camera and len(got) == len(wanted) == 5
    assert got.unpaired_color == (f'{COLOR_TOPIC}@1500000000.066666000',)
    for index, (one, other) in enumerate(zip(wanted, got, strict=True)):
        assert one.stamp_ns == other.stamp_ns and one.camera == other.camera
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)
        np.testing.assert_array_equal(got[index].color, other.color)
        np.testing.assert_array_equal(got[index].depth_m, other.depth_m)
    assert got.ground_truth is not None and wanted.ground_truth is not None
    np.testing.assert_allclose(got.ground_truth.matrices, wanted.ground_truth.matrices, atol=1e-12)


def test_depth_counts_as_the_camera_file_says(tmp_path: Path) -> None:
    """A camera that counts 0.1 mm: its file says so, and the bag cannot."""
    folder = write_tum(tmp_path / 'walk')
    convert(folder, tmp_path / 'bag', ConvertOptions(depth_encoding='16UC1'))
    usual = open_sequence(tmp_path / 'bag')[0].depth_m
    for line, times in (('', 1.0), ('  depth_scale: 10000', 0.1)):
        kept = [row for row in CAMERA_YAML.splitlines() if 'depth_scale' not in row]
        camera = tmp_path / 'camera.yaml'
        camera.write_text('\n'.join([*kept, line]) + '\n')
        found = open_sequence(tmp_path / 'bag', camera)[0].depth_m
        np.testing.assert_allclose(found, times * usual, rtol=1e-6)


def test_the_largest_count_is_no_depth() -> None:
    counts = np.array([[0, 1500], [65534, 65535]], np.uint16)
    decoded = messages.depth_from_message(image_message(counts, '16UC1'), '/d')
    np.testing.assert_allclose(decoded, [[0, 1.5], [65.534, 0]], rtol=1e-6)


def test_a_single_storage_file_opens_too(bag: Path) -> None:
    assert len(open_sequence(next(bag.glob('*.mcap')))) == 20


# ---- what is wrong with a bag


def _with_small_chunks(path: Path) -> Path:
    """Write a bag with a chunk for each message, as a live recorder flushes them."""
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    writer.open()
    connection = writer.add_connection(
        COLOR_TOPIC, messages.IMAGE, typestore=messages.jazzy()
    )  # fmt: skip
    image = np.zeros((600, 600, 3), np.uint8)  # above the megabyte at which a chunk is closed
    for index in range(6):
        data = messages.serialize_image(index * 10**9, 'camera', image, 'rgb8')
        writer.write(connection, index * 10**9, data)
    writer.close()
    return path


def test_a_cut_off_recording_is_read_only_if_asked_for(tmp_path: Path) -> None:
    whole = _with_small_chunks(tmp_path / 'whole')
    data = next(whole.glob('*.mcap')).read_bytes()
    cut = tmp_path / 'cut'
    cut.mkdir()
    (cut / 'cut_0.mcap').write_bytes(data[: len(data) * 6 // 10])
    with pytest.raises(DatasetError, match=r'cut.*metadata\.yaml.*--allow-truncated'):
        open_bag(cut)
    with pytest.raises(DatasetError, match=r'cut_0\.mcap.*cannot be read as a bag.*magic'):
        open_bag(cut / 'cut_0.mcap')
    for path in (cut, cut / 'cut_0.mcap'):
        with open_bag(path, allow_truncated=True) as reader:
            assert reader.truncated and reader.topics[COLOR_TOPIC].count == 3
            raw = list(reader.raw_messages())
            assert [m.stamp_ns for m in raw] == [0, 10**9, 2 * 10**9]
            index = reader.index([COLOR_TOPIC])[COLOR_TOPIC]
            assert reader.read(COLOR_TOPIC, index[1]) == raw[1].data


def test_allow_truncated_changes_nothing_for_a_whole_bag(bag: Path) -> None:
    with open_bag(bag, allow_truncated=True) as reader:
        assert not reader.truncated and reader.topics[COLOR_TOPIC].count == 20


@pytest.mark.parametrize('name', ['a.mcap', 'a.db3', 'a.bag'])
def test_foreign_bytes_are_refused(tmp_path: Path, name: str) -> None:
    path = tmp_path / name
    path.write_bytes(np.random.default_rng(0).bytes(5000))
    with pytest.raises(DatasetError, match=rf"{name}' cannot be read as a bag: .*; expected a"):
        open_bag(path)
    path.write_bytes(b'')
    with pytest.raises(DatasetError, match='cannot be read as a bag'):
        open_bag(path)


def test_no_bag_at_all(tmp_path: Path) -> None:
    with pytest.raises(DatasetError, match='there is no bag at'):
        open_bag(tmp_path / 'nothing')
    with pytest.raises(DatasetError, match='is not a bag; expected a rosbag2 folder'):
        open_bag(tmp_path)


def test_a_bag_without_images_lists_what_it_has(tmp_path: Path) -> None:
    writer = Writer(tmp_path / 'poses', version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        connection = writer.add_connection(
            '/odom_pose', messages.POSE_STAMPED, typestore=messages.jazzy()
        )
        writer.write(connection, 5, messages.serialize_pose(5, 'map', pose(1)))
    with pytest.raises(DatasetError, match='no known pair of colour and depth topics') as caught:
        BagSequence(tmp_path / 'poses')
    assert 'TUM: /camera/rgb/image_color and /camera/depth/image' in str(caught.value)
    assert 'found /odom_pose (geometry_msgs/msg/PoseStamped)' in str(caught.value)


def _image_bag(path: Path, depth: np.ndarray, encoding: str) -> Path:
    with Ros1Bag(path) as bag:
        bag.info('/camera/rgb/camera_info', 'cam')
        bag.image('/camera/rgb/image_color', 0, 'cam', color_image(0), 'bgr8', 0)
        bag.image('/camera/depth/image', 0, 'cam', depth, encoding, 0)
    return path


def test_depth_of_another_size_names_topic_expected_received(tmp_path: Path) -> None:
    path = _image_bag(tmp_path / 'a.bag', np.ones((10, 20), np.float32), '32FC1')
    with pytest.raises(DatasetError, match=r"'/camera/depth/image': expected images of shape "
                       r'\(24, 32\) as in .*, received \(10, 20\)'):  # fmt: skip
        BagSequence(path)[0]


def test_depth_of_another_encoding_names_topic_expected_received(tmp_path: Path) -> None:
    path = _image_bag(tmp_path / 'a.bag', np.ones((HEIGHT, WIDTH), np.float64), '64FC1')
    with pytest.raises(DatasetError, match="'/camera/depth/image': expected a depth image "
                       "encoded as 16UC1, mono16, 32FC1, received '64FC1'"):  # fmt: skip
        BagSequence(path)[0]


# ---- ROS 1 as published


def write_tum_bag(path: Path) -> Path:
    T_kinect_camera = se3.exp(np.array([0.01, 0.02, -0.03, 0.5, -0.4, 0.3]))
    T_camera_optical = se3.exp(np.array([0, -0.02, 0, -1.2, 1.2, -1.2]))
    with Ros1Bag(path) as bag:
        bag.info('/camera/rgb/camera_info', '/openni_rgb_optical_frame')
        for index in range(5):
            depth = depth_units(index).astype(np.float32) / np.float32(5000)
            depth[depth == 0] = np.nan
            frame = '/openni_rgb_optical_frame'
            at = color_ns(index)
            # tf/tfMessage was the type of the day; the moving edge comes with the fixed ones
            bag.transforms('/tf', 'tf/msg/tfMessage', at, [
                ('/world', '/kinect', pose(index)),
                ('/kinect', '/openni_camera', T_kinect_camera),
                ('/openni_camera', '/openni_rgb_optical_frame', T_camera_optical),
                ('/openni_camera', '/openni_depth_frame', np.eye(4)),
            ])  # fmt: skip
            # logged late, and depth before colour: the header's stamp is what counts
            bag.image('/camera/depth/image', at, frame, depth, '32FC1', 3_000_000)
            bag.image('/camera/rgb/image_color', at + 10_000_000, frame, color_image(index),
                      'rgb8', 2_000_000)  # fmt: skip
    return path


def test_a_tum_bag(tmp_path: Path) -> None:
    sequence = open_sequence(write_tum_bag(tmp_path / 'walk.bag'))
    assert sequence.name == 'walk' and len(sequence) == 5
    assert sequence.stamps_ns[1] == START * 10**9 + color_ns(1) + 10_000_000
    assert sequence.camera.distortion == (0.1, -0.05, 0.001, 0.002, 0.0)
    recording = sequence.recording
    np.testing.assert_array_equal(recording.read_color(3), color_image(3))
    expected = depth_units(3).astype(np.float32) / np.float32(5000)
    np.testing.assert_array_equal(recording.read_depth(3), expected)
    truth = sequence.ground_truth
    assert truth is not None and len(truth) == 5
    chain = se3.exp(np.array([0.01, 0.02, -0.03, 0.5, -0.4, 0.3])) @ se3.exp(
        np.array([0, -0.02, 0, -1.2, 1.2, -1.2])
    )
    np.testing.assert_allclose(truth.matrices[2], pose(2) @ chain, atol=1e-9)
    assert [f.stamp_ns for f in sequence] == sequence.stamps_ns.tolist()


def test_a_tum_bag_becomes_a_rosbag2_with_the_same_frames(tmp_path: Path) -> None:
    source = write_tum_bag(tmp_path / 'walk.bag')
    convert(source, tmp_path / 'bag')
    for one, other in zip(open_sequence(source), open_sequence(tmp_path / 'bag'), strict=True):
        np.testing.assert_array_equal(one.color, other.color)
        np.testing.assert_array_equal(one.depth_m, other.depth_m)


def test_a_tum_bag_has_the_camera_of_its_folder(tmp_path: Path) -> None:
    source = write_tum_bag(tmp_path / 'rgbd_dataset_freiburg2_x.bag')
    with pytest.raises(DatasetError, match=r'shape \(480, 640\)'):
        open_sequence(source)[0]


def write_openloris_bag(path: Path, static: bool = True) -> Path:
    T_base_color = se3.exp(np.array([0.3, 0.1, 1.2, -0.5, 0.4, 0.3]))
    with Ros1Bag(path) as bag:
        if static:
            edge = ('base_link', 'd400_color', T_base_color)
            bag.transforms('/tf_static', 'tf2_msgs/msg/TFMessage', 0, [edge])
        bag.info('/d400/color/camera_info', 'd400_color')
        for index in range(4):
            at, millimetres = color_ns(index), depth_units(index)
            topic = '/d400/aligned_depth_to_color/image_raw'
            bag.image('/d400/color/image_raw', at, 'd400_color', color_image(index), 'rgb8', 0)
            bag.image(topic, at, 'd400_color', millimetres, 'mono16', 0)
            edge = ('gt_map', 'base_link', pose(index))
            bag.transforms('/gt', 'tf2_msgs/msg/TFMessage', at, [edge])
    return path


def test_an_openloris_bag(tmp_path: Path) -> None:
    sequence = open_sequence(write_openloris_bag(tmp_path / 'cafe1-1.bag'))
    assert len(sequence) == 4 and sequence.camera.fx == 30
    expected = depth_units(2).astype(np.float32) / np.float32(1000)
    np.testing.assert_array_equal(sequence.recording.read_depth(2), expected)
    truth = sequence.ground_truth
    assert truth is not None
    T_base_color = se3.exp(np.array([0.3, 0.1, 1.2, -0.5, 0.4, 0.3]))
    np.testing.assert_allclose(truth.matrices[3], pose(3) @ T_base_color, atol=1e-9)


def test_ground_truth_is_left_out_where_the_camera_hangs_in_the_air(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    sequence = open_sequence(write_openloris_bag(tmp_path / 'cafe.bag', static=False))
    assert sequence.ground_truth is None
    assert "no chain of transforms from 'base_link' to 'd400_color'" in caplog.text


# ---- messages


def image_message(array: np.ndarray, encoding: str, **changes: object) -> SimpleNamespace:
    data = np.ascontiguousarray(array).view(np.uint8).reshape(-1)
    height, width = array.shape[:2]
    fields = {'height': height, 'width': width, 'encoding': encoding, 'is_bigendian': 0,
              'step': data.size // height, 'data': data}  # fmt: skip
    return SimpleNamespace(**{**fields, **changes})


@pytest.mark.parametrize(
    ('encoding', 'encode'),
    [
        ('rgb8', lambda rgb: rgb),
        ('bgr8', lambda rgb: rgb[..., ::-1]),
        ('rgba8', lambda rgb: np.concatenate([rgb, rgb[..., :1]], axis=2)),
        ('bgra8', lambda rgb: np.concatenate([rgb[..., ::-1], rgb[..., :1]], axis=2)),
    ],
)
def test_colour_encodings(encoding: str, encode: Callable[[np.ndarray], np.ndarray]) -> None:
    rgb = color_image(7)
    message = image_message(encode(rgb), encoding)
    np.testing.assert_array_equal(messages.color_from_message(message, '/c'), rgb)


def test_grey_becomes_colour() -> None:
    grey = color_image(7)[..., 0]
    decoded = messages.color_from_message(image_message(grey, 'mono8'), '/c')
    np.testing.assert_array_equal(decoded, np.repeat(grey[..., None], 3, axis=2))


def test_padded_rows_and_byte_order() -> None:
    depth = depth_units(3)
    padded = np.zeros((HEIGHT, WIDTH + 5), '>u2')
    padded[:, :WIDTH] = depth
    message = image_message(padded, '16UC1', width=WIDTH, is_bigendian=1)
    decoded = messages.depth_from_message(message, '/d')
    assert decoded.dtype == np.float32 and decoded.dtype.isnative
    np.testing.assert_array_equal(decoded, depth.astype(np.float32) / np.float32(1000))


def test_depth_that_is_no_number_is_invalid() -> None:
    depth = np.array([[1.5, np.nan], [np.inf, -2.0]], np.float32)
    decoded = messages.depth_from_message(image_message(depth, '32FC1'), '/d')
    assert decoded.tolist() == [[1.5, 0], [0, 0]]


def test_images_with_missing_bytes_are_refused() -> None:
    message = image_message(color_image(0), 'rgb8')
    message.data = message.data[:-1]
    with pytest.raises(
        DatasetError, match=r"topic '/c': a 32x24 'rgb8' image needs rows of .* 96"
    ):
        messages.color_from_message(message, '/c')
    with pytest.raises(DatasetError, match=r"expected a colour image encoded as rgb8, .*'yuv422'"):
        messages.color_from_message(image_message(color_image(0), 'yuv422'), '/c')


def camera_message(**changes: object) -> SimpleNamespace:
    fields = {'width': 32, 'height': 24, 'distortion_model': 'plumb_bob', 'd': np.zeros(5),
              'k': np.array([30.0, 0, 15, 0, 31, 11, 0, 0, 1]), 'p': np.zeros(12)}  # fmt: skip
    return SimpleNamespace(**{**fields, **changes})


def test_camera_info() -> None:
    camera = messages.camera_from_message(camera_message(d=np.array([])), '/i')
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 31, 15, 11)
    assert camera.is_rectified
    # zero coefficients of any model are no distortion
    other = camera_message(distortion_model='rational_polynomial', d=np.zeros(8))
    assert messages.camera_from_message(other, '/i').is_rectified
    with pytest.raises(DatasetError, match="'/i': expected one of the distortion models plumb"):
        messages.camera_from_message(camera_message(distortion_model='ftheta', d=np.ones(4)), '/i')
    with pytest.raises(DatasetError, match="'equidistant' with 7 coefficients"):
        messages.camera_from_message(
            camera_message(distortion_model='equidistant', d=np.ones(7)), '/i'
        )
    with pytest.raises(DatasetError, match='not calibrated'):
        messages.camera_from_message(camera_message(k=np.full(9, np.nan)), '/i')
    with pytest.raises(DatasetError, match="'/i': camera_info is not calibrated"):
        messages.camera_from_message(camera_message(k=np.zeros(9)), '/i')


@pytest.mark.parametrize(
    ('model', 'given', 'expected_model', 'expected'),
    [
        ('plumb_bob', (1, 2, 3, 4), 'plumb_bob', (1, 2, 3, 4, 0)),
        ('plumb_bob', (1, 2, 3, 4, 5, 0, 0, 0), 'plumb_bob', (1, 2, 3, 4, 5)),
        ('plumb_bob', (1, 2, 3, 4, 5, 6), 'rational_polynomial', (1, 2, 3, 4, 5, 6, 0, 0)),
        ('rational_polynomial', (1, 2, 3, 4, 5, 0, 0, 0), 'plumb_bob', (1, 2, 3, 4, 5)),
        ('rational_polynomial', tuple(range(1, 9)), 'rational_polynomial', tuple(range(1, 9))),
        ('', (1, 2, 3, 4, 5), 'plumb_bob', (1, 2, 3, 4, 5)),
        ('equidistant', (1, 2, 3, 4), 'equidistant', (1, 2, 3, 4)),
        ('fisheye', (1, 2, 3, 4), 'equidistant', (1, 2, 3, 4)),
    ],
)
def test_the_usual_forms_of_distortion(
    model: str, given: tuple, expected_model: str, expected: tuple
) -> None:
    message = camera_message(distortion_model=model, d=np.array(given, float))
    camera = messages.camera_from_message(message, '/i')
    assert (camera.distortion_model, camera.distortion) == (expected_model, expected)


def test_a_projection_alone_is_a_camera_where_nothing_is_distorted() -> None:
    projection = np.array([30, 0, 15, 0, 0, 31, 11, 0, 0, 0, 1, 0], float)
    message = camera_message(k=np.zeros(9), p=projection, d=np.zeros(5))
    camera = messages.camera_from_message(message, '/i')
    assert (camera.fx, camera.fy, camera.cx, camera.cy) == (30, 31, 15, 11)
    with pytest.raises(DatasetError, match='not calibrated'):
        messages.camera_from_message(
            camera_message(k=np.zeros(9), p=projection, d=np.full(5, 0.1)), '/i'
        )


def test_header_stamps_of_ros1_and_of_both_byte_orders() -> None:
    little = b'\x00\x01\x00\x00' + (7).to_bytes(4, 'little') + (9).to_bytes(4, 'little')
    big = b'\x00\x00\x00\x00' + (7).to_bytes(4, 'big') + (9).to_bytes(4, 'big')
    assert header_stamp_ns(little) == header_stamp_ns(big) == 7 * 10**9 + 9
    ros1 = (65536).to_bytes(4, 'little') + little[4:]
    assert header_stamp_ns(ros1, ros1=True) == 7 * 10**9 + 9


# ---- reading here and there


@pytest.mark.parametrize('storage', ['mcap', 'sqlite3'])
def test_messages_are_found_in_any_order(tmp_path: Path, storage: str) -> None:
    plugins = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
    writer = Writer(tmp_path / 'bag', version=9, storage_plugin=plugins[storage])
    stamps = [0, 5, 5, 5, 10, 2 * 10**9, 2 * 10**9, 9 * 10**9]  # as logged; headers run on
    with writer:
        connections = [
            writer.add_connection(topic, messages.POSE_STAMPED, typestore=messages.jazzy())
            for topic in ('/a', '/b')
        ]
        for index, log_ns in enumerate(stamps):
            for connection in connections:
                data = messages.serialize_pose(100 + index, connection.topic, pose(index))
                writer.write(connection, log_ns, data)
    with open_bag(tmp_path / 'bag') as reader:
        refs = reader.index(['/a', '/b'])
        assert [ref.stamp_ns for ref in refs['/a']] == list(range(100, 108))
        assert [ref.nth for ref in refs['/a']] == [0, 0, 1, 2, 0, 0, 1, 0]
        places = [(topic, index) for topic in refs for index in range(len(stamps))]
        for place in np.random.default_rng(5).integers(0, len(places), 200):
            topic, index = places[place]
            expected = messages.serialize_pose(100 + index, topic, pose(index))
            assert reader.read(topic, refs[topic][index]) == expected
