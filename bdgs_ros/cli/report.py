"""`bdgs report`: complete the results of a run and put them on one page."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from bdgs_ros.cli.config import add_config_arguments, load_config, with_weights
from bdgs_ros.eval.metric import Metric, dump_json
from bdgs_ros.eval.report import Picture, Report, Row, write_report

NAME = 'report'
HELP = 'score and picture a finished run from its trajectory, map and recording; write report.html'

_MEANINGS = {
    'frames_in': 'frames of the recording',
    'coverage': 'frames with a pose',
    'ate_rmse': 'ATE RMSE, all frames, rigid alignment without scale',
    'ate_max': 'largest single error',
    'rpe_translation_second_rmse': 'drift (RPE RMSE)',
    'rpe_rotation_second_rmse': 'drift in rotation (RPE RMSE)',
    'psnr': 'rendered static map against what is known to be true, PSNR',
    'psnr_exposure_fit': 'the same after a gain and offset per channel',
    'psnr_hidden': 'the same where something moving stood before it',
    'psnr_rest': 'the same on the rest of these images',
    'ssim': 'SSIM',
    'depth_l1': 'depth error of the rendered map, mean',
    'dynamic_precision': 'pixels called dynamic that are',
    'dynamic_recall': 'dynamic pixels that were called so',
    'prior_precision': 'pixels called dynamic by the prior that are',
    'prior_recall': 'dynamic pixels that the prior called so',
    'keyframes': 'keyframes',
    'gaussians': 'Gaussians',
    'map_size': 'size of the map',
    'detection_median': 'detection, median per frame',
    'tracking_median': 'tracking, median per frame',
    'mapping_median': 'mapping, median per keyframe',
}

_LEAD = (
    'An RGB-D camera among moving people: its pose for every frame, and a map of 3D Gaussians of '
    'the static world alone. Ground truth was used for the figures, never by the method.'
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('results', type=Path, help='folder with trajectory.txt and map.ply')
    parser.add_argument('--recording', type=Path, required=True, help='the recording that was run')
    parser.add_argument('--weights', type=Path, metavar='ONNX', help='weights of the detector')
    parser.add_argument('--camera', type=Path, metavar='FILE', help='camera.yaml of the recording')
    parser.add_argument('--json', action='store_true', help='print the metrics for machines')
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Score, draw and write the page."""
    from bdgs_ros.rescore import rescore

    config = with_weights(load_config(arguments), arguments.weights)
    metrics = rescore(arguments.results, arguments.recording, config, arguments.camera)
    write_page(arguments.results, metrics, {'recording': str(arguments.recording)})
    if arguments.json:
        sys.stdout.write(dump_json(metrics) + '\n')
    else:
        sys.stdout.write(f"wrote '{arguments.results / 'report.html'}'\n")
    return 0


def write_page(
    folder: Path, metrics: Mapping[str, Any], facts: Mapping[str, str], title: str = ''
) -> None:
    """
    Write `report.html` into a folder of results.

    Parameters
    ----------
    folder : Path
        Holds the pictures.
    metrics : mapping
        The content of `metrics.json`.
    facts : mapping of str to str
        How the results were made; commit and machine are added.
    title : str
        By default the name of the recording.

    """
    found = metrics['metrics']
    rows = [
        Row(meaning, Metric(name, _number(found[name]['value']), found[name]['unit']))
        for name, meaning in _MEANINGS.items()
        if name in found
    ]
    pictures = [
        Picture(
            folder / 'animation.gif',
            'Input; dynamic probability in red; the final static map at the estimated pose.',
        ),
        Picture(folder / 'trajectory.png', 'The path, and the error of every frame.'),
        Picture(folder / 'tiles.png', 'Some frames of the animation.'),
        Picture(
            folder / 'posterior.png',
            'Each second of the run: input, prior, posterior of all Gaussians, static map then.',
        ),
    ]
    title = title or f'bdgs_ros: {metrics["sequence"]}'
    facts = {**facts, **_origin(metrics['provenance'])}
    write_report(folder / 'report.html', Report(title, _LEAD, rows, pictures, facts))


def _number(value: float | None) -> float:
    return float('nan') if value is None else value


def _origin(provenance: Mapping[str, Any]) -> dict[str, str]:
    machine = provenance['machine']
    versions = ', '.join(f'{name} {version}' for name, version in provenance['versions'].items())
    return {
        'commit': provenance['commit'],
        'machine': f'{machine["processor"]}, {machine["cores"]} cores, {machine["system"]}',
        'versions': f'Python {machine["python"]}, {versions}',
    }
