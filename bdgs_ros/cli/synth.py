"""`bdgs synth`: make a synthetic recording with exact truth."""

from __future__ import annotations

import argparse
import dataclasses
import json
import sys
import time
from pathlib import Path

from tqdm import tqdm

from bdgs_ros.data.synth import RecordingSummary, field_scenarios, scenarios, write_recording

_NAMES = scenarios() + field_scenarios()

NAME = 'synth'
HELP = 'make a synthetic RGB-D recording with exact truth'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the arguments of the subcommand."""
    parser.add_argument('folder', type=Path, metavar='DIR', help='folder to make')
    parser.add_argument(
        '--scenario', required=True, choices=_NAMES, metavar='NAME',
        help='one of: ' + ', '.join(_NAMES),
    )  # fmt: skip
    parser.add_argument('--seed', type=int, default=0, help='seed of all that varies (default: 0)')
    parser.add_argument('--frames', type=int, default=300, help='length (default: 300)')
    parser.add_argument(
        '--size', type=_size, default=(640, 480), metavar='WxH', help='pixels (default: 640x480)'
    )
    parser.add_argument('--rate', type=float, help='frames per second (default: 30; low_rate: 5)')
    parser.add_argument('--jobs', type=int, help='processes (default: one per processor)')
    parser.add_argument('--force', action='store_true', help='replace a recording that is there')
    parser.add_argument('--json', action='store_true', help='print the summary as JSON')


def run(args: argparse.Namespace) -> int:
    """Make the recording and print one line about it."""
    start = time.monotonic()
    with tqdm(total=args.frames, unit='frame', desc=args.scenario, disable=args.json) as bar:
        summary = write_recording(
            args.folder,
            args.scenario,
            args.seed,
            args.frames,
            size=args.size,
            rate_hz=args.rate,
            jobs=args.jobs,
            force=args.force,
            progress=lambda done, _: bar.update(done - bar.n),
        )
    seconds = time.monotonic() - start
    sys.stdout.write(_as_json(summary, seconds) if args.json else _as_text(summary, seconds))
    return 0


def _size(text: str) -> tuple[int, int]:
    width, cross, height = text.lower().partition('x')
    if not (cross and width.isdecimal() and height.isdecimal()):
        raise argparse.ArgumentTypeError(f"'{text}' is not a size such as 640x480")
    return int(width), int(height)


def _as_json(summary: RecordingSummary, seconds: float) -> str:
    return json.dumps({**dataclasses.asdict(summary), 'wall_s': round(seconds, 3)}) + '\n'


def _as_text(summary: RecordingSummary, seconds: float) -> str:
    return (
        f'{summary.folder}: {summary.scenario}, seed {summary.seed}, {summary.frames} frames '
        f'({summary.duration_s:.1f} s) in {seconds:.1f} s; moving things cover '
        f'{100 * summary.mean_coverage:.1f} % on average, {100 * summary.max_coverage:.1f} % '
        'at most\n'
    )
