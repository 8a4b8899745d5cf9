"""`bdgs demo`: the whole way from nothing to a report, each step a command one can repeat."""

from __future__ import annotations

import argparse
import os
import shlex
import shutil
import subprocess
import sys
import time
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from bdgs_ros.cli.config import load_config, with_weights
from bdgs_ros.cli.report import write_page
from bdgs_ros.core.errors import BdgsError
from bdgs_ros.eval.metric import dump_json, format_value

NAME = 'demo'
HELP = 'make a recording, convert it, replay it over DDS through the graph, write a report'

_MADE = ('recording', 'bag')  # folders that are made anew
_STEP_TIMEOUT_S = 600


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('folder', type=Path, help='where everything is left')
    parser.add_argument('--scenario', default='walking_xyz', help='see `bdgs synth --help`')
    parser.add_argument('--frames', type=int, default=150, help='length (default: %(default)s)')
    parser.add_argument('--seed', type=int, default=0, help='of the recording')
    parser.add_argument('--weights', type=Path, metavar='ONNX', help='weights of the detector')
    parser.add_argument('--json', action='store_true', help='print the metrics for machines')


def run(arguments: argparse.Namespace) -> int:
    """Go all the way."""
    from bdgs_ros.rescore import rescore

    folder: Path = arguments.folder
    for name in _MADE:
        shutil.rmtree(folder / name, ignore_errors=True)
    folder.mkdir(parents=True, exist_ok=True)
    facts = {}
    for title, command in _commands(arguments):
        facts[title] = f'{_shown(command)}  ({_step(title, command):.0f} s)'
    started = time.perf_counter()
    arguments.config, arguments.overrides = None, []
    config = with_weights(load_config(arguments), arguments.weights)
    _say('scoring and drawing')
    metrics = rescore(folder, folder / 'recording', config)
    scored = f'bdgs report {folder} --recording {folder / "recording"}'
    facts['figures and pictures'] = f'{scored}  ({time.perf_counter() - started:.0f} s)'
    write_page(folder, metrics, facts, f'bdgs_ros demo: {arguments.scenario}')
    sys.stdout.write(dump_json(metrics) + '\n' if arguments.json else _summary(folder, metrics))
    return 0


def _commands(arguments: argparse.Namespace) -> list[tuple[str, list[str]]]:
    folder: Path = arguments.folder
    recording, bag = str(folder / 'recording'), str(folder / 'bag')
    bdgs = [sys.executable, '-m', 'bdgs_ros.cli.main']
    synth = [*bdgs, 'synth', recording, '--scenario', arguments.scenario]
    synth += ['--seed', str(arguments.seed), '--frames', str(arguments.frames)]
    parameters = {
        'bag': bag,
        'output': str(folder),
        'exit_at_end': 'true',
        'mode': 'lockstep',
    }
    if arguments.weights is not None:
        parameters['detection.weights'] = str(arguments.weights.resolve())
    node = [sys.executable, '-m', 'bdgs_ros.nodes.slam_node', '--ros-args']
    for name, value in parameters.items():
        node += ['-p', f'{name}:={value}']
    return [
        ('recording', synth),
        ('bag', [*bdgs, 'convert', recording, bag]),
        ('replay over DDS', node),
    ]


def _step(title: str, command: Sequence[str]) -> float:
    """Run one command with its output on stderr; returns its seconds."""
    _say(f'{title}: {_shown(command)}')
    start = time.perf_counter()
    env = {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST', **os.environ}  # not the whole network
    try:
        done = subprocess.run(
            command, stdout=sys.stderr, timeout=_STEP_TIMEOUT_S, env=env, check=False
        )
    except subprocess.TimeoutExpired as error:
        raise BdgsError(f'{title}: not done after {_STEP_TIMEOUT_S} s') from error
    if done.returncode:
        raise BdgsError(f'{title}: exit code {done.returncode} of {_shown(command)}')
    return time.perf_counter() - start


def _shown(command: Sequence[str]) -> str:
    text = shlex.join(command[2:])
    return text.replace('bdgs_ros.cli.main', 'bdgs').replace('bdgs_ros.nodes.', '')


def _say(text: str) -> None:
    sys.stderr.write(f'== {text}\n')
    sys.stderr.flush()


def _summary(folder: Path, metrics: Mapping[str, Any]) -> str:
    found = metrics['metrics']
    shown = ('coverage', 'ate_rmse', 'psnr', 'gaussians')
    figures = ', '.join(
        f'{name} {format_value(found[name]["value"])} {found[name]["unit"]}'.rstrip()
        for name in shown
        if name in found
    )
    return f"{figures}\nopen '{folder / 'report.html'}'\n"
