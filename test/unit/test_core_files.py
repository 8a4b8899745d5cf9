"""Files and folders appear whole or not at all."""

from __future__ import annotations

from pathlib import Path

import pytest

from bdgs_ros.core.files import (
    previous_folder,
    write_aside,
    write_bytes,
    write_folder_aside,
    write_text,
)


def fill_with(text: str):
    return lambda folder: (folder / 'content').write_text(text)


def names(folder: Path) -> list[str]:
    return sorted(path.name for path in folder.iterdir())


def test_parts_are_joined_and_nothing_is_left_beside(tmp_path):
    write_bytes(tmp_path / 'deep' / 'file.bin', b'ab', b'', b'c')
    assert (tmp_path / 'deep' / 'file.bin').read_bytes() == b'abc'
    assert names(tmp_path / 'deep') == ['file.bin']


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


def test_a_folder_replaces_an_older_one(tmp_path):
    folder = tmp_path / 'f'
    for text in ('one', 'two'):
        write_folder_aside(folder, fill_with(text))
    assert (folder / 'content').read_text() == 'two'
    assert names(tmp_path) == ['f']


def test_a_half_filled_folder_does_not_replace_the_old_one(tmp_path):
    folder = tmp_path / 'f'
    write_folder_aside(folder, fill_with('old'))

    def fail(aside: Path) -> None:
        (aside / 'content').write_text('half')
        raise OSError('disk full')

    with pytest.raises(OSError, match='disk full'):
        write_folder_aside(folder, fail)
    assert (folder / 'content').read_text() == 'old'
    assert names(tmp_path) == ['f']


@pytest.mark.parametrize('existed', [True, False])
def test_the_old_folder_comes_back_if_what_follows_fails(tmp_path, existed):
    folder = tmp_path / 'f'
    if existed:
        write_folder_aside(folder, fill_with('old'))

    def fail() -> None:
        assert (folder / 'content').read_text() == 'new'
        raise OSError('no')

    with pytest.raises(OSError, match='no'):
        write_folder_aside(folder, fill_with('new'), fail)
    assert names(tmp_path) == (['f'] if existed else [])
    if existed:
        assert (folder / 'content').read_text() == 'old'


def test_the_old_folder_can_be_found_while_the_new_one_is_unproven(tmp_path):
    folder = tmp_path / 'f'
    write_folder_aside(folder, fill_with('old'))
    seen = []

    def look() -> None:
        seen.append((previous_folder(folder) / 'content').read_text())

    write_folder_aside(folder, fill_with('new'), look)
    assert seen == ['old']


def test_leftovers_of_a_crash_are_no_obstacle(tmp_path):
    folder = tmp_path / 'f'
    for stale in (tmp_path / '.f.part', previous_folder(folder)):
        stale.mkdir()
        (stale / 'rubbish').write_text('')
    for text in ('one', 'two'):
        write_folder_aside(folder, fill_with(text))
    assert names(folder) == ['content']
    assert names(tmp_path) == ['f']
