"""`bdgs bench`: measure, resumably, and write tables."""

from __future__ import annotations

import argparse
import importlib
import os
import sys
from pathlib import Path
from typing import Any, cast

from bdgs_ros.bench.harness import Bench, Options, run_bench, to_markdown
from bdgs_ros.cli.config import parse_overrides
from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.eval.metric import dump_json

NAME = 'bench'
HELP = 'measure accuracy or speed; finished cells are kept, so an interrupted bench goes on'

_BENCHES = (
    *('slam', 'accuracy', 'belief', 'mapping', 'tracking', 'recovery', 'faults', 'soak'),
    *('rasterizer', 'card'),
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    parser.add_argument('name', choices=_BENCHES, help='what to measure')
    parser.add_argument('--quick', action='store_true', help='few and short cells, as a check')
    parser.add_argument(
        '--all', action='store_true', help='cells too that the bench leaves out by default'
    )
    parser.add_argument(
        '--only',
        action='append',
        default=[],
        metavar='PATTERN',
        help="cells by sequence, configuration or 'sequence/configuration/seed'; repeatable",
    )
    parser.add_argument('--force', action='store_true', help='measure again what has a result')
    parser.add_argument(
        '--seeds',
        type=int,
        metavar='N',
        help='random seeds 0 to N-1 (default: 1; 5 for accuracy, belief and recovery)',
    )
    parser.add_argument(
        '--jobs',
        type=int,
        default=1,
        metavar='N',
        help='slam, accuracy, belief, recovery: cells that run at once, one thread each, no times',
    )
    parser.add_argument(
        '--beside',
        type=int,
        action='append',
        metavar='N',
        help='tracking: live beside N processes that use a processor each; repeatable',
    )
    parser.add_argument(
        '--rate',
        type=float,
        action='append',
        metavar='R',
        help='tracking: live at R times the rate of the recording; repeatable',
    )
    parser.add_argument(
        '--data',
        type=Path,
        default=default_data(),
        metavar='DIR',
        help='folder with data/ and models/ (default: BDGS_SHARED, or ../shared of the checkout)',
    )
    parser.add_argument(
        '--work',
        type=Path,
        default=Path('benchmarks/work'),
        metavar='DIR',
        help='where results and synthetic recordings are kept (default: %(default)s)',
    )
    parser.add_argument(
        '--refine-seconds',
        type=float,
        default=Options.refine_s,
        metavar='S',
        help='bench mapping: refinement after each run, 0 for none (default: %(default)g)',
    )
    parser.add_argument('--weights', type=Path, metavar='ONNX', help='weights of the detector')
    parser.add_argument(
        '--minutes',
        type=float,
        default=10.0,
        metavar='M',
        help='bench soak: for how long (default: %(default)g)',
    )
    parser.add_argument(
        '--set',
        action='append',
        default=[],
        metavar='NAME=VALUE',
        dest='overrides',
        help='change one parameter in every cell; repeatable',
    )
    parser.add_argument('--json', action='store_true', help='print summary and rows for machines')


def default_data() -> Path:
    """Return the folder of recordings and weights: BDGS_SHARED, or beside the checkout."""
    checkout = Path(__file__).resolve().parents[2]
    return Path(os.environ.get('BDGS_SHARED', checkout.parent / 'shared'))


def run(arguments: argparse.Namespace) -> int:
    """Measure; exit code 1 if a cell failed."""
    values = parse_overrides(arguments.overrides)
    with_values(BdgsConfig(), values)  # refuse a misspelt name before anything is measured
    bench = load(arguments.name)
    seeds = arguments.seeds or getattr(bench, 'SEEDS', 1)
    options = Options(
        work=arguments.work / arguments.name,
        data=arguments.data,
        quick=arguments.quick,
        seeds=tuple(range(seeds)),
        weights=arguments.weights,
        values=values,
        all_cells=arguments.all,
        refine_s=arguments.refine_seconds,
        beside=tuple(arguments.beside or Options.beside),
        rates=tuple(arguments.rate or Options.rates),
        jobs=arguments.jobs,
        minutes=arguments.minutes,
    )
    results = run_bench(bench, options, arguments.only, arguments.force)
    sys.stdout.write(dump_json(results) + '\n' if arguments.json else to_markdown(results))
    _report_failures(results)
    return 1 if results['failed'] else 0


def load(name: str) -> Bench:
    """Import the module of a bench."""
    return cast(Bench, importlib.import_module(f'bdgs_ros.bench.{name}'))


def _report_failures(results: dict[str, Any]) -> None:
    for row in results['rows']:
        if 'error' in row:
            label = f'{row["sequence"]}/{row["configuration"]}/{row["seed"]}'
            sys.stderr.write(f'failed: {label}: {row["error"]}\n')
