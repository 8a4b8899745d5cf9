"""What is in a recording: topics, rates, gaps, pairs, camera, ground truth."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.bag import BagReader, is_bag, open_bag
from bdgs_ros.data.bag_recording import CameraTopics
from bdgs_ros.data.layouts import open_recording
from bdgs_ros.data.sequence import RecordedSequence, Recording
from bdgs_ros.data.trajectory_io import NS_PER_S

_GAP_PERIODS = 1.8  # one missing image makes two periods


@dataclass(frozen=True)
class Topic:
    """A topic of a bag."""

    name: str
    msgtype: str
    count: int


@dataclass(frozen=True)
class Gap:
    """A stretch without images."""

    at_s: float
    """Where it begins, from the first image."""
    length_s: float


@dataclass(frozen=True)
class Stream:
    """The stamps of one kind of images."""

    name: str
    count: int
    rate_hz: float
    """One over the median period."""
    out_of_order: int
    gaps: tuple[Gap, ...]


@dataclass(frozen=True)
class Summary:
    """What is in a recording; without images only the topics and the `problem` are told."""

    path: str
    kind: str
    duration_s: float
    truncated: bool
    topics: tuple[Topic, ...]
    color: Stream | None = None
    depth: Stream | None = None
    camera: PinholeCamera | None = None
    pairs: int = 0
    unpaired_color: tuple[str, ...] = ()
    ground_truth_poses: int = 0
    problem: str = ''


def summarise(
    path: Path | str,
    camera_file: Path | str | None = None,
    allow_truncated: bool = False,
    topics: CameraTopics | None = None,
) -> Summary:
    """Look into a recording; `DatasetError` if it cannot be opened at all."""
    path = Path(path)
    if path.exists() and is_bag(path) and not (path / 'rgb.txt').is_file():
        return _summarise_bag(path, camera_file, allow_truncated, topics)
    recording = open_recording(path, camera_file)
    stamps = recording.color_stamps_ns
    duration_s = float(stamps[-1] - stamps[0]) / NS_PER_S
    return _with_images(Summary(str(path), 'folder', duration_s, False, ()), recording)


def _summarise_bag(
    path: Path,
    camera_file: Path | str | None,
    allow_truncated: bool,
    topics: CameraTopics | None,
) -> Summary:
    with open_bag(path, allow_truncated) as reader:
        summary = _topics(reader)
    try:
        recording = open_recording(path, camera_file, allow_truncated, topics)
        return _with_images(summary, recording)
    except DatasetError as error:
        return Summary(**{**vars(summary), 'problem': str(error)})


def _topics(reader: BagReader) -> Summary:
    topics = tuple(
        Topic(name, info.msgtype, info.count) for name, info in sorted(reader.topics.items())
    )
    kind = f'{reader.storage} bag'
    return Summary(str(reader.path), kind, reader.duration_s, reader.truncated, topics)


def _with_images(summary: Summary, recording: Recording) -> Summary:
    sequence = RecordedSequence(recording)
    truth = recording.ground_truth
    return Summary(
        path=summary.path,
        kind=summary.kind,
        duration_s=summary.duration_s,
        truncated=summary.truncated,
        topics=summary.topics,
        color=_stream('colour', recording.color_stamps_ns),
        depth=_stream('depth', recording.depth_stamps_ns),
        camera=recording.camera,
        pairs=len(sequence),
        unpaired_color=sequence.unpaired_color,
        ground_truth_poses=0 if truth is None else len(truth),
    )


def _stream(name: str, stamps_ns: NDArray[np.int64]) -> Stream:
    periods_s = np.diff(stamps_ns) / NS_PER_S
    forward = periods_s[periods_s > 0]
    median_s = float(np.median(forward)) if forward.size else 0.0
    gaps = tuple(
        Gap(float(stamps_ns[i] - stamps_ns[0]) / NS_PER_S, float(periods_s[i]))
        for i in np.flatnonzero(periods_s > _GAP_PERIODS * median_s)
        if median_s
    )
    rate_hz = 1 / median_s if median_s else 0.0
    return Stream(name, len(stamps_ns), rate_hz, int(periods_s.size - forward.size), gaps)
