"""`bdgs fit-likelihood`: learn w and b of Eq. 3 from synthetic recordings with truth."""

from __future__ import annotations

import argparse
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

from bdgs_ros.cli.bench import default_data
from bdgs_ros.cli.config import add_config_arguments, load_config, to_yaml
from bdgs_ros.core.config import BdgsConfig, specs, with_values
from bdgs_ros.core.errors import ConfigError

if TYPE_CHECKING:
    from bdgs_ros.bench.likelihood_fit import Settings

NAME = 'fit-likelihood'
HELP = 'learn the weights of the likelihood of Eq. 3 from synthetic recordings with truth'

_SCENARIOS = (
    'walking_xyz', 'walking_static', 'walking_halfsphere', 'unknown_box', 'chair_moved', 'crowd',
)  # fmt: skip
_SEEDS = (100, 101)  # not among those that anything is evaluated on
_FRAMES = 300
_QUICK_SCENARIOS = ('walking_static', 'unknown_box')
_QUICK_FRAMES = 60


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Declare the arguments."""
    from bdgs_ros.bench.sequences import WEIGHTS

    parser.add_argument('--output', type=Path, required=True, metavar='DIR', help='results')
    parser.add_argument(
        '--scenarios', nargs='+', metavar='NAME', help=f'(default: {" ".join(_SCENARIOS)})'
    )
    parser.add_argument(
        '--seeds', nargs='+', type=int, default=_SEEDS, metavar='N',
        help='of the recordings; each is held out in turn (default: 100 101)',
    )  # fmt: skip
    parser.add_argument(
        '--frames', type=int, metavar='N', help=f'of each recording (default: {_FRAMES})'
    )
    parser.add_argument('--quick', action='store_true', help='few and short runs, as a check')
    parser.add_argument(
        '--work',
        type=Path,
        default=Path('benchmarks/work'),
        metavar='DIR',
        help='where recordings and what was seen in them are kept (default: %(default)s)',
    )
    parser.add_argument('--force', action='store_true', help='run again what has been run')
    parser.add_argument(
        '--weights',
        type=Path,
        default=default_data() / WEIGHTS,
        metavar='ONNX',
        help='weights of the detector (default: %(default)s)',
    )
    parser.add_argument(
        '--no-weights', action='store_true', help='learn from the geometric prior alone'
    )
    parser.add_argument(
        '--decay-rates', nargs='+', type=float, metavar='A', default=[],
        help='alpha to choose from (default: belief.decay_rate)',
    )  # fmt: skip
    parser.add_argument(
        '--clamps', nargs='+', type=float, metavar='L', default=[],
        help='belief.max_log_odds to choose from (default: as it is)',
    )  # fmt: skip
    parser.add_argument(
        '--without', nargs='+', metavar='FEATURE', default=[], help='features to leave out'
    )
    parser.add_argument(
        '--ship', action='store_true', help='make these weights the defaults of this checkout'
    )
    parser.add_argument('--date', metavar='YYYY-MM-DD', help='for --ship (default: of the commit)')
    parser.add_argument('--json', action='store_true', help='print the provenance for machines')
    add_config_arguments(parser)


def run(arguments: argparse.Namespace) -> int:
    """Collect, fit, and write the results."""
    from bdgs_ros.belief.likelihood import FEATURES
    from bdgs_ros.bench import likelihood_report
    from bdgs_ros.bench.likelihood_fit import learn
    from bdgs_ros.core.files import write_text
    from bdgs_ros.eval.metric import dump_json
    from bdgs_ros.eval.provenance import commit, commit_date

    config = load_config(arguments)
    _refuse_unknown('feature', arguments.without, FEATURES)
    learned = learn(
        _materials(arguments, config),
        config.belief,
        arguments.decay_rates,
        arguments.clamps,
        arguments.without,
    )
    command = 'bdgs fit-likelihood ' + _choices(arguments)
    date = arguments.date or commit_date()
    provenance = likelihood_report.provenance_of(learned, config.belief, command, commit(), date)
    weights = likelihood_report.rounded(learned)
    arguments.output.mkdir(parents=True, exist_ok=True)
    likelihood_report.write_report(arguments.output, learned, config.belief, provenance)
    values = _values(weights, learned.settings)
    fitted = [spec for spec in specs(with_values(config, values)) if spec.name in values]
    write_text(arguments.output / 'likelihood.yaml', to_yaml(fitted))
    if arguments.ship:
        write_text(shipped_path(), likelihood_report.as_module(weights, provenance))
    text = dump_json({'weights': weights, 'provenance': provenance})
    sys.stdout.write(f'{text}\n' if arguments.json else _summary(arguments.output, provenance))
    return 0


def shipped_path() -> Path:
    """Return the module that holds the default weights."""
    from bdgs_ros.core import config

    return Path(config.__file__).with_name('likelihood_fit.py')


def _materials(arguments: argparse.Namespace, config: BdgsConfig) -> list[Any]:
    from tqdm import tqdm

    from bdgs_ros.bench.likelihood_material import collect, sources
    from bdgs_ros.data.synth import scenarios

    names = arguments.scenarios or (_QUICK_SCENARIOS if arguments.quick else _SCENARIOS)
    _refuse_unknown('scenario', names, tuple(scenarios()))
    frames = arguments.frames or (_QUICK_FRAMES if arguments.quick else _FRAMES)
    weights = None if arguments.no_weights else arguments.weights
    found = []
    with tqdm(
        sources(names, arguments.seeds, frames, weights), unit='run', file=sys.stderr, leave=False
    ) as bar:
        for source in bar:
            bar.set_postfix_str(source.label)
            found.append(collect(source, config, weights, arguments.work, arguments.force))
    return found


def _refuse_unknown(kind: str, names: Sequence[str], known: Sequence[str]) -> None:
    unknown = [name for name in names if name not in known]
    if unknown:
        raise ConfigError(f'no {kind} {unknown}; there are: {", ".join(known)}')


def _choices(arguments: argparse.Namespace) -> str:
    """Return the arguments that decide the result, as they would be typed."""
    words = []
    for name in ('scenarios', 'seeds', 'decay_rates', 'clamps', 'without'):
        values = getattr(arguments, name)
        if values and tuple(values) != _SEEDS:
            words += [f'--{name.replace("_", "-")}', *map(str, values)]
    words += [] if arguments.frames is None else ['--frames', str(arguments.frames)]
    words += ['--quick'] if arguments.quick else []
    words += ['--no-weights'] if arguments.no_weights else []
    return ' '.join([*words, *(f'--set {text}' for text in arguments.overrides)])


def _values(weights: dict[str, float], settings: Settings) -> dict[str, float]:
    """Return what was learned, by parameter."""
    return {
        'belief.decay_rate': settings.decay_rate,
        'belief.max_log_odds': settings.clamps.known,
        **{f'belief.likelihood.w_{name}': weight for name, weight in weights.items()},
    }


def _summary(folder: Path, provenance: dict[str, Any]) -> str:
    return (
        f'{folder}: log loss {provenance["held_out_log_loss"]}, Brier score '
        f'{provenance["held_out_brier"]} on held-out seeds, {provenance["examples"]} examples; '
        f'use --config {folder / "likelihood.yaml"}\n'
    )
