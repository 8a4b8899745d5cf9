"""Maps survive files, foreign files are read, broken ones named."""

from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.errors import MapError
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.parameters import PARAMETERS
from bdgs_ros.mapping.ply import STANDARD, STATE, load_ply, save_ply, write_points

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
    with pytest.raises(MapError, match='truncated: 20 Gaussians need 1840 bytes, 1740'):
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
    monkeypatch.setattr(Path, 'replace', _disk_full)
    with pytest.raises(MapError, match=r'map not saved.*No space left'):
        save_ply(path, a_map(50))
    assert [p.name for p in tmp_path.iterdir()] == ['map.ply']
    assert len(load_ply(path, CONFIG)) == 5


def test_a_plain_file_has_the_standard_properties_alone(tmp_path: Path) -> None:
    save_ply(tmp_path / 'plain.ply', a_map(), state=False)
    header, body = (tmp_path / 'plain.ply').read_bytes().split(b'end_header\n', 1)
    names = [line.split()[2] for line in header.decode().splitlines() if 'property' in line]
    assert tuple(names) == STANDARD
    assert len(body) == 20 * 4 * len(STANDARD)
    assert len(load_ply(tmp_path / 'plain.ply', CONFIG)) == 20


def test_points_are_those_that_are_shown(tmp_path: Path) -> None:
    original = a_map()
    write_points(tmp_path / 'points.ply', original)
    header, body = (tmp_path / 'points.ply').read_bytes().split(b'end_header\n', 1)
    shown = int(original.visible_mask().sum())
    assert 0 < shown < 20
    assert f'element vertex {shown}\n'.encode() in header
    assert len(body) == shown * 15


def foreign(path: Path, names: list[str], rows: np.ndarray) -> None:
    header = 'ply\nformat binary_little_endian 1.0\ncomment of others\n'
    header += f'element vertex {len(rows)}\n'
    header += ''.join(f'property float {n}\n' for n in names) + 'end_header\n'
    path.write_bytes(header.encode() + rows.astype('<f4').tobytes())


def test_other_types_and_further_properties_are_read_past(tmp_path: Path) -> None:
    names = [*STANDARD[3:], *STANDARD[:3]]
    kinds = ['double' if n == 'opacity' else 'float' for n in names]
    sizes = {'double': '<f8', 'float': '<f4'}
    table = np.zeros(3, [(n, sizes[k]) for n, k in zip(names, kinds, strict=True)])
    table['rot_0'], table['opacity'], table['z'] = 1.0, 2.5, [1, 2, 3]
    header = 'ply\nformat binary_little_endian 1.0\nelement vertex 3\n'
    header += (
        ''.join(f'property {k} {n}\n' for k, n in zip(kinds, names, strict=True)) + 'end_header\n'
    )
    (tmp_path / 'x.ply').write_bytes(header.encode() + table.tobytes())
    loaded = load_ply(tmp_path / 'x.ply', CONFIG)
    np.testing.assert_array_equal(loaded.logit_opacities, [2.5] * 3)
    np.testing.assert_array_equal(loaded.means[:, 2], [1, 2, 3])


def test_gaussians_that_are_not_finite_are_left_out(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    rows = np.ones((4, len(STANDARD)), np.float32)
    rows[1, 0] = np.nan
    rows[2, STANDARD.index('rot_0') :] = 0
    rows[:, STANDARD.index('nx')] = np.nan  # normals are nobody's business
    foreign(tmp_path / 'x.ply', list(STANDARD), rows)
    assert len(load_ply(tmp_path / 'x.ply', CONFIG)) == 2
    assert '2 Gaussians are not finite' in caplog.text


@pytest.mark.parametrize(
    ('replaced', 'by', 'message'),
    [
        ('element vertex 2', 'element chunk 1\nelement vertex 2', 'export it uncompressed'),
        ('element vertex 2', 'element vertex many', "one element 'vertex COUNT'"),
        ('element vertex 2', 'element vertex', "one element 'vertex COUNT'"),
        ('float nx', 'list uchar int nx', 'list uchar int nx'),
        ('float nx', 'quaternion nx', 'quaternion nx'),
        ('float nx', 'float x', 'each once.*float x'),
        ('float opacity', 'float alpha', 'lacks the properties opacity'),
    ],
)
def test_strange_headers_are_named(tmp_path: Path, replaced: str, by: str, message: str) -> None:
    save_ply(tmp_path / 'x.ply', a_map(2))
    content = (tmp_path / 'x.ply').read_bytes()
    (tmp_path / 'x.ply').write_bytes(content.replace(replaced.encode(), by.encode(), 1))
    with pytest.raises(MapError, match=message):
        load_ply(tmp_path / 'x.ply', CONFIG)


def test_ghosts_stay_hidden_through_a_file(tmp_path: Path) -> None:
    """Their belief has faded below the threshold; that alone must not bring them back."""
    gaussians = a_map()
    gaussians.belief.restart_smoothing(
        np.full(len(gaussians), 0.55, np.float32), np.arange(20) < 7, np.arange(20) < 5
    )
    save_ply(tmp_path / 'map.ply', gaussians)
    loaded = load_ply(tmp_path / 'map.ply', BeliefConfig()).belief
    np.testing.assert_array_equal(loaded.hidden, np.arange(20) < 7)
    np.testing.assert_array_equal(loaded.void, np.arange(20) < 5)
