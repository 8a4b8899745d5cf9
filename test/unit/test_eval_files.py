"""Trajectory files, and that the old file survives a failure."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.types import StampedPose, Trajectory
from bdgs_ros.eval.files import write_aside
from bdgs_ros.eval.tum_file import read_tum, write_tum


def test_round_trip_keeps_every_nanosecond(tmp_path):
    rng = np.random.default_rng(0)
    written = Trajectory(
        tuple(
            StampedPose(1_548_339_819_888_510_001 + i * 33_366_701, se3.exp(rng.normal(size=6)))
            for i in range(20)
        )
    )
    write_tum(tmp_path / 'a.txt', written, 'hello')
    read = read_tum(tmp_path / 'a.txt')
    assert np.array_equal(read.stamps_ns, written.stamps_ns)
    assert np.allclose(read.matrices, written.matrices, atol=1e-8)


def test_reads_what_others_write_and_sorts(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_text('# c\n\n1.5e0 1 2 3 0 0 0 1\n1.25 0,0,0 0 0 0 2\n7 0 0 0 0 0 0 1\n')
    read = read_tum(path)
    assert read.stamps_ns.tolist() == [1_250_000_000, 1_500_000_000, 7_000_000_000]
    assert np.allclose(read.poses[0].T_world_camera, np.eye(4))


@pytest.mark.parametrize(
    'line', ['1 2 3', '1 0 0 0 0 0 0 x', '1 0 0 0 0 0 0 0', '1 nan 0 0 0 0 0 1']
)
def test_a_bad_line_is_named(tmp_path, line):
    path = tmp_path / 'a.txt'
    path.write_text(f'0 0 0 0 0 0 0 1\n{line}\n')
    with pytest.raises(EvaluationError, match=r"a\.txt' line 2: expected"):
        read_tum(path)


def test_missing_and_empty_files_are_named(tmp_path):
    with pytest.raises(EvaluationError, match='is not a file'):
        read_tum(tmp_path / 'no.txt')
    (tmp_path / 'empty.txt').write_text('# nothing\n')
    with pytest.raises(EvaluationError, match='has no poses'):
        read_tum(tmp_path / 'empty.txt')


def test_the_old_file_survives_a_failed_write(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_text('old')

    def fail(aside):
        aside.write_text('half')
        raise OSError('disk full')

    with pytest.raises(OSError, match='disk full'):
        write_aside(path, fail)
    assert [p.name for p in tmp_path.iterdir()] == ['a.txt']
    assert path.read_text() == 'old'
