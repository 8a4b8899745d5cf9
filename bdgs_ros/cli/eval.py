"""`bdgs eval`: compare two trajectories."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path

from bdgs_ros.eval.metric import Metric, as_dict, dump_json, markdown_table
from bdgs_ros.eval.trajectory import MAX_DIFFERENCE_S

NAME = 'eval'
HELP = 'compare an estimated trajectory with the true one: ATE, coverage, RPE'


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('gt', type=Path, help='ground truth in TUM format')
    parser.add_argument('est', type=Path, help='estimate in TUM format')
    parser.add_argument(
        '--max-difference',
        type=float,
        default=MAX_DIFFERENCE_S,
        metavar='SECONDS',
        help='poses further apart in time are not compared (default: %(default)s)',
    )
    parser.add_argument(
        '--frames',
        type=int,
        metavar='N',
        help='frames that should have a pose, for the coverage (default: as many as fit)',
    )
    parser.add_argument('--plot', type=Path, metavar='FILE', help='draw path and error (.png)')
    parser.add_argument('--json', action='store_true', help='print the figures for machines')


def run(arguments: argparse.Namespace) -> int:
    """Print the figures."""
    from bdgs_ros.data.trajectory_io import read_trajectory
    from bdgs_ros.eval import plots, scores, trajectory

    gt, est = read_trajectory(arguments.gt), read_trajectory(arguments.est)
    limit_s = arguments.max_difference
    ate = trajectory.ate(gt, est, limit_s, arguments.frames)
    metrics = scores.trajectory_metrics(gt, est, arguments.frames, limit_s)
    if arguments.plot is not None:
        plots.plot_trajectory(arguments.plot, est, gt, ate, arguments.est.name)
    sys.stdout.write(_as_json(metrics, limit_s) if arguments.json else _as_text(metrics))
    return 0


def _as_json(metrics: list[Metric], limit_s: float) -> str:
    protocol = {
        'alignment': 'rigid, no scale (Horn)',
        'frames': 'all',
        'max_difference_s': limit_s,
    }
    return dump_json({'metrics': as_dict(metrics), 'protocol': protocol}) + '\n'


def _as_text(metrics: list[Metric]) -> str:
    rows = [{'metric': m.name, 'value': m.value, 'unit': m.unit} for m in metrics]
    return markdown_table(rows)
