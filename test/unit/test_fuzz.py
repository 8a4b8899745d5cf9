"""
Whatever comes in, it is read or refused by name: never a crash, never another error.

`make fuzz` looks for ten minutes, at other inputs each time; here they are always the same.
"""

from __future__ import annotations

import json
import os
import tempfile
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import yaml

pytest.importorskip('hypothesis', reason='needs hypothesis')

from data_recordings import CAMERA_YAML, write_tum
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from bdgs_ros.bridge.cdr_image import image_from_cdr
from bdgs_ros.core.camera import PinholeCamera, Rectifier
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.errors import BdgsError
from bdgs_ros.data import messages
from bdgs_ros.data.camera_file import read_camera_file
from bdgs_ros.data.convert import convert
from bdgs_ros.data.layouts import open_sequence
from bdgs_ros.data.sequence import ReadableFrames
from bdgs_ros.data.trajectory_io import read_trajectory
from bdgs_ros.journal.checkpoints import Checkpoints, read_newest
from bdgs_ros.journal.poses import PoseJournal, read_told
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.keyframe_store import TRANSFORMS, KeyframeSet
from bdgs_ros.mapping.map_files import keyframe_folder, load_map, save_map
from bdgs_ros.mapping.mapper import Mapper

LONG = os.environ.get('BDGS_FUZZ') == 'long'
CONFIG = BdgsConfig()
many = settings(
    max_examples=3000 if LONG else 120,
    derandomize=not LONG,
    deadline=None,
    database=None,
    suppress_health_check=list(HealthCheck),
)

numbers = st.one_of(st.floats(), st.integers(-(2**40), 2**40), st.just(0), st.just(float('nan')))
plain = st.recursive(
    st.one_of(st.none(), st.booleans(), numbers, st.text(max_size=8)),
    lambda inner: st.one_of(
        st.lists(inner, max_size=4), st.dictionaries(st.text(max_size=8), inner, max_size=4)
    ),
    max_leaves=8,
)


@st.composite
def spoilt(draw: Callable, data: bytes) -> bytes:
    """Return bytes with some flipped, and perhaps cut off or longer."""
    spoilt = bytearray(data)
    for _ in range(draw(st.integers(1, 6))):
        spoilt[draw(st.integers(0, len(spoilt) - 1))] = draw(st.integers(0, 255))
    end = draw(st.one_of(st.none(), st.integers(0, len(spoilt))))
    return bytes(spoilt[:end]) + draw(st.sampled_from([b'', b'\0' * 7, b'more']))


@contextmanager
def replaced(file: Path, data: bytes) -> Iterator[None]:
    """Have other bytes in a file for a while."""
    whole = file.read_bytes()
    file.write_bytes(data)
    try:
        yield
    finally:
        file.write_bytes(whole)


def read_or_refused(read: Callable[[], object]) -> object:
    try:
        return read()
    except BdgsError as error:
        assert str(error)
        return None


# ---- messages

IMAGE = messages.serialize_image(5, 'cam', np.zeros((6, 8, 3), np.uint8), 'rgb8')


@many
@given(spoilt(IMAGE))
def test_images_off_the_wire(data: bytes) -> None:
    def read() -> object:
        return messages.color_from_message(image_from_cdr(data), '/c')

    image = read_or_refused(read)
    assert image is None or image.ndim == 3


@many
@given(
    encoding=st.sampled_from(['rgb8', 'bgra8', 'mono8', '16UC1', '32FC1', '64FC1', '8UC3', 'yuv']),
    height=st.integers(0, 10_000),
    width=st.integers(0, 10_000),
    step=st.integers(0, 2**32 - 1),
    big=st.integers(0, 255),
    data=st.binary(max_size=400),
)
def test_fields_of_images_that_do_not_fit(
    encoding: str, height: int, width: int, step: int, big: int, data: bytes
) -> None:
    message = SimpleNamespace(
        encoding=encoding, height=height, width=width, step=step, is_bigendian=big, data=data
    )
    color = read_or_refused(lambda: messages.color_from_message(message, '/c'))
    assert color is None or color.shape == (height, width, 3)
    depth = read_or_refused(lambda: messages.depth_from_message(message, '/d'))
    assert depth is None or (np.isfinite(depth).all() and (depth >= 0).all())


@many
@given(kind=st.text(max_size=30), data=st.binary(max_size=200))
def test_packed_images(kind: str, data: bytes) -> None:
    for name in (kind, '32FC1; compressedDepth png', '16UC1; compressedDepth png', 'jpeg'):
        message = SimpleNamespace(format=name, data=data)
        read_or_refused(lambda m=message: messages.color_from_compressed(m, '/c'))
        read_or_refused(lambda m=message: messages.depth_from_compressed(m, '/d'))


@many
@given(
    model=st.sampled_from(['plumb_bob', '', 'rational_polynomial', 'equidistant', 'x']),
    d=st.lists(st.floats(), max_size=15),
    k=st.lists(st.floats(), min_size=9, max_size=9),
    p=st.lists(st.floats(), min_size=12, max_size=12),
    size=st.tuples(st.integers(0, 64), st.integers(0, 64)),
)
def test_camera_infos(
    model: str, d: list[float], k: list[float], p: list[float], size: tuple[int, int]
) -> None:
    message = SimpleNamespace(distortion_model=model, d=d, k=k, p=p, width=size[0], height=size[1])
    camera = read_or_refused(lambda: messages.camera_from_message(message, '/i'))
    if isinstance(camera, PinholeCamera):
        color = np.zeros((*camera.shape, 3), np.uint8)
        assert Rectifier(camera).color(color).shape == color.shape


# ---- files


@many
@given(plain)
def test_camera_files(content: object) -> None:
    def edited(key: str) -> str:
        document = yaml.safe_load(CAMERA_YAML)
        document['camera'][key] = content
        return yaml.safe_dump(document)

    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / 'camera.yaml'
        for key in ('width', 'fx', 'distortion', 'distortion_model', 'depth_scale', 'other'):
            file.write_text(edited(key))
            read_or_refused(lambda: read_camera_file(file))


@many
@given(spoilt(b'# stamp x y z qx qy qz qw\n1.5 1 2 3 0 0 0 1\n1.6 1 2 3 0.1 0 0 1\n'))
def test_trajectories(data: bytes) -> None:
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / 'trajectory.txt'
        file.write_bytes(data)
        read_or_refused(lambda: read_trajectory(file))


@pytest.fixture(scope='module')
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tum(tmp_path_factory.mktemp('fuzz') / 'walk')


@many
@given(data=st.data())
def test_lists_of_images(folder: Path, data: st.DataObject) -> None:
    file = folder / data.draw(st.sampled_from(['rgb.txt', 'depth.txt']))
    with replaced(file, data.draw(spoilt(file.read_bytes()))):
        read_or_refused(lambda: _run_through(folder))


def _run_through(path: Path) -> int:
    sequence = open_sequence(path)
    return len(list(ReadableFrames(sequence, range(len(sequence)))))


@pytest.fixture(scope='module')
def bag(folder: Path) -> Path:
    convert(folder, folder.parent / 'bag')
    return folder.parent / 'bag'


@many
@given(data=st.data())
def test_bags(bag: Path, data: st.DataObject) -> None:
    file = data.draw(st.sampled_from(sorted(path for path in bag.iterdir() if path.is_file())))
    with replaced(file, data.draw(spoilt(file.read_bytes()))):
        read_or_refused(lambda: _run_through(bag))


@pytest.fixture(scope='module')
def saved(tmp_path_factory: pytest.TempPathFactory) -> Path:
    from test_journal_map import CONFIG as SMALL
    from test_journal_map import a_keyframe

    mapper = Mapper(SMALL.mapping, SMALL.belief)
    for i in (1, 2):
        mapper.process(a_keyframe(i))
    path = tmp_path_factory.mktemp('fuzz') / 'map.ply'
    save_map(path, mapper.map, mapper.kept())
    Checkpoints(path.parent / 'journal').write(
        Checkpoints(path.parent / 'journal').state(mapper.map, mapper.kept())
    )
    return path


def _load(path: Path) -> tuple[GaussianMap, KeyframeSet]:
    gaussians, kept = load_map(path, CONFIG.belief, 1)
    assert np.isfinite(gaussians.means).all() and np.isfinite(gaussians.log_scales).all()
    return gaussians, kept


@many
@given(data=st.data())
def test_maps(saved: Path, data: st.DataObject) -> None:
    whole = saved.read_bytes()
    head = whole.index(b'end_header')
    in_head = spoilt(whole[:head]).map(lambda changed: changed + whole[head:])
    with replaced(saved, data.draw(st.one_of(spoilt(whole), in_head))):
        read_or_refused(lambda: _load(saved))


@many
@given(data=st.data())
def test_transforms_of_keyframes(saved: Path, data: st.DataObject) -> None:
    file = keyframe_folder(saved) / TRANSFORMS
    document = json.loads(file.read_text())
    within = data.draw(
        st.sampled_from(
            [document, document['bdgs'], document['bdgs']['history'], document['frames'][0]]
        )
    )
    within[data.draw(st.sampled_from(sorted(within)))] = data.draw(plain)
    with replaced(file, json.dumps(document).encode()):
        read_or_refused(lambda: _load(saved))


@many
@given(data=st.data())
def test_states_of_the_journal(saved: Path, data: st.DataObject) -> None:
    folder = saved.parent / 'journal'
    file = data.draw(st.sampled_from(sorted(p for p in folder.rglob('*') if p.is_file())))
    with replaced(file, data.draw(spoilt(file.read_bytes()))):
        found = read_newest(folder, CONFIG.belief, CONFIG.mapping)
        assert found is None or file.suffix == '.png' or len(found[0])


@many
@given(data=st.data())
def test_poses_of_the_journal(
    tmp_path_factory: pytest.TempPathFactory, data: st.DataObject
) -> None:
    with tempfile.TemporaryDirectory() as name:
        file = Path(name) / 'poses.rec'
        journal = PoseJournal(file, 10**6, lambda text: None, keep=False)
        for i in range(4):
            journal.note_pose(i, np.eye(4))
        journal.close()
        file.write_bytes(data.draw(spoilt(file.read_bytes())))
        told = read_or_refused(lambda: read_told(file))
        assert told is None or all(p.stamp_ns in range(4) for p in told.poses)
