"""Read an MCAP file whose recording was cut off: the complete records, and nothing after them."""

from __future__ import annotations

import io
import struct
from pathlib import Path
from typing import BinaryIO

from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.mcap_index import MAGIC

_DATA_END = struct.pack('<BQI', 0x0F, 4, 0)
_FOOTER_WITHOUT_SUMMARY = struct.pack('<BQQQI', 0x02, 20, 0, 0, 0)
_DATA_END_KIND, _FOOTER_KIND = 0x0F, 0x02


class SalvagedMcap:
    """
    A truncated file, seen as a complete one without a summary, which MCAP readers must accept.

    Quacks like the `Path` that rosbags opens.
    """

    def __init__(self, path: Path) -> None:
        self._path = path
        self.name = path.name
        self.suffix = path.suffix
        self.complete_bytes = complete_bytes(path)

    def exists(self) -> bool:
        """Tell that the file is there."""
        return self._path.exists()

    def is_dir(self) -> bool:
        """Tell that this is a file."""
        return False

    def open(self, mode: str = 'rb') -> BinaryIO:
        """Open the complete part with an end put behind it."""
        tail = _DATA_END + _FOOTER_WITHOUT_SUMMARY + MAGIC
        return io.BufferedReader(_WithTail(self._path, self.complete_bytes, tail))

    def __str__(self) -> str:
        """Return the path."""
        return str(self._path)


def complete_bytes(path: Path) -> int:
    """Return where the last complete record of the data section ends."""
    with path.open('rb') as file:
        size = file.seek(0, 2)
        file.seek(0)
        if file.read(len(MAGIC)) != MAGIC:
            raise DatasetError(f"'{path}' is not an MCAP file: its first bytes are not {MAGIC!r}")
        end = len(MAGIC)
        while len(head := file.read(9)) == 9:
            kind, length = struct.unpack('<BQ', head)
            if kind in (_DATA_END_KIND, _FOOTER_KIND) or end + 9 + length > size:
                break
            end = file.seek(end + 9 + length)
    return end


class _WithTail(io.RawIOBase):
    """The first bytes of a file, followed by bytes from memory."""

    def __init__(self, path: Path, size: int, tail: bytes) -> None:
        super().__init__()
        self._file = path.open('rb')
        self._size, self._tail, self._position = size, tail, 0

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = 0) -> int:
        base = (0, self._position, self._size + len(self._tail))[whence]
        self._position = min(max(0, base + offset), self._size + len(self._tail))
        return self._position

    def tell(self) -> int:
        return self._position

    def readinto(self, buffer: bytearray | memoryview) -> int:  # type: ignore[override]
        wanted = len(buffer)
        if self._position < self._size:
            self._file.seek(self._position)
            data = self._file.read(min(wanted, self._size - self._position))
        else:
            start = self._position - self._size
            data = self._tail[start : start + wanted]
        buffer[: len(data)] = data
        self._position += len(data)
        return len(data)

    def close(self) -> None:
        self._file.close()
        super().close()
