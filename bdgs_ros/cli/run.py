"""`bdgs run`: a recording through the pipeline, without ROS."""

from __future__ import annotations

import argparse
import sys
from pathlib import Path
from typing import Any

from bdgs_ros.cli.config import add_config_arguments, load_config, with_weights
from bdgs_ros.cli.topics import add_topic_arguments, camera_topics
from bdgs_ros.core.errors import ConfigError
from bdgs_ros.core.types import Pose
from bdgs_ros.data.trajectory_io import POSE_COLUMNS, parse_pose
from bdgs_ros.eval.metric import dump_json, markdown_table

NAME = 'run'
HELP = 'run a recording (folder or bag) without ROS; write trajectory, map, metrics, pictures'

_SHOWN = (
    'frames_in', 'frames_lost', 'coverage', 'keyframes', 'ate_rmse', 'ate_final_rmse', 'ate_mean',
    'ate_std', 'ate_max', 'rpe_translation_second_rmse', 'dynamic_precision', 'dynamic_recall',
    'dynamic_false_positive_rate', 'psnr', 'psnr_exposure_fit', 'psnr_map', 'psnr_hidden',
    'psnr_rest', 'ssim', 'depth_l1',
    'gaussians', 'map_size', 'detection_median', 'tracking_median', 'tracking_p95',
    'mapping_median', 'mapping_p95', 'frames_per_s',
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('recording', type=Path, help='folder in TUM, BONN, ... layout, or a bag')
    parser.add_argument('--output', type=Path, required=True, metavar='DIR', help='results')
    parser.add_argument('--weights', type=Path, metavar='ONNX', help='weights of the detector')
    parser.add_argument('--camera', type=Path, metavar='FILE', help='camera.yaml of the recording')
    parser.add_argument('--start', type=int, default=0, metavar='N', help='first frame')
    parser.add_argument('--frames', type=int, metavar='N', help='number of frames')
    parser.add_argument(
        '--loop-frames',
        type=int,
        metavar='N',
        help='play the recording forth and back until it has N frames, to see how a long run goes',
    )
    parser.add_argument(
        '--allow-truncated', action='store_true', help='use what is readable of a cut-off bag'
    )
    add_topic_arguments(parser)
    parser.add_argument('--no-pictures', action='store_true', help='leave the pictures out')
    parser.add_argument(
        '--no-keyframes', action='store_true', help='leave the images for `bdgs refine` out'
    )
    parser.add_argument(
        '--map', type=Path, metavar='PLY', help='continue from this map instead of a new one'
    )
    parser.add_argument(
        '--localise', action='store_true', help='with --map: track in the map, do not change it'
    )
    parser.add_argument(
        '--start-pose',
        metavar='"X Y Z QX QY QZ QW"',
        help="with --map: about where the camera starts, in metres (default: the map's origin)",
    )
    parser.add_argument('--json', action='store_true', help='print the metrics for machines')
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Run the recording and print the figures."""
    from bdgs_ros.job import Job, run_job

    job = Job(
        recording=arguments.recording,
        output=arguments.output,
        config=with_weights(load_config(arguments), arguments.weights),
        camera_file=arguments.camera,
        allow_truncated=arguments.allow_truncated,
        topics=camera_topics(arguments),
        start=arguments.start,
        frames=arguments.frames,
        loop_frames=arguments.loop_frames,
        pictures=not arguments.no_pictures,
        keyframes=not arguments.no_keyframes,
        map_file=arguments.map,
        start_pose=_start_pose(arguments),
        localise=arguments.localise,
    )
    metrics = run_job(job)
    sys.stdout.write(dump_json(metrics) + '\n' if arguments.json else _summary(metrics))
    return 0


def _start_pose(arguments: argparse.Namespace) -> Pose | None:
    """Read `--start-pose`; raises `ConfigError` if it is no pose, or there is no map for it."""
    if arguments.map is None and (arguments.localise or arguments.start_pose is not None):
        raise ConfigError('--localise and --start-pose need a map: add --map FILE')
    if arguments.start_pose is None:
        return None
    try:
        return parse_pose(arguments.start_pose)
    except ValueError as error:
        raise ConfigError(f"--start-pose expects '{POSE_COLUMNS}', found {error}") from error


def _summary(metrics: dict[str, Any]) -> str:
    found = metrics['metrics']
    rows = [{'metric': name, **found[name]} for name in _SHOWN if name in found]
    notes = ''.join(f'note: {note}\n' for note in metrics['notes'])
    return markdown_table(rows) + notes
