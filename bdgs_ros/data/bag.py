"""
Open a bag, of ROS 2 (mcap or sqlite3) or ROS 1, and read its messages.

`BagReader.raw_messages` gives the serialised bytes untouched, for replay; `index` and `read` give
single messages by their header stamp, for sequences.
"""

from __future__ import annotations

import struct
from collections.abc import Collection, Iterator
from contextlib import suppress
from pathlib import Path
from types import TracebackType
from typing import Any, NamedTuple

from rosbags.highlevel import AnyReader
from rosbags.interfaces import Connection

from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.bag_cursor import BagCursor, MessageKey, RawMessage
from bdgs_ros.data.mcap_index import CannotIndexError, Entry, McapIndex
from bdgs_ros.data.mcap_salvage import SalvagedMcap
from bdgs_ros.data.messages import jazzy
from bdgs_ros.data.trajectory_io import NS_PER_S, seconds_to_ns

METADATA_FILE = 'metadata.yaml'
STORAGE_SUFFIXES = {'.mcap': 'mcap', '.db3': 'sqlite3'}
_HEAD_SIZE = 12  # a CDR or ROS 1 message that starts with a header has its stamp in bytes 4 to 12


class TopicInfo(NamedTuple):
    """What a topic carries."""

    msgtype: str
    count: int  # type: ignore[assignment]  # hides tuple.count, which nobody misses


class MessageRef(NamedTuple):
    """Where to find one message again."""

    stamp_ns: int
    """The header's stamp."""
    log_ns: int
    nth: int
    """Among the messages of its topic with the same log time."""
    entry: Entry | None


def header_stamp_ns(data: bytes, ros1: bool = False) -> int:
    """
    Return the stamp of a serialised message whose type starts with a std_msgs/Header.

    Four bytes precede it: the encapsulation of CDR, or the sequence number of ROS 1.
    """
    big_endian = not ros1 and data[1] == 0
    seconds, nanoseconds = struct.unpack_from('>iI' if big_endian else '<iI', data, 4)
    return int(seconds) * NS_PER_S + int(nanoseconds)


def open_bag(path: Path | str, allow_truncated: bool = False) -> BagReader:
    """
    Open a rosbag2 folder, a single `.mcap` or `.db3` file, or a ROS 1 `.bag`.

    Parameters
    ----------
    path : Path or str
        Where the bag is.
    allow_truncated : bool
        Read what is left of a recording that was cut off, instead of refusing it.

    Raises
    ------
    DatasetError
        If there is no bag, or it is damaged or cut off.

    """
    return BagReader(Path(path), allow_truncated)


def is_bag(path: Path) -> bool:
    """Tell whether a path looks like a bag, whole or damaged."""
    if path.is_dir():
        return (path / METADATA_FILE).is_file() or bool(_storage_files(path))
    return path.suffix in ('.bag', *STORAGE_SUFFIXES)


def _storage_files(folder: Path) -> list[Path]:
    return sorted(file for file in folder.iterdir() if _storage_of(file) is not None)


def _storage_of(file: Path) -> str | None:
    name = file.name.removesuffix('.zstd')
    return STORAGE_SUFFIXES.get(Path(name).suffix)


class BagReader:
    """
    An open bag; close it, or use it in a `with` statement.

    Attributes
    ----------
    topics : dict of str to TopicInfo
        Type and number of messages of each topic.
    start_ns, end_ns : int
        Log time of the first and the last message; 0 in an empty bag.
    storage : str
        `mcap`, `sqlite3` or `ros1`.

    """

    def __init__(self, path: Path, allow_truncated: bool = False) -> None:
        self.path = path
        self.truncated = False
        self._fast: McapIndex | None = None
        self._cursor: BagCursor | None = None
        self._indexed: set[str] = set()
        self._reader = self._open(allow_truncated)
        self.topics = {
            name: TopicInfo(info.msgtype or 'several types', info.msgcount)
            for name, info in self._reader.topics.items()
        }
        empty = not self._reader.message_count
        self.start_ns = 0 if empty else self._reader.start_time
        self.end_ns = 0 if empty else self._reader.end_time - 1

    @property
    def storage(self) -> str:
        """The format on disk."""
        if self.path.suffix == '.bag' and self.path.is_file():
            return 'ros1'
        return next((s for s in map(_storage_of, self._files()) if s), 'no storage')

    @property
    def duration_s(self) -> float:
        """Time from the first to the last message."""
        return (self.end_ns - self.start_ns) / NS_PER_S

    def _metadata_file(self) -> Path:
        return self.path / METADATA_FILE

    def _files(self) -> list[Path]:
        return _storage_files(self.path) if self.path.is_dir() else [self.path]

    def _open(self, allow_truncated: bool) -> AnyReader:
        self._check_path()
        try:
            reader = self._attempt([self.path])
        except DatasetError as error:
            if not allow_truncated or self.storage == 'ros1':
                raise self._explain(error) from error
            reader = self._attempt([_salvage(file) for file in self._files()])
            self.truncated = True
        self._fast = None if self.truncated else self._open_index(reader)
        return reader

    def _open_index(self, reader: AnyReader) -> McapIndex | None:
        files = self._files()
        compressed = self.storage != 'mcap' or getattr(reader.readers[0], 'compression_mode', None)
        if not compressed and len(files) == 1:
            with suppress(CannotIndexError):
                return McapIndex(files[0])
        return None

    def _check_path(self) -> None:
        if not self.path.exists():
            raise DatasetError(f"there is no bag at '{self.path}'")
        if not is_bag(self.path):
            raise DatasetError(
                f"'{self.path}' is not a bag; expected a rosbag2 folder with {METADATA_FILE}, "
                'a .mcap or .db3 file, or a ROS 1 .bag'
            )

    def _attempt(self, paths: list[Any]) -> AnyReader:
        if paths == [self.path] and self.path.is_dir() and not self._metadata_file().is_file():
            raise DatasetError(f"'{self.path}' cannot be read as a bag: it has no {METADATA_FILE}")
        try:
            reader = AnyReader(paths, default_typestore=jazzy())
            reader.open()
        except Exception as error:  # foreign bytes make the parsers raise anything
            raise DatasetError(f"'{self.path}' cannot be read as a bag: {_say(error)}") from error
        return reader

    def _explain(self, error: DatasetError) -> DatasetError:
        if self.storage == 'ros1':
            return DatasetError(
                f'{error}; expected a complete, indexed ROS 1 bag of format 2.0 '
                '(`rosbag reindex` mends one whose recording was cut off)'
            )
        return DatasetError(
            f'{error}; expected a complete rosbag2 recording. If it was cut off, '
            '--allow-truncated reads what is there'
        )

    def __enter__(self) -> BagReader:
        """Return itself."""
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Close the bag."""
        self.close()

    def close(self) -> None:
        """Close the bag; a second time does nothing."""
        if self._fast is not None:
            self._fast.close()
        if self._reader.stack is not None:
            self._reader.close()

    def _connections(self, topics: Collection[str] | None) -> list[Connection]:
        if topics is None:
            return list(self._reader.connections)
        unknown = [topic for topic in topics if topic not in self.topics]
        if unknown:
            found = ', '.join(sorted(self.topics)) or 'no topics'
            raise DatasetError(f"'{self.path}' has no topic {', '.join(unknown)}; it has {found}")
        return [conn for conn in self._reader.connections if conn.topic in topics]

    def raw_messages(
        self,
        topics: Collection[str] | None = None,
        start_s: float = 0.0,
        duration_s: float | None = None,
    ) -> Iterator[RawMessage]:
        """
        Yield the messages in order of their log time, as serialised bytes.

        Parameters
        ----------
        topics : collection of str, optional
            Only these; all by default.
        start_s : float
            Skip this much of the bag, in seconds from its first message.
        duration_s : float, optional
            Stop after this much; by default at the end.

        Raises
        ------
        DatasetError
            For an unknown topic, or if the file turns out to be damaged on the way.

        """
        connections = self._connections(topics)
        start_ns = self.start_ns + seconds_to_ns(start_s)
        stop_ns = self.end_ns + 1
        if duration_s is not None:
            stop_ns = min(stop_ns, start_ns + seconds_to_ns(duration_s))
        return self._messages(connections, start_ns, stop_ns)

    def _messages(
        self, connections: list[Connection], start_ns: int, stop_ns: int
    ) -> Iterator[RawMessage]:
        if not connections or start_ns >= stop_ns:
            return
        try:
            for conn, log_ns, data in self._reader.messages(connections, start_ns, stop_ns):
                yield RawMessage(conn.topic, conn.msgtype, log_ns, data)
        except GeneratorExit:
            raise
        except Exception as error:  # as in _attempt
            raise DatasetError(f"'{self.path}' is damaged: {_say(error)}") from error

    def deserialize(self, data: bytes, msgtype: str) -> Any:
        """Decode one message; `DatasetError` if its bytes do not fit the type."""
        try:
            return self._reader.deserialize(data, msgtype)
        except Exception as error:  # as in _attempt
            raise DatasetError(
                f"'{self.path}': a {msgtype} cannot be decoded: {_say(error)}"
            ) from error

    def messages(self, topics: Collection[str]) -> Iterator[tuple[RawMessage, Any]]:
        """Yield the messages of some topics, decoded too."""
        for raw in self.raw_messages(topics):
            yield raw, self.deserialize(raw.data, raw.msgtype)

    def index(self, topics: Collection[str]) -> dict[str, list[MessageRef]]:
        """Return where the messages of some topics are, each topic in order of header stamps."""
        self._indexed |= set(topics)
        self._connections(topics)
        refs = self._fast_index(topics) or self._slow_index(topics)
        return {topic: sorted(refs[topic], key=lambda ref: ref.stamp_ns) for topic in topics}

    def _fast_index(self, topics: Collection[str]) -> dict[str, list[MessageRef]] | None:
        if self._fast is None:
            return None
        try:
            return {topic: _refs_from_mcap(self._fast, topic) for topic in topics}
        except (CannotIndexError, struct.error):
            self._fast = None
            return None

    def _slow_index(self, topics: Collection[str]) -> dict[str, list[MessageRef]]:
        refs: dict[str, list[MessageRef]] = {topic: [] for topic in topics}
        ros1 = self.storage == 'ros1'
        for raw in self.raw_messages(topics):
            ref = MessageRef(header_stamp_ns(raw.data, ros1), raw.stamp_ns, 0, None)
            refs[raw.topic].append(_next(refs[raw.topic], ref))
        return refs

    def read(self, topic: str, ref: MessageRef) -> bytes:
        """Read one message again; nearly in order is quick in every storage."""
        if self._fast is not None and ref.entry is not None:
            return self._fast.read(ref.entry)
        key = MessageKey(topic, ref.log_ns, ref.nth)
        data = None if self._cursor is None else self._cursor.find(key)
        if data is None:
            connections = self._connections({topic} | self._indexed)
            self._cursor = BagCursor(self._messages(connections, ref.log_ns, self.end_ns + 1))
            data = self._cursor.find(key)
        if data is None:
            raise DatasetError(f"'{self.path}': message of '{topic}' at {ref.log_ns} ns has gone")
        return data


def _refs_from_mcap(index: McapIndex, topic: str) -> list[MessageRef]:
    refs: list[MessageRef] = []
    for entry in index.entries(topic):
        stamp_ns = header_stamp_ns(index.head(entry, _HEAD_SIZE))
        refs.append(_next(refs, MessageRef(stamp_ns, entry.log_ns, 0, entry)))
    return refs


def _next(refs: list[MessageRef], ref: MessageRef) -> MessageRef:
    """Number messages that were logged at the same time."""
    same = bool(refs) and refs[-1].log_ns == ref.log_ns
    return ref._replace(nth=refs[-1].nth + 1) if same else ref


def _salvage(file: Path) -> Path | SalvagedMcap:
    return SalvagedMcap(file) if file.suffix == '.mcap' else file


def _say(error: Exception) -> str:
    return str(error) or type(error).__name__
