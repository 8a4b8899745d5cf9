"""A map and its keyframes: saved together, loaded, continued, and refused when they do not fit."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.core.errors import MapError
from bdgs_ros.core.files import previous_folder
from bdgs_ros.core.types import Keyframe, RgbdFrame
from bdgs_ros.mapping.keyframe_store import TRANSFORMS, gaussians_of
from bdgs_ros.mapping.map_files import keyframe_folder
from bdgs_ros.mapping.mapper import Mapper

CAMERA = PinholeCamera(64, 48, 60.0, 61.0, 31.7, 23.2)
SECOND = 1_000_000_000
CONFIG = with_values(
    BdgsConfig(), {'mapping.iterations': 4, 'mapping.threads': 1, 'mapping.keyframes': 6}
)


def a_frame(stamp_ns: int, T_world_camera: np.ndarray) -> RgbdFrame:
    """A striped wall at z = 2 m."""
    rays = CAMERA.rays() @ T_world_camera[:3, :3].T
    scale = (2.0 - T_world_camera[2, 3]) / rays[..., 2]
    points = rays * scale[..., None] + T_world_camera[:3, 3]
    pattern = 0.5 + 0.4 * np.sin(9 * points[..., :1]) * np.cos(7 * points[..., 1:2])
    color = np.concatenate([pattern, 1 - pattern, pattern**2], axis=-1)
    return RgbdFrame(stamp_ns, (255 * color).astype(np.uint8), scale.astype(np.float32), CAMERA)


def a_keyframe(i: int) -> Keyframe:
    T = se3.exp(np.array([0.04 * i, 0.01 * i, 0, 0, 0.02 * i, 0.01 * i]))
    p_dynamic = np.zeros(CAMERA.shape, np.uint8)
    p_dynamic[5:15, 10:20] = 200
    return Keyframe(a_frame(1_700_000_000 * SECOND + i * SECOND, T), T, p_dynamic)


def mapped(count: int = 3) -> Mapper:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    for i in range(count):
        mapper.process(a_keyframe(i))
    return mapper


@pytest.fixture(scope='module')
def original() -> Mapper:
    return mapped()


@pytest.fixture
def saved(original, tmp_path) -> Path:
    original.save(tmp_path / 'map.ply')
    return tmp_path / 'map.ply'


def load(path: Path) -> Mapper:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    mapper.load(path)
    return mapper


def edit(path: Path, change) -> None:
    file = keyframe_folder(path) / TRANSFORMS
    document = json.loads(file.read_text())
    change(document)
    file.write_text(json.dumps(document))


def test_keyframes_come_back_as_they_were(original, saved):
    loaded = load(saved)
    assert loaded.history.stamps_ns == original.history.stamps_ns
    assert len(loaded.keyframes) == 3
    for a, b in zip(original.keyframes, loaded.keyframes, strict=True):
        assert (a.index, a.stamp_ns) == (b.index, b.stamp_ns)
        np.testing.assert_allclose(b.T_world_camera, a.T_world_camera, atol=1e-12)
        np.testing.assert_array_equal(b.p_dynamic, a.p_dynamic)
        np.testing.assert_allclose(b.exposure, a.exposure, rtol=1e-6)
        assert len(a.levels) == len(b.levels)
        for la, lb in zip(a.levels, b.levels, strict=True):
            camera = [la.camera.fx, la.camera.fy, la.camera.cx, la.camera.cy]
            read = [lb.camera.fx, lb.camera.fy, lb.camera.cx, lb.camera.cy]
            np.testing.assert_allclose(read, camera, atol=1e-9)
            np.testing.assert_array_equal(lb.color, la.color)
            np.testing.assert_array_equal(lb.weight, la.weight)
            np.testing.assert_allclose(lb.depth_m, la.depth_m, atol=0.00051)


def test_the_folder_is_a_nerfstudio_dataset(original, saved):
    folder = keyframe_folder(saved)
    document = json.loads((folder / TRANSFORMS).read_text())
    frame = document['frames'][2]
    pose = np.array(frame['transform_matrix'])
    T = original.keyframes[2].T_world_camera
    np.testing.assert_allclose(pose[:3, 3], T[:3, 3])
    np.testing.assert_allclose(pose[:3, 2], -T[:3, 2])  # OpenGL looks along -z
    np.testing.assert_allclose(pose[:3, 1], -T[:3, 1])  # and has y up
    assert frame['cx'] == pytest.approx(CAMERA.cx + 0.5)
    assert (frame['w'], frame['h']) == (CAMERA.width, CAMERA.height)
    image = cv2.imread(str(folder / frame['file_path']))
    np.testing.assert_array_equal(image[..., ::-1], a_keyframe(2).frame.color)
    depth = cv2.imread(str(folder / frame['depth_file_path']), cv2.IMREAD_UNCHANGED)
    assert depth.dtype == np.uint16
    assert abs(float(np.median(depth)) - 2000) < 50
    mask = cv2.imread(str(folder / frame['mask_path']), cv2.IMREAD_UNCHANGED)
    assert mask[10, 15] == 0
    assert mask[40, 40] == 255
    points = (folder / document['ply_file_path']).read_bytes()
    assert b'property uchar red' in points


def test_depth_that_16_bits_cannot_hold_is_invalid(tmp_path):
    mapper = mapped(1)
    depth = mapper.keyframes[0].levels[0].depth_m
    depth[0, :3] = [70.0, np.nan, np.inf]
    mapper.save(tmp_path / 'map.ply')
    assert (load(tmp_path / 'map.ply').keyframes[0].levels[0].depth_m[0, :3] == 0).all()


def test_mapping_continues_after_the_loaded_keyframes(saved):
    mapper = load(saved)
    before = len(mapper.map)
    mapper.process(a_keyframe(8))
    assert [kf.index for kf in mapper.keyframes] == [0, 1, 2, 3]
    assert len(mapper.map) > before
    assert mapper.map.keyframe_index.max() == 3
    mapper.save(saved)
    assert [kf.index for kf in load(saved).keyframes] == [0, 1, 2, 3]


def test_localising_leaves_the_loaded_map_alone(saved):
    mapper = load(saved)
    mapper.frozen = True
    before = mapper.map.means.copy()
    view = mapper.process(a_keyframe(1))
    assert view is not None
    assert (view.depth_m > 0).mean() > 0.8
    np.testing.assert_array_equal(mapper.map.means, before)
    assert len(mapper.keyframes) == 3


def test_without_keyframes_the_count_goes_on_and_stale_ones_go(original, saved):
    original.save(saved, keyframes=False)
    assert not keyframe_folder(saved).exists()
    mapper = load(saved)
    assert mapper.keyframes == []
    mapper.process(a_keyframe(8))
    assert [kf.index for kf in mapper.keyframes] == [3]


def test_a_save_that_fails_leaves_map_and_keyframes(saved, monkeypatch):
    mapper = load(saved)
    mapper.process(a_keyframe(8))

    def full(*_: object, **__: object) -> None:
        raise OSError(28, 'No space left on device')

    monkeypatch.setattr('bdgs_ros.mapping.keyframe_store._write_png', full)
    with pytest.raises(MapError, match=r'No space left.*last save are intact'):
        mapper.save(saved)
    monkeypatch.undo()
    monkeypatch.setattr('bdgs_ros.mapping.ply.write_bytes', full)
    with pytest.raises(MapError, match='No space left'):
        mapper.save(saved)
    monkeypatch.undo()
    assert len(load(saved).keyframes) == 3
    assert sorted(p.name for p in saved.parent.iterdir()) == ['map.ply', 'map_keyframes']


def test_an_unwritable_place_is_named(original, tmp_path):
    (tmp_path / 'file').write_text('')
    with pytest.raises(MapError, match=r"not saved to '.*file/map"):
        original.save(tmp_path / 'file' / 'map.ply')


def test_a_crash_between_the_two_renames_costs_nothing(original, saved):
    """The new folder is in place, the map still the old one: the old folder belongs to it."""
    folder = keyframe_folder(saved)
    folder.rename(previous_folder(folder))
    folder.mkdir()
    document = json.loads((previous_folder(folder) / TRANSFORMS).read_text())
    document['bdgs']['gaussians'] += 1
    (folder / TRANSFORMS).write_text(json.dumps(document))
    assert len(load(saved).keyframes) == 3
    original.save(saved)
    assert not previous_folder(folder).exists()


def test_keyframes_of_another_map_are_refused_with_advice(saved):
    edit(saved, lambda d: d['bdgs'].update(gaussians=7))
    with pytest.raises(MapError, match=r'belongs to a map of 7; remove the folder'):
        load(saved)
    edit(saved, lambda d: d['bdgs'].pop('gaussians'))
    assert gaussians_of(keyframe_folder(saved)) is None
    assert len(load(saved).keyframes) == 3


def test_keyframes_of_another_run_are_refused(saved):
    edit(saved, lambda d: (d['bdgs'].update(next_index=1), d['frames'].__delitem__(slice(1, 9))))
    with pytest.raises(MapError, match=r'of keyframe 2, but .* ends before keyframe 1'):
        load(saved)


def truncate(path: Path) -> None:
    path.write_bytes(path.read_bytes()[:30])


def half_size(path: Path) -> None:
    cv2.imwrite(str(path), np.zeros((24, 32), np.uint16))


@pytest.mark.parametrize(
    ('file', 'damage', 'message'),
    [
        ('images/000001.png', Path.unlink, r'images/000001.png.*No such file.*remove'),
        ('images/000001.png', truncate, r'expected uint8 \(48, 64, 3\), found no image'),
        ('depth/000001.png', half_size, r'expected uint16 \(48, 64\), found uint16 \(24, 32\)'),
        (TRANSFORMS, truncate, 'is not JSON'),
        (TRANSFORMS, Path.unlink, r'transforms.json.*No such file.*remove'),
        (TRANSFORMS, lambda p: p.write_text('{"frames": []}'), "no entry 'bdgs'"),
    ],
)
def test_damaged_keyframes_are_named_with_advice(saved, file, damage, message):
    damage(keyframe_folder(saved) / file)
    with pytest.raises(MapError, match=message):
        load(saved)


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        (lambda f: f.pop('exposure'), "damaged: KeyError 'exposure'"),
        (lambda f: f.update(transform_matrix=[[1, 2], [3, 4]]), 'damaged: ValueError'),
        (lambda f: f.update(transform_matrix=(2 * np.eye(4)).tolist()), 'no rigid motion'),
        (lambda f: f.update(w='wide'), 'damaged: ValueError'),
    ],
)
def test_damaged_entries_are_named(saved, change, message):
    edit(saved, lambda document: change(document['frames'][0]))
    with pytest.raises(MapError, match=message):
        load(saved)


def test_a_failed_load_keeps_the_map_at_hand(saved):
    mapper = mapped(2)
    before = len(mapper.map)
    saved.write_bytes(b'ply')
    with pytest.raises(MapError):
        mapper.load(saved)
    assert len(mapper.map) == before
    assert len(mapper.keyframes) == 2
