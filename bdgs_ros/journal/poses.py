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
    told = Told()
    for record in read_records(path):
        kind, entries = record[:1], _entries(record[1:], path)
        if kind == _POSE:
            told.poses += entries
        elif kind == _MOVE:
            told.moves += entries
        elif kind == _PIECE:
            told.pieces.append(entries)
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
    found = []
    for stamp_ns, *numbers in _ENTRY.iter_unpack(data):
        T = np.vstack([np.reshape(numbers, (3, 4)), [0.0, 0.0, 0.0, 1.0]])
        if se3.are_rigid(T):
            found.append(StampedPose(stamp_ns, T))
    return found
