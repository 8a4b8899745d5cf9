"""Write any recording as a rosbag2, the way the camera would have published it."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from rosbags.interfaces import (
    Qos,
    QosDurability,
    QosHistory,
    QosLiveliness,
    QosReliability,
    QosTime,
)
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from tqdm import tqdm

from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import DepthImage
from bdgs_ros.data.associate import MAX_DIFFERENCE_S
from bdgs_ros.data.bag_recording import (
    COLOR_TOPIC,
    DEPTH_TOPIC,
    GROUND_TRUTH_TOPIC,
    INFO_TOPIC,
)
from bdgs_ros.data.layouts import open_recording
from bdgs_ros.data.messages import (
    CAMERA_INFO,
    IMAGE,
    POSE_STAMPED,
    jazzy,
    serialize_camera_info,
    serialize_image,
    serialize_pose,
)
from bdgs_ros.data.sequence import RecordedSequence, Recording
from bdgs_ros.data.trajectory_io import NS_PER_S, seconds_to_ns

STORAGES = {'mcap': StoragePlugin.MCAP, 'sqlite3': StoragePlugin.SQLITE3}
COMPRESSIONS = ('none', 'zstd')
DEPTH_ENCODINGS = ('32FC1', '16UC1')
CAMERA_FRAME = 'camera_color_optical_frame'
WORLD_FRAME = 'map'
_TOPICS = {
    GROUND_TRUTH_TOPIC: POSE_STAMPED,
    INFO_TOPIC: CAMERA_INFO,
    COLOR_TOPIC: IMAGE,
    DEPTH_TOPIC: IMAGE,
}
_ORDER = list(_TOPICS)  # among messages of the same stamp: camera_info before its image
_UINT16_MAX = 65535
_FOREVER = QosTime(9223372036, 854775807)
_QOS = Qos(
    QosHistory.KEEP_LAST,
    10,
    QosReliability.RELIABLE,
    QosDurability.VOLATILE,
    _FOREVER,
    _FOREVER,
    QosLiveliness.AUTOMATIC,
    _FOREVER,
    False,
)


@dataclass(frozen=True)
class ConvertOptions:
    """How a recording becomes a bag."""

    storage: str = 'mcap'
    compression: str = 'none'
    depth_encoding: str = '32FC1'
    """`32FC1` keeps the 0.2 mm steps of TUM and BONN; `16UC1` rounds to mm and halves the size."""
    start_s: float = 0.0
    duration_s: float | None = None
    max_difference_s: float = MAX_DIFFERENCE_S
    force: bool = False
    progress: bool = False

    def __post_init__(self) -> None:
        """Refuse what cannot be done."""
        for name, allowed in (
            ('storage', tuple(STORAGES)),
            ('compression', COMPRESSIONS),
            ('depth_encoding', DEPTH_ENCODINGS),
        ):
            if getattr(self, name) not in allowed:
                raise DatasetError(
                    f'{name} {getattr(self, name)!r} is refused: allowed is {", ".join(allowed)}'
                )
        if self.start_s < 0 or (self.duration_s is not None and self.duration_s <= 0):
            raise DatasetError(
                f'start {self.start_s} s must be 0 or more, duration {self.duration_s} s above 0'
            )


@dataclass(frozen=True)
class ConvertReport:
    """What was written."""

    bag: Path
    counts: dict[str, int]
    pairs: int
    unpaired_color: tuple[str, ...]
    duration_s: float
    size_bytes: int
    damaged: tuple[str, ...] = ()
    """What was wrong with images that were left out."""


class _Event(NamedTuple):
    """One message to be written; sorts by stamp, then by topic."""

    stamp_ns: int
    order: int
    item: int


def convert(
    source: Path | str | Recording,
    bag: Path | str,
    options: ConvertOptions | None = None,
    camera_file: Path | str | None = None,
) -> ConvertReport:
    """
    Convert a recording to a rosbag2; what stands at the target appears complete or not at all.

    Every colour image goes in, also those without a depth partner, and every depth image, with
    the stamps they were recorded with.

    Parameters
    ----------
    source : Path, str or Recording
        Any layout that `open_recording` knows, or an open recording.
    bag : Path or str
        The folder to make.
    options : ConvertOptions, optional
        Storage, encodings, the part to convert.
    camera_file : Path or str, optional
        A `camera.yaml` that overrules what is known about the camera.

    Raises
    ------
    DatasetError
        If the source cannot be read, holds no frame, or the target exists or cannot be written.

    """
    options = options or ConvertOptions()
    bag = Path(bag)
    _check_target(bag, options.force)
    if isinstance(source, str | Path):
        source = open_recording(source, camera_file)
    events = _events(source, options)
    _check_space(bag, source, events, options)
    with _aside(bag, options.force) as folder:
        damaged = _write(folder, source, events, options)
    return _report(bag, source, events, options, damaged)


def _check_target(bag: Path, force: bool) -> None:
    if bag.exists() and not force:
        raise DatasetError(f"'{bag}' exists already; remove it, or overwrite it with --force")
    if bag.exists() and not (bag / 'metadata.yaml').is_file():
        raise DatasetError(f"'{bag}' exists and is not a bag; --force replaces only bags")


def _events(recording: Recording, options: ConvertOptions) -> list[_Event]:
    """List the messages in order of time, cut to the part asked for."""
    first_ns = int(recording.color_stamps_ns[0])
    low = first_ns + seconds_to_ns(options.start_s)
    high = None if options.duration_s is None else low + seconds_to_ns(options.duration_s)
    truth = recording.ground_truth
    stamps: dict[str, Iterable[int]] = {
        GROUND_TRUTH_TOPIC: [] if truth is None else truth.stamps_ns,
        INFO_TOPIC: recording.color_stamps_ns,
        COLOR_TOPIC: recording.color_stamps_ns,
        DEPTH_TOPIC: recording.depth_stamps_ns,
    }
    whole = options.start_s == 0 and high is None
    margin_ns = seconds_to_ns(options.max_difference_s)  # partners of the first and last image
    events = []
    for topic, values in stamps.items():
        margin = 0 if topic in (INFO_TOPIC, COLOR_TOPIC) else margin_ns
        events += [
            _Event(int(stamp), _ORDER.index(topic), index)
            for index, stamp in enumerate(values)
            if whole or (low - margin <= stamp and (high is None or stamp <= high + margin))
        ]
    if not any(event.order == _ORDER.index(COLOR_TOPIC) for event in events):
        length_s = (int(recording.color_stamps_ns[-1]) - first_ns) / NS_PER_S
        raise DatasetError(
            f"'{recording.name}' is {length_s:.2f} s long: nothing lies after start "
            f'{options.start_s} s'
        )
    return sorted(events)


def _check_space(
    bag: Path, recording: Recording, events: list[_Event], options: ConvertOptions
) -> None:
    pixels = recording.camera.width * recording.camera.height
    per_pixel = {COLOR_TOPIC: 3, DEPTH_TOPIC: 4 if options.depth_encoding == '32FC1' else 2}
    needed = sum(pixels * per_pixel.get(_ORDER[event.order], 0) for event in events)
    parent = _existing_parent(bag)
    free = shutil.disk_usage(parent).free
    if options.compression == 'none' and needed > free:
        raise DatasetError(
            f"'{bag}' needs {needed / 1e9:.2f} GB, but '{parent}' has only "
            f'{free / 1e9:.2f} GB free'
        )


def _existing_parent(path: Path) -> Path:
    return next(parent for parent in path.resolve().parents if parent.exists())


@contextmanager
def _aside(bag: Path, force: bool) -> Iterator[Path]:
    """Give a folder to write to that becomes `bag` at the end, and is removed on any failure."""
    aside = bag.resolve().parent / f'.{bag.name}.partial-{os.getpid()}'
    replaced = aside / '.replaced'
    try:
        shutil.rmtree(aside, ignore_errors=True)
        aside.mkdir(parents=True)
        # the storage file is named after its folder
        yield aside / bag.name
        if bag.exists() and force:
            bag.rename(replaced)
        (aside / bag.name).rename(bag)
    except OSError as error:
        raise DatasetError(f"cannot write '{bag}': {error}") from error
    finally:
        if replaced.exists() and not bag.exists():
            replaced.rename(bag)
        shutil.rmtree(aside, ignore_errors=True)


def _write(
    folder: Path, recording: Recording, events: list[_Event], options: ConvertOptions
) -> list[str]:
    """Write what can be read; return what was wrong with the rest."""
    # version 9 is what Jazzy writes
    writer = Writer(folder, version=9, storage_plugin=STORAGES[options.storage])
    if options.compression == 'zstd':
        in_chunks = options.storage == 'mcap'
        mode = CompressionMode.STORAGE if in_chunks else CompressionMode.MESSAGE
        writer.set_compression(mode, CompressionFormat.ZSTD)
    writer.set_custom_data('source', recording.name)
    with writer:
        connections = [
            writer.add_connection(topic, msgtype, typestore=jazzy(), offered_qos_profiles=[_QOS])
            for topic, msgtype in _TOPICS.items()
            if topic != GROUND_TRUTH_TOPIC or recording.ground_truth is not None
        ]
        by_topic = {connection.topic: connection for connection in connections}
        bar = tqdm(
            events, unit='msg', desc=folder.name, disable=None if options.progress else True
        )
        damaged: list[str] = []
        has_color = False
        for event in bar:
            try:
                data = _serialize(recording, event, options.depth_encoding)
            except DatasetError as error:
                damaged.append(str(error))
                continue
            has_color = has_color or _ORDER[event.order] == COLOR_TOPIC
            writer.write(by_topic[_ORDER[event.order]], event.stamp_ns, data)
    if damaged and not has_color:
        raise DatasetError(damaged[0])
    return damaged


def _serialize(recording: Recording, event: _Event, depth_encoding: str) -> bytes:
    topic = _ORDER[event.order]
    if topic == COLOR_TOPIC:
        color = recording.read_color(event.item)
        return serialize_image(event.stamp_ns, CAMERA_FRAME, color, 'rgb8')
    if topic == DEPTH_TOPIC:
        depth = encode_depth(recording.read_depth(event.item), depth_encoding)
        return serialize_image(event.stamp_ns, CAMERA_FRAME, depth, depth_encoding)
    if topic == INFO_TOPIC:
        return serialize_camera_info(event.stamp_ns, CAMERA_FRAME, recording.camera)
    truth = recording.ground_truth
    if truth is None:
        raise DatasetError(f"'{recording.name}' has no ground truth")
    return serialize_pose(event.stamp_ns, WORLD_FRAME, truth.poses[event.item].T_world_camera)


def encode_depth(depth_m: DepthImage, encoding: str) -> np.ndarray[Any, Any]:
    """Turn metres into what a depth encoding carries; beyond 65.535 m, `16UC1` has no depth."""
    if encoding == '32FC1':
        return depth_m
    millimetres = np.rint(depth_m * np.float32(1000))
    return np.where(millimetres > _UINT16_MAX, 0, millimetres).astype(np.uint16)


def _report(
    bag: Path,
    recording: Recording,
    events: list[_Event],
    options: ConvertOptions,
    damaged: list[str],
) -> ConvertReport:
    counts = np.bincount([event.order for event in events], minlength=len(_ORDER))
    color = [event.item for event in events if _ORDER[event.order] == COLOR_TOPIC]
    sequence = RecordedSequence(recording, options.max_difference_s)
    paired = {i for i, _ in sequence.pairs}
    stamps = [event.stamp_ns for event in events]
    return ConvertReport(
        bag=bag,
        counts={topic: int(counts[i]) for i, topic in enumerate(_ORDER) if counts[i]},
        pairs=sum(index in paired for index in color),
        unpaired_color=tuple(recording.color_name(i) for i in color if i not in paired),
        duration_s=(max(stamps) - min(stamps)) / NS_PER_S,
        damaged=tuple(damaged),
        size_bytes=sum(file.stat().st_size for file in bag.rglob('*') if file.is_file()),
    )
