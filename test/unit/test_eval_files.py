"""The old file survives a failed write."""

from __future__ import annotations

import pytest

from bdgs_ros.eval.files import write_aside, write_text


def test_folders_are_made_and_files_replaced(tmp_path):
    path = tmp_path / 'a' / 'b.txt'
    write_text(path, 'one')
    write_text(path, 'two')
    assert path.read_text() == 'two'
    assert [p.name for p in path.parent.iterdir()] == ['b.txt']


def test_the_old_file_survives_a_failed_write(tmp_path):
    path = tmp_path / 'a.txt'
    path.write_text('old')

    def fail(aside):
        assert aside.suffix == '.txt'
        aside.write_text('half')
        raise OSError('disk full')

    with pytest.raises(OSError, match='disk full'):
        write_aside(path, fail)
    assert [p.name for p in tmp_path.iterdir()] == ['a.txt']
    assert path.read_text() == 'old'
