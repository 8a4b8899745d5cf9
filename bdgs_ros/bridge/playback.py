"""What a bag holds, in the order in which replay publishes it; ROS-free."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from bdgs_ros.bridge.node_config import ReplayConfig
from bdgs_ros.bridge.synchroniser import Patience, SyncCounts, Synchroniser
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.bag import BagReader, header_stamp_ns
from bdgs_ros.data.bag_cursor import RawMessage
from bdgs_ros.data.bag_recording import CameraTopics, TopicLayout, find_layout
from bdgs_ros.data.trajectory_io import seconds_to_ns

_NOT_REPLAYED = ('/clock', '/rosout', '/parameter_events', '/diagnostics')
_OWN_PREFIX = '/bdgs/'


@dataclass(frozen=True)
class Pair:
    """A colour image and its depth, by the rule of the offline association."""

    stamp_ns: int
    """Of the colour image, from its header."""
    color: RawMessage
    depth: RawMessage


class Playback:
    """
    Read a bag from its start, as often as wanted.

    Parameters
    ----------
    reader : BagReader
        The open bag.
    config : ReplayConfig
        Topics, part of the bag, and the tolerance of pairs.

    Raises
    ------
    DatasetError
        If it is a ROS 1 bag, or its camera topics are neither known nor given.

    """

    def __init__(self, reader: BagReader, config: ReplayConfig) -> None:
        if reader.storage == 'ros1':
            raise DatasetError(
                f"'{reader.path}' is a ROS 1 bag, whose bytes ROS 2 does not speak; "
                f'convert it first: bdgs convert {reader.path} BAG'
            )
        self._reader = reader
        self._config = config
        names = CameraTopics(config.color_topic, config.depth_topic, config.info_topic)
        self.layout = find_layout(reader, names)
        self.counts = SyncCounts()
        self.topics = {
            name: info.msgtype
            for name, info in reader.topics.items()
            if name not in _NOT_REPLAYED and not name.startswith(_OWN_PREFIX)
        }

    def messages(self) -> Iterator[RawMessage]:
        """Yield everything in order of log time."""
        duration_s = self._config.duration or None
        return self._reader.raw_messages(list(self.topics), self._config.start, duration_s)

    def matched(self) -> Iterator[RawMessage | Pair]:
        """Yield colour and depth in pairs, leave unpaired ones out, and pass on the rest."""
        pairing = self.make_pairing()
        for message in self.messages():
            if message.topic in (self.layout.color, self.layout.depth):
                yield from pair_up(pairing, message, self.layout)
            else:
                yield message
        yield from flush(pairing)
        self.counts = pairing.counts

    def make_pairing(self) -> Synchroniser[RawMessage, RawMessage]:
        """Return a synchroniser that makes the pairs of the offline association."""
        return Synchroniser(
            seconds_to_ns(self._config.sync.tolerance_s),
            seconds_to_ns(self._config.sync.jump_back_s),
            Patience.STRICT,
        )


def pair_up(
    pairing: Synchroniser[RawMessage, RawMessage], message: RawMessage, layout: TopicLayout
) -> list[Pair]:
    """Feed an image to the synchroniser; return the pairs that it completes."""
    stamp_ns = header_stamp_ns(message.data)
    if message.topic == layout.color:
        return [_pair(*found) for found in pairing.add_left(stamp_ns, message)]
    return [_pair(*found) for found in pairing.add_right(stamp_ns, message)]


def flush(pairing: Synchroniser[RawMessage, RawMessage]) -> list[Pair]:
    """Return the pairs that are left at the end of the bag."""
    return [_pair(*found) for found in pairing.flush()]


def _pair(color: RawMessage, depth: RawMessage) -> Pair:
    return Pair(header_stamp_ns(color.data), color, depth)
