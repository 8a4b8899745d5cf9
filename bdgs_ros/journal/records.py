"""
A file of records that only grows, each with a checksum: a torn end costs the last ones alone.

A record is `mark, length, crc32, content`. What was written when the machine stopped may be cut
off; what a disk has spoilt is stepped over, and reading goes on at the next record that is whole.
"""

from __future__ import annotations

import os
import struct
import zlib
from pathlib import Path
from typing import BinaryIO

from bdgs_ros.core.errors import JournalError

_FILE = b'BDGSJRN1'
_MARK = b'\xa7\x4a'
_HEAD = struct.Struct('<2sII')
_LONGEST = 1 << 24  # bytes of a record: a length that was spoilt is not believed


def framed(content: bytes) -> bytes:
    """Return a record as it stands in the file."""
    return _HEAD.pack(_MARK, len(content), zlib.crc32(content)) + content


def framed_file(*contents: bytes) -> bytes:
    """Return a whole file of records."""
    return _FILE + b''.join(map(framed, contents))


def read_records(path: Path) -> list[bytes]:
    """
    Read all records that are whole, in order; none where there is no file.

    Raises
    ------
    JournalError
        If the file cannot be read, or is none of ours.

    """
    return [content for content, _ in _records(_content(path))]


def open_at_end(path: Path) -> BinaryIO:
    """
    Open a file to append records to, made if it is not there; a torn end is cut off.

    Raises
    ------
    JournalError
        If it is there and none of ours.
    OSError
        If it cannot be opened.

    """
    content = _content(path)
    path.parent.mkdir(parents=True, exist_ok=True)
    file = path.open('r+b' if content else 'w+b', buffering=0)
    end = max((end for _, end in _records(content)), default=len(_FILE) if content else 0)
    file.truncate(end)
    file.seek(end)
    if not end:
        file.write(_FILE)
        os.fsync(file.fileno())
    return file


def _content(path: Path) -> bytes:
    try:
        content = path.read_bytes() if path.exists() else b''
    except OSError as error:
        raise JournalError(f"journal '{path}' cannot be read: {error.strerror}") from error
    if content and not content.startswith(_FILE[: len(content)]):
        raise JournalError(f"'{path}' is no journal of bdgs_ros: move it away, or name another")
    return content if len(content) >= len(_FILE) else b''


def _records(content: bytes) -> list[tuple[bytes, int]]:
    """Return the records that are whole, and where each ends."""
    found, at = [], len(_FILE)
    while 0 <= at <= len(content) - _HEAD.size:
        mark, length, checksum = _HEAD.unpack_from(content, at)
        start = at + _HEAD.size
        record = content[start : start + length]
        is_whole = mark == _MARK and len(record) == length <= _LONGEST
        if is_whole and zlib.crc32(record) == checksum:
            found.append((record, start + length))
            at = start + length
        else:
            at = content.find(_MARK, at + 1)
    return found
