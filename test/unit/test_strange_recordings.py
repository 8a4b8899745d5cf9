"""Recordings as other programs and drivers leave them: read, or left out and counted."""

from __future__ import annotations

import struct
from collections.abc import Callable
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
from data_recordings import HEIGHT, WIDTH, color_image, depth_units, write_tum
from rosbags.rosbag2 import StoragePlugin, Writer

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data import messages
from bdgs_ros.data.bag_recording import COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC, CameraTopics
from bdgs_ros.data.convert import convert
from bdgs_ros.data.layouts import open_sequence
from bdgs_ros.data.sequence import ReadableFrames

CAMERA = PinholeCamera(WIDTH, HEIGHT, 30.0, 31.0, 15.0, 11.0)
PERIOD_NS = 33_333_333
COUNT = 8
Edit = Callable[[int, bytes], bytes]


def camera_info(i: int, camera: PinholeCamera = CAMERA) -> bytes:
    return messages.serialize_camera_info(i * PERIOD_NS, 'cam', camera)


def depth_m(i: int) -> np.ndarray:
    return (depth_units(i) / np.float32(5000)).astype(np.float32)


def write_bag(
    path: Path,
    topics: tuple[str, str, str] = (COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC),
    kinds: tuple[str, str] = (messages.IMAGE, messages.IMAGE),
    color: Edit = lambda i, data: data,
    depth: Edit = lambda i, data: data,
    info: Edit = lambda i, data: data,
) -> Path:
    writer = Writer(path, version=9, storage_plugin=StoragePlugin.MCAP)
    with writer:
        types = (*kinds, messages.CAMERA_INFO)
        to = [
            writer.add_connection(t, k, typestore=messages.jazzy())
            for t, k in zip(topics, types, strict=True)
        ]
        for i in range(COUNT):
            at_ns = i * PERIOD_NS
            images = (
                messages.serialize_image(at_ns, 'cam', color_image(i), 'rgb8'),
                messages.serialize_image(at_ns, 'cam', depth_m(i), '32FC1'),
            )
            writer.write(to[2], at_ns, info(i, camera_info(i)))
            writer.write(to[0], at_ns, color(i, images[0]))
            writer.write(to[1], at_ns, depth(i, images[1]))
    return path


def compressed(i: int, kind: str, data: bytes) -> bytes:
    message = messages.jazzy().types[messages.COMPRESSED_IMAGE](
        messages._header(i * PERIOD_NS, 'cam'), kind, np.frombuffer(data, np.uint8)
    )
    return bytes(messages.jazzy().serialize_cdr(message, messages.COMPRESSED_IMAGE))


def png(image: np.ndarray) -> bytes:
    return bytes(cv2.imencode('.png', image)[1].tobytes())


# ---- stamps


def rewrite(folder: Path, edit: Callable[[int, str], list[str]]) -> Path:
    for name in ('rgb.txt', 'depth.txt'):
        rows = [r for r in (folder / name).read_text().splitlines() if not r.startswith('#')]
        lines = [line for i, row in enumerate(rows) for line in edit(i, row)]
        (folder / name).write_text('\n'.join(lines) + '\n')
    return folder


def test_frames_with_the_stamp_of_the_one_before_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    folder = write_tum(tmp_path / 'walk')
    whole = open_sequence(folder).stamps_ns.tolist()
    rewrite(folder, lambda i, row: [row, row] if i in (1, 3) else [row])
    sequence = open_sequence(folder)
    assert sequence.stamps_ns.tolist() == whole
    assert sequence.repeated == 2
    assert 'have the stamp of the one before and are left out' in caplog.text
    assert not sequence.unpaired_color


def test_stamps_that_never_advance_are_refused_in_words(tmp_path: Path) -> None:
    folder = rewrite(write_tum(tmp_path / 'walk'), lambda i, row: [f'0.0 {row.split()[1]}'])
    with pytest.raises(DatasetError, match=r'all 6 colour images have the stamp 0\.0+ s'):
        open_sequence(folder)


@pytest.mark.parametrize('unit', [10**3, 10**6, 10**9])
def test_lists_with_stamps_in_smaller_units_are_read(tmp_path: Path, unit: int) -> None:
    folder = write_tum(tmp_path / 'walk')
    first = int(float((folder / 'rgb.txt').read_text().splitlines()[-1].split()[0]))

    def scaled(i: int, row: str) -> list[str]:
        return [f'{first * unit + i * unit // 30} {row.split()[1]}']

    stamps_ns = open_sequence(rewrite(folder, scaled)).stamps_ns
    assert abs(int(stamps_ns[0]) - first * 10**9) < 10**9
    assert np.diff(stamps_ns) == pytest.approx(10**9 / 30, abs=1.1e6)


@pytest.mark.parametrize(('before', 'after'), [('\ufeff', ''), ('', '\r'), ('', '  ')])
def test_lists_as_other_programs_write_them(tmp_path: Path, before: str, after: str) -> None:
    folder = write_tum(tmp_path / 'walk')
    count = len(open_sequence(folder))
    for name in ('rgb.txt', 'depth.txt'):
        text = (folder / name).read_text().replace('\n', after + '\n')
        (folder / name).write_bytes((before + text).encode('utf-8'))
    assert len(open_sequence(folder)) == count


# ---- damaged images


def damage(file: Path) -> None:
    file.write_bytes(file.read_bytes()[:60])


def test_a_damaged_image_costs_itself_alone(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk')
    damage(sorted((folder / 'depth').iterdir())[3])
    sequence = open_sequence(folder)
    frames = ReadableFrames(sequence, range(len(sequence)))
    assert len(list(frames)) == len(sequence) - 1
    assert len(frames.skipped) == 1 and 'is not a readable depth image' in frames.skipped[0]
    report = convert(folder, tmp_path / 'bag')
    assert len(report.damaged) == 1
    assert len(open_sequence(tmp_path / 'bag')) == len(sequence) - 1


def test_where_no_image_can_be_read_it_is_an_error(tmp_path: Path) -> None:
    folder = write_tum(tmp_path / 'walk')
    for file in (folder / 'rgb').iterdir():
        damage(file)
    sequence = open_sequence(folder)
    with pytest.raises(DatasetError, match='is not a readable colour image'):
        list(ReadableFrames(sequence, range(len(sequence))))
    with pytest.raises(DatasetError, match='is not a readable colour image'):
        list(ReadableFrames(sequence, range(2)))
    with pytest.raises(DatasetError, match='is not a readable colour image'):
        convert(folder, tmp_path / 'bag')
    assert not (tmp_path / 'bag').exists()


def test_a_damaged_message_costs_itself_alone(tmp_path: Path) -> None:
    short = messages.serialize_image(4 * PERIOD_NS, 'cam', depth_m(4)[:10], '32FC1')
    bag = write_bag(tmp_path / 'bag', depth=lambda i, data: short if i == 4 else data)
    sequence = open_sequence(bag)
    frames = ReadableFrames(sequence, range(len(sequence)))
    assert len(list(frames)) == COUNT - 1
    assert 'expected images of shape' in frames.skipped[0]


# ---- cameras


def test_the_first_usable_camera_is_taken(tmp_path: Path) -> None:
    unready = PinholeCamera(WIDTH, HEIGHT, 0.0, 0.0, 0.0, 0.0)
    other = PinholeCamera(2 * WIDTH, 2 * HEIGHT, 60.0, 62.0, 30.5, 22.5)

    def info(i: int, data: bytes) -> bytes:
        return camera_info(i, unready if i == 0 else other) if i < 2 else data

    sequence = open_sequence(write_bag(tmp_path / 'bag', info=info))
    assert sequence.camera == CAMERA
    assert sequence[0].color.shape == (HEIGHT, WIDTH, 3)


def test_a_camera_that_is_never_ready_is_named(tmp_path: Path) -> None:
    unready = PinholeCamera(WIDTH, HEIGHT, 0.0, 0.0, 0.0, 0.0)
    bag = write_bag(tmp_path / 'bag', info=lambda i, data: camera_info(i, unready))
    with pytest.raises(DatasetError, match='camera_info is not calibrated'):
        open_sequence(bag)


# ---- names of topics, packed images

OAK = ('/robot1/oak/rgb/image_raw', '/robot1/oak/stereo/image_raw', '/robot1/oak/rgb/camera_info')


def test_topics_of_other_names_are_read_when_named(tmp_path: Path) -> None:
    bag = write_bag(tmp_path / 'bag', topics=OAK)
    with pytest.raises(DatasetError, match='name them with --color-topic and --depth-topic'):
        open_sequence(bag)
    assert len(open_sequence(bag, topics=CameraTopics(*OAK))) == COUNT
    with pytest.raises(DatasetError, match="has no topic '/nope'"):
        open_sequence(bag, topics=CameraTopics('/nope', OAK[1], OAK[2]))


def test_packed_images_are_read(tmp_path: Path) -> None:
    def jpeg(i: int, data: bytes) -> bytes:
        image = cv2.cvtColor(color_image(i), cv2.COLOR_RGB2BGR)
        return compressed(i, 'rgb8; jpeg compressed bgr8', png(image))

    def packed(i: int, data: bytes) -> bytes:
        millimetres = np.rint(1000 * depth_m(i)).astype(np.uint16)
        return compressed(i, '16UC1; compressedDepth png', bytes(12) + png(millimetres))

    bag = write_bag(
        tmp_path / 'bag',
        (f'{COLOR_TOPIC}/compressed', f'{DEPTH_TOPIC}/compressedDepth', INFO_TOPIC),
        (messages.COMPRESSED_IMAGE, messages.COMPRESSED_IMAGE),
        jpeg,
        packed,
    )
    frames = list(open_sequence(bag))
    assert len(frames) == COUNT
    for i, frame in enumerate(frames):
        assert np.array_equal(frame.color, color_image(i))
        assert frame.depth_m == pytest.approx(depth_m(i), abs=6e-4)


def message_of(data: bytes) -> Any:
    return messages.jazzy().deserialize_cdr(data, messages.COMPRESSED_IMAGE)


def test_packed_float_depth_has_its_quantisation_undone() -> None:
    a, b = 30_000.0, 3.0
    true_m = np.linspace(0.5, 5, WIDTH * HEIGHT, dtype=np.float32).reshape(HEIGHT, WIDTH)
    counts = np.rint(a / true_m + b).astype(np.uint16)
    counts[0, 0] = 0
    header = struct.pack('<iff', 0, a, b)
    data = compressed(0, '32FC1; compressedDepth png', header + png(counts))
    found = messages.depth_from_compressed(message_of(data), '/d')
    assert found[0, 0] == 0
    assert found.ravel()[1:] == pytest.approx(true_m.ravel()[1:], rel=1e-3)
    assert found.dtype == np.float32


@pytest.mark.parametrize('data', [b'', b'nothing', png(np.zeros((4, 4, 3), np.uint8))])
def test_what_is_no_packed_depth_is_named(data: bytes) -> None:
    with pytest.raises(DatasetError, match="topic '/d'"):
        messages.depth_from_compressed(message_of(compressed(0, '16UC1; png', data)), '/d')


def test_packed_images_are_unpacked_for_the_graph() -> None:
    image = cv2.cvtColor(color_image(2), cv2.COLOR_RGB2BGR)
    raw = messages.unpacked_color(compressed(2, 'jpeg', png(image)), '/c')
    message: Any = messages.jazzy().deserialize_cdr(raw, messages.IMAGE)
    assert messages.stamp_ns(message) == 2 * PERIOD_NS
    assert np.array_equal(messages.color_from_message(message, '/c'), color_image(2))
    counts = np.full((HEIGHT, WIDTH), 1500, np.uint16)
    raw = messages.unpacked_depth(compressed(2, '16UC1; png', png(counts)), '/d')
    message = messages.jazzy().deserialize_cdr(raw, messages.IMAGE)
    assert np.all(messages.depth_from_message(message, '/d') == 1.5)
