"""
Where the messages of an uncompressed, indexed MCAP file lie.

rosbags reads whole chunks, several megabytes for one image. The file's own index says where each
message starts, so that opening a bag costs a few bytes per message and reading one costs only
that message. Layout: the MCAP specification, version 0, sections "Records" and "Summary".
"""

from __future__ import annotations

import struct
from collections.abc import Iterator
from io import BytesIO
from pathlib import Path
from typing import BinaryIO, NamedTuple

MAGIC = b'\x89MCAP0\r\n'
FOOTER_SIZE = 9 + 20 + len(MAGIC)
FOOTER, CHANNEL, CHUNK_INDEX, MESSAGE_INDEX, MESSAGE = 0x02, 0x04, 0x08, 0x07, 0x05
_CHUNK_HEADER = 9 + 8 + 8 + 8 + 4 + 4 + 8  # up to the records of a chunk without compression
_MESSAGE_HEADER = 2 + 4 + 8 + 8


class Entry(NamedTuple):
    """One message in the file."""

    log_ns: int
    position: int
    """Of the serialised bytes."""
    size: int


class CannotIndexError(Exception):
    """The file has no usable index: compressed, damaged or without a summary."""


class McapIndex:
    """Positions of the messages by topic; raises `CannotIndexError` where there is no index."""

    def __init__(self, path: Path) -> None:
        self._file: BinaryIO = path.open('rb')
        self._channels: dict[int, str] = {}
        self._chunks: list[tuple[int, dict[int, int]]] = []
        try:
            self._read_summary()
        except (struct.error, IndexError, UnicodeDecodeError, CannotIndexError) as error:
            self._file.close()
            raise CannotIndexError(str(error)) from error

    def close(self) -> None:
        """Close the file."""
        self._file.close()

    def _read_summary(self) -> None:
        end = self._file.seek(0, 2)
        if end < 2 * FOOTER_SIZE:
            raise CannotIndexError('too short')
        footer = self._read(end - FOOTER_SIZE, FOOTER_SIZE)
        (summary_start,) = struct.unpack_from('<Q', footer, 9)
        if footer[0] != FOOTER or not footer.endswith(MAGIC) or not summary_start:
            raise CannotIndexError('no summary')
        summary = BytesIO(self._read(summary_start, end - FOOTER_SIZE - summary_start))
        for kind, record in _records(summary):
            if kind == CHANNEL:
                channel, _ = struct.unpack_from('<HH', record)
                (length,) = struct.unpack_from('<I', record, 4)
                self._channels[channel] = record[8 : 8 + length].decode()
            elif kind == CHUNK_INDEX:
                self._add_chunk(record)

    def _add_chunk(self, record: bytes) -> None:
        _, _, start, _, map_size = struct.unpack_from('<QQQQI', record)
        offsets = dict(struct.iter_unpack('<HQ', record[36 : 36 + map_size]))
        (compression,) = struct.unpack_from('<I', record, 36 + map_size + 8)
        if compression:
            raise CannotIndexError('compressed')
        self._chunks.append((start, offsets))

    def entries(self, topic: str) -> list[Entry]:
        """Return the messages of a topic in order of their log time."""
        wanted = [channel for channel, name in self._channels.items() if name == topic]
        entries = [
            self._entry(log_ns, start + _CHUNK_HEADER + offset)
            for start, offsets in self._chunks
            for channel in wanted
            if channel in offsets
            for log_ns, offset in self._message_index(offsets[channel])
        ]
        return sorted(entries, key=lambda entry: entry.log_ns)

    def _message_index(self, position: int) -> Iterator[tuple[int, int]]:
        kind, _, _, size = struct.unpack('<BQHI', self._read(position, 15))
        if kind != MESSAGE_INDEX:
            raise CannotIndexError('damaged index')
        yield from struct.iter_unpack('<QQ', self._read(position + 15, size))

    def _entry(self, log_ns: int, position: int) -> Entry:
        kind, size = struct.unpack('<BQ', self._read(position, 9))
        if kind != MESSAGE:
            raise CannotIndexError('damaged index')
        return Entry(log_ns, position + 9 + _MESSAGE_HEADER, size - _MESSAGE_HEADER)

    def head(self, entry: Entry, size: int) -> bytes:
        """Read the first bytes of a message."""
        return self._read(entry.position, min(size, entry.size))

    def read(self, entry: Entry) -> bytes:
        """Read a message."""
        return self._read(entry.position, entry.size)

    def _read(self, position: int, size: int) -> bytes:
        self._file.seek(position)
        data = self._file.read(size)
        if len(data) != size:
            raise CannotIndexError(f'{size} bytes wanted at {position}, {len(data)} there')
        return data


def _records(stream: BytesIO) -> Iterator[tuple[int, bytes]]:
    while head := stream.read(9):
        kind, size = struct.unpack('<BQ', head)
        yield kind, stream.read(size)
