"""`bdgs refine`: improve the map of a run for a limited time."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from bdgs_ros.cli.config import add_config_arguments, load_config, with_weights
from bdgs_ros.eval.metric import dump_json, markdown_table

NAME = 'refine'
HELP = 'go on optimising the map of a finished run over its keyframes; time-limited'

_SECONDS = 60.0
_SHOWN = (
    'psnr', 'psnr_exposure_fit', 'psnr_hidden', 'ssim', 'depth_l1', 'seen', 'views_scored',
    'refine_loss_before', 'refine_loss_after', 'refine_iterations', 'refine_time', 'gaussians',
    'map_size',
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('results', type=Path, help='folder that `bdgs run` or slam_node left')
    parser.add_argument(
        '--seconds', type=float, metavar='S', help=f'time limit (default: {_SECONDS:g})'
    )
    parser.add_argument(
        '--iterations', type=int, metavar='N', help='limit of steps; alone, there is none of time'
    )
    parser.add_argument(
        '--output', type=Path, metavar='DIR', help='results (default: RESULTS/refined)'
    )
    parser.add_argument(
        '--recording',
        type=Path,
        metavar='PATH',
        help='what was run, to score the map before and after on frames that were no keyframes',
    )
    parser.add_argument('--weights', type=Path, metavar='ONNX', help='weights of the detector')
    parser.add_argument('--camera', type=Path, metavar='FILE', help='camera.yaml of the recording')
    parser.add_argument('--json', action='store_true', help='print the metrics for machines')
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Refine and print the figures."""
    from bdgs_ros.refine import RefineJob, refine_job

    seconds = arguments.seconds
    if seconds is None and arguments.iterations is None:
        seconds = _SECONDS
    job = RefineJob(
        folder=arguments.results,
        output=arguments.output or arguments.results / 'refined',
        seconds=seconds,
        iterations=arguments.iterations,
        recording=arguments.recording,
        camera_file=arguments.camera,
        config=with_weights(load_config(arguments), arguments.weights),
    )
    metrics = refine_job(job)
    sys.stdout.write(
        dump_json(metrics) + '\n' if arguments.json else _summary(metrics, job.output)
    )
    return 0


def _summary(metrics: dict[str, Any], output: Path) -> str:
    found, before = metrics['metrics'], metrics['metrics_before']
    rows = [
        {'metric': name, 'before': before.get(name, {}).get('value', ''), **found[name]}
        for name in _SHOWN
        if name in found
    ]
    return markdown_table(rows) + f"wrote '{output / 'map.ply'}'\n"
