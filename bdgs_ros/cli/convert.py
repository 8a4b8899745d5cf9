"""`bdgs convert`: a recording to a rosbag2."""

from __future__ import annotations

import argparse
import json
import signal
import sys
import time
from pathlib import Path
from types import FrameType

from bdgs_ros.cli.topics import add_topic_arguments, camera_topics
from bdgs_ros.data.convert import (
    COMPRESSIONS,
    DEPTH_ENCODINGS,
    STORAGES,
    ConvertOptions,
    ConvertReport,
    convert,
)
from bdgs_ros.data.layouts import open_recording

NAME = 'convert'
HELP = 'convert a TUM, BONN, OpenLORIS or synthetic recording, or a ROS 1 bag, to a rosbag2'
_DEFAULTS = ConvertOptions()


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('source', type=Path, help='folder or bag to convert')
    parser.add_argument('bag', type=Path, help='rosbag2 folder to make')
    parser.add_argument('--storage', choices=tuple(STORAGES), default=_DEFAULTS.storage)
    parser.add_argument('--compression', choices=COMPRESSIONS, default=_DEFAULTS.compression,
                        help='zstd takes several times longer (default: %(default)s)')  # fmt: skip
    parser.add_argument('--depth-encoding', choices=DEPTH_ENCODINGS,
                        default=_DEFAULTS.depth_encoding,
                        help='32FC1: metres, exact; 16UC1: mm, half the size')  # fmt: skip
    parser.add_argument('--camera', type=Path, metavar='FILE',
                        help='camera.yaml to use instead of what is known')  # fmt: skip
    parser.add_argument('--start', type=float, default=_DEFAULTS.start_s, metavar='S',
                        help='skip this many seconds')  # fmt: skip
    parser.add_argument('--duration', type=float, metavar='S',
                        help='convert this many seconds (default: to the end)')  # fmt: skip
    parser.add_argument('--max-difference', type=float, default=_DEFAULTS.max_difference_s,
                        metavar='S', help='colour and depth within this are a pair '
                        '(default: %(default)s)')  # fmt: skip
    parser.add_argument('--allow-truncated', action='store_true',
                        help='use what is readable of a bag that was cut off')  # fmt: skip
    add_topic_arguments(parser)
    parser.add_argument('--force', action='store_true', help='replace an existing bag')
    parser.add_argument('--json', action='store_true', help='report as json')


def run(args: argparse.Namespace) -> int:
    """Convert and report."""
    options = ConvertOptions(
        storage=args.storage,
        compression=args.compression,
        depth_encoding=args.depth_encoding,
        start_s=args.start,
        duration_s=args.duration,
        max_difference_s=args.max_difference,
        force=args.force,
        progress=not args.json,
    )
    before = signal.signal(signal.SIGTERM, _interrupt)
    began = time.perf_counter()
    try:
        recording = open_recording(
            args.source, args.camera, args.allow_truncated, camera_topics(args)
        )
        report = convert(recording, args.bag, options)
    finally:
        signal.signal(signal.SIGTERM, before)
    seconds = time.perf_counter() - began
    sys.stdout.write(_as_json(report, seconds) if args.json else _as_text(report, seconds))
    return 0


def _interrupt(number: int, frame: FrameType | None) -> None:
    """Let a termination clean up as an interrupt does."""
    raise KeyboardInterrupt


def _as_json(report: ConvertReport, seconds: float) -> str:
    content = {
        'bag': str(report.bag),
        'topics': report.counts,
        'pairs': report.pairs,
        'unpaired_color': list(report.unpaired_color),
        'damaged': list(report.damaged),
        'duration_s': report.duration_s,
        'size_bytes': report.size_bytes,
        'seconds': seconds,
    }
    return json.dumps(content, indent=2) + '\n'


def _as_text(report: ConvertReport, seconds: float) -> str:
    lines = [
        f"'{report.bag}': {report.duration_s:.2f} s, {report.size_bytes / 1e6:.0f} MB, "
        f'written in {seconds:.1f} s',
        *(f'  {topic:<28} {count:>6} messages' for topic, count in report.counts.items()),
        f'  {report.pairs} RGB-D pairs, {len(report.unpaired_color)} colour images without depth',
        *(f'    without depth: {name}' for name in report.unpaired_color),
        *(f'    left out: {text}' for text in report.damaged),
    ]
    return '\n'.join(lines) + '\n'
