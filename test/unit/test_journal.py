"""The journal: whatever dies leaves what came before it, and nothing else is believed."""

from __future__ import annotations

import errno
import os
import struct
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.errors import JournalError
from bdgs_ros.core.types import StampedPose
from bdgs_ros.journal import folder, records, writer
from bdgs_ros.journal.folder import Claim, poses_file, use
from bdgs_ros.journal.poses import PoseJournal, read_told
from bdgs_ros.journal.records import framed, framed_file, open_at_end, read_records

LIMIT = 1 << 20


def pose(i: int) -> np.ndarray:
    return se3.exp(0.01 * i * np.ones(6))


@pytest.fixture
def quick(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(writer, 'PERIOD_S', 0.01)


def wait(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_what_tracking_said_is_read_as_it_was(tmp_path: Path) -> None:
    file = tmp_path / 'deep' / 'poses.rec'
    journal = PoseJournal(file, LIMIT, lambda text: None, keep=False)
    for i in range(5):
        journal.note_pose(i, pose(i))
    journal.note_move(3, pose(7))
    journal.note_piece([StampedPose(8, pose(8)), StampedPose(9, pose(9))])
    journal.close()

    told = read_told(file)

    assert [p.stamp_ns for p in told.poses] == [0, 1, 2, 3, 4]
    assert all(np.array_equal(p.T_world_camera, pose(p.stamp_ns)) for p in told.poses)
    assert [(m.stamp_ns, m.T_world_camera.tolist()) for m in told.moves] == [(3, pose(7).tolist())]
    assert [[p.stamp_ns for p in piece] for piece in told.pieces] == [[8, 9]]


def test_a_journal_goes_on_or_begins_anew(tmp_path: Path) -> None:
    file = tmp_path / 'poses.rec'
    for i, keep in ((1, False), (2, True)):
        journal = PoseJournal(file, LIMIT, lambda text: None, keep=keep)
        journal.note_pose(i, pose(i))
        journal.close()
    assert [p.stamp_ns for p in read_told(file).poses] == [1, 2]

    journal = PoseJournal(file, LIMIT, lambda text: None, keep=True)
    journal.note_pose(3, pose(3))
    journal.restart()
    journal.note_pose(4, pose(4))
    journal.close()
    assert [p.stamp_ns for p in read_told(file).poses] == [4]


def test_a_torn_end_costs_the_last_record_wherever_it_is_torn(tmp_path: Path) -> None:
    whole = framed_file(b'first', b'second')
    file = tmp_path / 'poses.rec'
    for length in range(len(whole)):
        file.write_bytes(whole[:length])
        known = read_records(file)
        assert known == [b'first', b'second'][: len(known)]
        with open_at_end(file) as end:
            end.write(framed(b'third'))
        assert read_records(file) == [*known, b'third']


def test_a_spoilt_record_costs_itself_alone(tmp_path: Path) -> None:
    contents = [bytes([i]) * 20 for i in range(5)]
    whole = bytearray(framed_file(*contents))
    file = tmp_path / 'poses.rec'
    at = whole.index(contents[2])
    for spoilt in range(at - 10, at + 20):
        data = whole.copy()
        data[spoilt] ^= 0xFF
        file.write_bytes(data)
        assert read_records(file) == contents[:2] + contents[3:]


def test_a_length_that_lies_is_not_believed(tmp_path: Path) -> None:
    file = tmp_path / 'poses.rec'
    lie = struct.pack('<2sII', records._MARK, 0xFFFFFFFF, 0)
    file.write_bytes(framed_file(b'a') + lie + framed(b'b'))
    assert read_records(file) == [b'a', b'b']


def test_the_file_of_another_program_is_refused_and_stays(tmp_path: Path) -> None:
    file = tmp_path / 'poses.rec'
    file.write_bytes(b'something else altogether')
    with pytest.raises(JournalError, match='no journal of bdgs_ros'):
        read_records(file)
    with pytest.raises(JournalError):
        open_at_end(file)
    assert file.read_bytes() == b'something else altogether'


def test_a_full_disk_is_told_and_made_up_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, quick: None
) -> None:
    told: list[str] = []
    file = tmp_path / 'poses.rec'
    journal = PoseJournal(file, LIMIT, told.append, keep=False)
    journal.note_pose(1, pose(1))
    wait(lambda: len(read_told(file).poses) == 1)

    real = writer._write_all

    def full(out: object, data: bytes) -> None:
        real(out, data[: len(data) // 2])
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(writer, '_write_all', full)
    journal.note_pose(2, pose(2))
    wait(lambda: bool(told))
    assert 'No space left' in told[0]
    assert [p.stamp_ns for p in read_told(file).poses] == [1]

    monkeypatch.setattr(writer, '_write_all', real)
    journal.note_pose(3, pose(3))
    wait(lambda: len(read_told(file).poses) == 3)
    wait(lambda: told[-1] == '')
    journal.close()


def test_the_limit_holds_and_is_told(tmp_path: Path) -> None:
    told: list[str] = []
    file = tmp_path / 'poses.rec'
    journal = PoseJournal(file, 400, told.append, keep=False)
    for i in range(3):
        journal.note_pose(i, pose(i))
    journal.close()
    journal = PoseJournal(file, 400, told.append, keep=True)
    for i in range(3, 50):
        journal.note_pose(i, pose(i))
    journal.close()
    assert file.stat().st_size <= 400
    assert [p.stamp_ns for p in read_told(file).poses] == [0, 1, 2]
    assert 'journal.limit_mb' in told[-1]


def test_a_folder_is_of_one_graph(tmp_path: Path) -> None:
    first = Claim([tmp_path / 'a', tmp_path / 'b'], keep=False)
    second = Claim([tmp_path / 'a', tmp_path / 'b'], keep=False)
    assert (first.folder.name, second.folder.name) == ('a', 'b')
    with pytest.raises(JournalError, match='in use by another graph'):
        Claim([tmp_path / 'a'], keep=True)
    first.remove()
    assert not (tmp_path / 'a').exists()
    Claim([tmp_path / 'a'], keep=True)


def test_nodes_that_outlive_their_graph_are_waited_for(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    Claim([tmp_path / 'a'], keep=False)._lock.close()
    used = use(tmp_path / 'a')
    threading.Timer(0.3, used.close).start()
    started = time.monotonic()
    Claim([tmp_path / 'a'], keep=False)._lock.close()
    assert time.monotonic() - started > 0.2
    with use(tmp_path / 'a'):
        monkeypatch.setattr(folder, '_PATIENCE_S', 0.2)
        with pytest.raises(JournalError, match='nodes of an earlier graph still write'):
            Claim([tmp_path / 'a'], keep=True)


def test_a_new_run_begins_without_the_old_one(tmp_path: Path) -> None:
    claim = Claim([tmp_path / 'a'], keep=False)
    file = poses_file(claim.folder)
    PoseJournal(file, LIMIT, lambda text: None, keep=False).close()
    claim._lock.close()
    Claim([tmp_path / 'a'], keep=True)._lock.close()
    assert file.exists()
    Claim([tmp_path / 'a'], keep=False)
    assert not file.exists()
