"""`bdgs info`: what is in a recording or a bag."""

from __future__ import annotations

import argparse
import json
import sys
from dataclasses import asdict
from pathlib import Path

from bdgs_ros.cli.topics import add_topic_arguments, camera_topics
from bdgs_ros.data.inspect import Stream, Summary, summarise

NAME = 'info'
HELP = 'say what is in a recording or a bag'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', type=Path, help='folder or bag')
    parser.add_argument('--camera', type=Path, metavar='FILE', help='camera.yaml to use')
    parser.add_argument('--allow-truncated', action='store_true',
                        help='look at what is readable of a bag that was cut off')  # fmt: skip
    add_topic_arguments(parser)
    parser.add_argument('--json', action='store_true', help='report as json')


def run(args: argparse.Namespace) -> int:
    """Inspect and report."""
    summary = summarise(args.recording, args.camera, args.allow_truncated, camera_topics(args))
    if args.json:
        sys.stdout.write(json.dumps(asdict(summary), indent=2) + '\n')
    else:
        sys.stdout.write(_as_text(summary))
    return 0


def _as_text(summary: Summary) -> str:
    lines = [
        f'{summary.path}: {summary.kind}, {summary.duration_s:.2f} s'
        + (', cut off' if summary.truncated else ''),
        *(f'  {t.name:<44} {t.msgtype:<34} {t.count:>7}' for t in summary.topics),
    ]
    if summary.problem:
        return '\n'.join([*lines, f'not usable as an RGB-D recording: {summary.problem}']) + '\n'
    lines += [f'{s.name:<7} {_stream(s)}' for s in (summary.color, summary.depth) if s]
    lines += [f'camera  {_camera(summary)}', f'pairs   {summary.pairs}']
    lines += [f'        no depth for {name}' for name in summary.unpaired_color]
    lines.append(f'ground truth: {summary.ground_truth_poses} poses')
    return '\n'.join(lines) + '\n'


def _stream(stream: Stream) -> str:
    text = f'{stream.count} images at {stream.rate_hz:.2f} Hz'
    if stream.out_of_order:
        text += f', {stream.out_of_order} stamps repeated'
    if stream.gaps:
        worst = max(stream.gaps, key=lambda gap: gap.length_s)
        text += (
            f', {len(stream.gaps)} gaps, the longest {worst.length_s * 1000:.0f} ms '
            f'at {worst.at_s:.2f} s'
        )
    return text


def _camera(summary: Summary) -> str:
    camera = summary.camera
    if camera is None:
        return 'unknown'
    return (
        f'{camera.width}x{camera.height}, fx {camera.fx:.3f} fy {camera.fy:.3f} '
        f'cx {camera.cx:.3f} cy {camera.cy:.3f}, distortion {list(camera.distortion)}'
    )
