"""Stamps and trajectories as text."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import StampedPose, Trajectory
from bdgs_ros.data.trajectory_io import (
    format_stamp_ns,
    parse_stamp_ns,
    read_trajectory,
    write_trajectory,
)


@pytest.mark.parametrize(
    ('text', 'expected'),
    [
        ('1305031229.528748', 1305031229528748000),
        ('1548339819.87426', 1548339819874260000),
        ('1548339819.123456789', 1548339819123456789),
        ('12', 12_000_000_000),
        ('-0.5', -500_000_000),
        ('1.5e3', 1_500_000_000_000),
    ],
)
def test_stamps_are_exact(text: str, expected: int) -> None:
    assert parse_stamp_ns(text) == expected
    assert parse_stamp_ns(format_stamp_ns(expected)) == expected


@pytest.mark.parametrize('text', ['', 'abc', 'nan', 'inf', '1.2.3'])
def test_what_is_not_a_stamp_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match='not a stamp'):
        parse_stamp_ns(text)


def test_a_trajectory_survives_the_round_trip(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    poses = [StampedPose(10**18 + 7 * i, se3.exp(rng.normal(size=6))) for i in range(9)]
    write_trajectory(tmp_path / 'new' / 'a.txt', Trajectory(tuple(poses)))
    back = read_trajectory(tmp_path / 'new' / 'a.txt')
    assert back.stamps_ns.tolist() == [pose.stamp_ns for pose in poses]
    expected = [pose.T_world_camera for pose in poses]
    np.testing.assert_allclose(back.matrices, expected, atol=1e-8)


def test_lines_are_sorted_and_comments_skipped(tmp_path: Path) -> None:
    path = tmp_path / 'gt.txt'
    path.write_text('# x\n2.0 0 0 0 0 0 0 1\n\n1.0 1 2 3 0 0 0 1\n')
    trajectory = read_trajectory(path)
    assert trajectory.stamps_ns.tolist() == [10**9, 2 * 10**9]
    assert trajectory.positions[0].tolist() == [1, 2, 3]


@pytest.mark.parametrize(
    'line', ['1.0 1 2 3', '1.0 a 2 3 0 0 0 1', '1.0 1 2 3 0 0 0 0', '1 nan 0 0 0 0 0 1']
)
def test_a_bad_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / 'gt.txt'
    path.write_text(f'# comment\n{line}\n')
    with pytest.raises(DatasetError, match=r"gt\.txt', line 2: expected 'stamp x y z"):
        read_trajectory(path)


def test_a_failed_write_keeps_the_old_file(tmp_path: Path) -> None:
    path = tmp_path / 'a.txt'
    path.write_text('old')
    broken = Trajectory((StampedPose(0, np.full((4, 4), 'x')),))  # type: ignore[arg-type]
    with pytest.raises((ValueError, TypeError)):
        write_trajectory(path, broken)
    (tmp_path / 'file').write_text('')
    with pytest.raises(DatasetError, match='cannot write'):
        write_trajectory(tmp_path / 'file' / 'b.txt', Trajectory())
    assert path.read_text() == 'old'
    assert sorted(item.name for item in tmp_path.iterdir()) == ['a.txt', 'file']


@pytest.mark.parametrize('unit', [1, 10**3, 10**6, 10**9])
def test_stamps_in_smaller_units_are_read(unit: int) -> None:
    assert parse_stamp_ns(str(1403636579 * unit)) == 1403636579 * 10**9


@pytest.mark.parametrize('text', ['inf', '-inf', 'nan', '1e40', 'x'])
def test_no_time_that_can_be_is_refused(text: str) -> None:
    with pytest.raises(ValueError, match='not a stamp'):
        parse_stamp_ns(text)


@pytest.mark.parametrize(
    'form', ['{0}', '\ufeff{0}', '{0}\r\n', '{0} \t', '{1}', '{2}'], ids=range(6)
)
def test_trajectories_as_other_programs_write_them(tmp_path: Path, form: str) -> None:
    row = '1.5 1 2 3 0 0 0 1'
    file = tmp_path / 'their.txt'
    file.write_bytes(form.format(row, row.replace(' ', '\t'), row.replace(' ', ', ')).encode())
    (pose,) = read_trajectory(file).poses
    assert pose.stamp_ns == 1_500_000_000
    assert pose.T_world_camera[:3, 3].tolist() == [1, 2, 3]
