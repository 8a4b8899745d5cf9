"""What killed processes leave in shared memory goes; what the living use stays."""

from __future__ import annotations

import fcntl
import os
import time
from pathlib import Path

import pytest

from bdgs_ros.bridge.leftovers import remove_leftovers


def an_old_file(path: Path, size: int = 100) -> Path:
    path.write_bytes(bytes(size))
    old = time.time() - 3600
    os.utime(path, (old, old))
    return path


def test_files_of_the_dead_go_with_their_locks(tmp_path: Path) -> None:
    for name in ('fastrtps_0123456789abcdef', 'fastrtps_port7411', 'fastrtps_port7413'):
        an_old_file(tmp_path / name)
    for name in ('fastrtps_0123456789abcdef_el', 'fastrtps_port7411_el', 'fastrtps_port7413_sl'):
        an_old_file(tmp_path / name, 0)
    an_old_file(tmp_path / 'sem.fastrtps_port7411_mutex', 32)
    assert remove_leftovers(tmp_path) == 300
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize('lock', ['_el', '_sl'])
def test_what_somebody_holds_stays(tmp_path: Path, lock: str) -> None:
    port = an_old_file(tmp_path / 'fastrtps_port7411')
    with an_old_file(tmp_path / f'fastrtps_port7411{lock}', 0).open('rb') as held:
        fcntl.flock(held, fcntl.LOCK_SH)
        assert remove_leftovers(tmp_path) == 0
    assert port.exists()
    assert remove_leftovers(tmp_path) == 100


def test_files_of_others_and_new_ones_stay(tmp_path: Path) -> None:
    an_old_file(tmp_path / 'sem.mp-x')
    an_old_file(tmp_path / 'fastrtps_notes.txt')
    (tmp_path / 'fastrtps_0123456789abcdef').touch()  # about to be locked
    assert remove_leftovers(tmp_path) == 0
    assert len(list(tmp_path.iterdir())) == 3


def test_a_place_without_shared_memory_is_no_error(tmp_path: Path) -> None:
    assert remove_leftovers(tmp_path / 'none') == 0
