"""
A sensor_msgs/Image as it came off the wire, its pixels not copied; ROS-free.

rclpy turns every message into Python objects before its callback sees it: 0.7 ms for a 640x480
colour image, with the interpreter lock held, in each of three nodes. A raw subscription hands over
the bytes; the few fields before the pixels are read here, and whoever wants the pixels views them.
"""

from __future__ import annotations

import struct
from dataclasses import dataclass

from bdgs_ros.core.errors import DatasetError

_ENCAPSULATION = 4  # bytes; alignment counts from behind them


@dataclass(frozen=True)
class CdrStamp:
    """A builtin_interfaces/Time."""

    sec: int
    nanosec: int


@dataclass(frozen=True)
class CdrHeader:
    """A std_msgs/Header."""

    stamp: CdrStamp
    frame_id: str


@dataclass(frozen=True)
class CdrImage:
    """The fields of an Image under their names, so that either can be decoded."""

    header: CdrHeader
    height: int
    width: int
    encoding: str
    is_bigendian: int
    step: int
    data: memoryview


def image_from_cdr(message: bytes) -> CdrImage:
    """
    Read an Image in plain CDR, of either byte order.

    Parameters
    ----------
    message : bytes
        With its encapsulation; the image keeps it alive.

    Raises
    ------
    DatasetError
        If it ends too early.

    """
    try:
        return _Reader(message).image()
    except (struct.error, UnicodeDecodeError, IndexError) as error:
        raise DatasetError(
            f'a message of {len(message)} bytes is no sensor_msgs/Image: {error}'
        ) from error


class _Reader:
    """Take values one after the other, each aligned to its size."""

    def __init__(self, message: bytes) -> None:
        self._message = message
        self._order = '<' if message[1] & 1 else '>'
        self._at = _ENCAPSULATION

    def image(self) -> CdrImage:
        header = CdrHeader(CdrStamp(self._int32(), self._uint32()), self._text())
        height, width, encoding = self._uint32(), self._uint32(), self._text()
        bigendian = self._message[self._at]
        self._at += 1
        step, size = self._uint32(), self._uint32()
        data = memoryview(self._message)[self._at : self._at + size]
        if len(data) < size:
            raise IndexError(f'{size} bytes of pixels announced, {len(data)} left')
        return CdrImage(header, height, width, encoding, bigendian, step, data)

    def _int32(self) -> int:
        return self._four('i')

    def _uint32(self) -> int:
        return self._four('I')

    def _four(self, kind: str) -> int:
        self._at += -(self._at - _ENCAPSULATION) % 4
        (value,) = struct.unpack_from(self._order + kind, self._message, self._at)
        self._at += 4
        return int(value)

    def _text(self) -> str:
        size = self._uint32()
        text = self._message[self._at : self._at + size]
        self._at += size
        return text.rstrip(b'\0').decode()
