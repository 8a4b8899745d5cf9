"""What tracking has said of every frame, record by record: its poses, moves and pieces of map."""

from __future__ import annotations

import struct
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from operator import attrgetter
from pathlib import Path

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.errors import JournalError
from bdgs_ros.core.types import Pose, StampedPose
from bdgs_ros.journal.records import read_records
from bdgs_ros.journal.writer import RecordWriter

_POSE, _MOVE, _PIECE = b'P', b'M', b'J'
_ENTRY = struct.Struct('<q12d')
"""Stamp in nanoseconds, and the first three rows of a motion."""
_ROWS = np.dtype([('stamp_ns', '<i8'), ('T', '<f8', (3, 4))])


@dataclass
class Told:
    """What tracking said, in order of time."""

    poses: list[StampedPose] = field(default_factory=list)
    moves: list[StampedPose] = field(default_factory=list)
    """By what it moved its world before a frame, `T_new_old`."""
    pieces: list[list[StampedPose]] = field(default_factory=list)
    """Frames that were placed after they were seen."""


def read_told(path: Path) -> Told:
    """
    Read what was written; nothing where there is no file.

    Raises
    ------
    JournalError
        If the file is none of ours.

    """
    records = read_records(path)
    by_kind = {
        kind: [record[1:] for record in records if record[:1] == kind]
        for kind in (_POSE, _MOVE, _PIECE)
    }
    told = Told(
        _entries(b''.join(by_kind[_POSE]), path),
        _entries(b''.join(by_kind[_MOVE]), path),
        [_entries(record, path) for record in by_kind[_PIECE]],
    )
    told.poses.sort(key=attrgetter('stamp_ns'))
    return told


class PoseJournal:
    """
    Writes it; nothing of this waits for the disk.

    Parameters
    ----------
    path, limit, on_problem, keep
        See `RecordWriter`.

    """

    def __init__(
        self, path: Path, limit: int, on_problem: Callable[[str], None], *, keep: bool
    ) -> None:
        self._writer = RecordWriter(path, limit, on_problem, keep=keep)

    def note_pose(self, stamp_ns: int, T_world_camera: Pose) -> None:
        """Take the pose of a frame."""
        self._writer.put(_POSE + _entry(stamp_ns, T_world_camera))

    def note_move(self, stamp_ns: int, T_new_old: Pose) -> None:
        """Take by what the world was moved before a frame."""
        self._writer.put(_MOVE + _entry(stamp_ns, T_new_old))

    def note_piece(self, poses: Sequence[StampedPose]) -> None:
        """Take the frames of a piece of map that has been placed."""
        entries = (_entry(pose.stamp_ns, pose.T_world_camera) for pose in poses)
        self._writer.put(_PIECE + b''.join(entries))

    def restart(self) -> None:
        """Forget everything: another world begins."""
        self._writer.restart()

    def close(self) -> None:
        """Write what waits, and end."""
        self._writer.close()


def _entry(stamp_ns: int, T: Pose) -> bytes:
    return _ENTRY.pack(stamp_ns, *T[:3].ravel())


def _entries(data: bytes, path: Path) -> list[StampedPose]:
    if len(data) % _ENTRY.size:
        raise JournalError(f"'{path}' is of another version of bdgs_ros: remove it")
    rows = np.frombuffer(data, _ROWS)
    poses = np.tile(np.eye(4), (len(rows), 1, 1))
    poses[:, :3] = rows['T']
    is_whole = se3.are_rigid(poses)  # all at once: a run of an hour has a hundred thousand
    return [
        StampedPose(int(stamp_ns), T)
        for stamp_ns, T in zip(rows['stamp_ns'], poses, strict=True)
        if is_whole or se3.are_rigid(T)
    ]
