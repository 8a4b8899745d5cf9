"""Maps survive files, foreign files are read, broken ones named."""

from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.errors import MapError
from bdgs_ros.mapping.gaussians import PARAMETERS, GaussianMap, NewGaussians
from bdgs_ros.mapping.ply import STANDARD, STATE, load_ply, save_ply

CONFIG = BeliefConfig()


def a_map(count: int = 20) -> GaussianMap:
    rng = np.random.default_rng(0)
    out = GaussianMap(CONFIG)
    new = NewGaussians(
        rng.normal(size=(count, 3)).astype(np.float32),
        rng.uniform(0.01, 0.1, count).astype(np.float32),
        rng.random((count, 3)).astype(np.float32),
        rng.uniform(0.1, 0.9, count).astype(np.float32),
    )
    out.append(new, 0.7, 3)
    out.parameters['log_scales'] += rng.normal(size=(count, 3)).astype(np.float32)
    return out


def test_round_trip_keeps_everything(tmp_path: Path) -> None:
    original = a_map()
    save_ply(tmp_path / 'map.ply', original)
    loaded = load_ply(tmp_path / 'map.ply', CONFIG)
    for name in PARAMETERS:
        np.testing.assert_allclose(
            loaded.parameters[name], original.parameters[name], atol=1e-6, err_msg=name
        )
    np.testing.assert_array_equal(loaded.p_dynamic, original.p_dynamic)
    np.testing.assert_array_equal(loaded.keyframe_index, original.keyframe_index)


def test_the_layout_is_that_of_3dgs(tmp_path: Path) -> None:
    save_ply(tmp_path / 'map.ply', a_map())
    header = (tmp_path / 'map.ply').read_bytes().split(b'end_header\n')[0].decode()
    names = [line.split()[2] for line in header.splitlines() if line.startswith('property')]
    assert tuple(names) == STANDARD + STATE
    assert names[6:9] == ['f_dc_0', 'f_dc_1', 'f_dc_2']


def test_a_foreign_map_without_state_starts_static(tmp_path: Path) -> None:
    names = [n for n in STANDARD if n not in ('nx', 'ny', 'nz')]
    header = 'ply\nformat binary_little_endian 1.0\nelement vertex 2\n'
    header += ''.join(f'property float {n}\n' for n in names) + 'end_header\n'
    body = np.full((2, len(names)), 0.5, '<f4').tobytes()
    (tmp_path / 'foreign.ply').write_bytes(header.encode() + body)
    loaded = load_ply(tmp_path / 'foreign.ply', CONFIG)
    assert len(loaded) == 2
    assert loaded.visible_mask().all()


def test_truncated_file_is_named_with_numbers(tmp_path: Path) -> None:
    path = tmp_path / 'map.ply'
    save_ply(path, a_map())
    path.write_bytes(path.read_bytes()[:-100])
    with pytest.raises(MapError, match='truncated: 20 Gaussians need 1680 bytes, 1580'):
        load_ply(path, CONFIG)


@pytest.mark.parametrize('content', [b'', b'solid stl', b'ply\nformat ascii 1.0\nend_header\n'])
def test_other_files_are_refused(tmp_path: Path, content: bytes) -> None:
    (tmp_path / 'x.ply').write_bytes(content)
    with pytest.raises(MapError, match='not a binary'):
        load_ply(tmp_path / 'x.ply', CONFIG)


def test_missing_file(tmp_path: Path) -> None:
    with pytest.raises(MapError, match='cannot be read: No such file'):
        load_ply(tmp_path / 'none.ply', CONFIG)


def _disk_full(*_: object) -> None:
    raise OSError(28, 'No space left on device')


def test_failed_save_keeps_the_old_file(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / 'map.ply'
    save_ply(path, a_map(5))
    monkeypatch.setattr('os.replace', _disk_full)
    with pytest.raises(MapError, match='map not saved'):
        save_ply(path, a_map(50))
    assert not (tmp_path / 'map.ply.part').exists()
    assert len(load_ply(path, CONFIG)) == 5
