"""Bench `belief`: is what the map believes of each Gaussian true, and what is each part worth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bdgs_ros.bench import belief_cost, sequences
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.bench.sequences import REAL
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.eval.belief_score import BeliefScore

if TYPE_CHECKING:
    from bdgs_ros.data.synth.truth import SynthTruth

NAME = 'belief'
SEEDS = 5
PARALLEL = True
PROTOCOL = """
Every frame goes through the pipeline in order, none dropped; truth is used for the figures alone.
A Gaussian is dynamic if it lies in front of everything that is static at that time (farther than
4 cm + 1 cm/m^2 z^2), static if it lies on a static surface (within 3 cm + 0.5 cm/m^2 z^2), else
not scored; map and camera are as estimated. It is judged once it was visible in three keyframes
since its truth last changed, that of its birth not counted: called dynamic if it is not rendered
or was deleted because of its belief. precision, recall: over these. unknown_recall: of those on
the box, which no detector knows. false_removal: of the Gaussians static at the end, those not
rendered or deleted by belief. restored: statics that had been rendered, were hidden, and are seen
by the camera: rendered again at a keyframe within 1 s; settled: the same of statics never
rendered before, such as what was just put down. hidden_static: share of the static pixels that
the map knows and belief does not show. label: dynamic pixels of the labels at camera rate. psnr:
as in bench slam; psnr_hidden: pixels that something moving covered, psnr_rest: the others of the
same views. inference_ms: beliefs of one keyframe, with the choice of what is deleted.
"""

SWITCHES: dict[str, dict[str, str]] = {
    'no_belief': {'belief.enabled': 'false'},
    'no_multi_view': {'belief.multi_view': 'false'},
    'no_mapping': {'mapping.enabled': 'false'},
}
"""The full configuration with one part off (Table 6)."""
TROUBLES: dict[str, dict[str, float]] = {
    'drop30': {'drop': 0.3, 'false': 0.0, 'delay_s': 0.0},
    'false10': {'drop': 0.0, 'false': 0.1, 'delay_s': 0.0},
    'late300': {'drop': 0.0, 'false': 0.0, 'delay_s': 0.3},
}
"""The full configuration with a detector that misses, sees ghosts, or answers late."""

_FULL, _GEOMETRIC = 'weights', 'geometric'
_SWITCHED = ('walking_xyz', 'unknown_box', 'chair_moved')
_TROUBLED = ('walking_xyz', 'crowd')
_ALSO_GEOMETRIC = ('unknown_box', 'chair_moved')
_FEW_SEEDS = 2
_QUICK_SCENARIOS = ('unknown_box', 'walking_xyz')
_CROWD = REAL[0].name
_STARTS = {_CROWD: 300, sequences.synth_name('crowd'): 150}
_UNKNOWN_KIND = 'box'
_COST = 'gaussians_50000'

_SCORED = (
    'precision', 'recall', 'unknown_recall', 'false_removal_percent', 'restored_percent',
    'settled_percent', 'hidden_static_percent',
)  # fmt: skip
_QUALITY = {
    'ate_cm': 'ate_rmse',
    'coverage_percent': 'coverage',
    'label_precision': 'dynamic_precision',
    'label_recall': 'dynamic_recall',
    'psnr_db': 'psnr',
    'psnr_hidden_db': 'psnr_hidden',
    'psnr_rest_db': 'psnr_rest',
    'hidden_static_percent': 'hidden_static',
    'keyframes': 'keyframes',
    'gaussians': 'gaussians',
    'frames': 'frames_in',
}
TABLES = {
    'Beliefs': (*_SCORED, 'keyframes', 'inference_ms'),
    'Pose, labels and render': (
        'ate_cm', 'coverage_percent', 'label_precision', 'label_recall', 'psnr_db',
        'psnr_hidden_db', 'psnr_rest_db', 'hidden_minus_rest_db', 'gaussians', 'frames',
    ),
    'Cost': ('cost_gaussians', 'cost_views', 'inference_50k_ms'),
}  # fmt: skip
_OVERVIEW = (
    *_SCORED, 'ate_cm', 'label_precision', 'label_recall', 'psnr_db', 'hidden_minus_rest_db',
)  # fmt: skip
_WORST_IS_MOST = ('false_removal_percent', 'hidden_static_percent', 'ate_cm')


def cells(options: Options) -> list[Cell]:
    """List the full configuration everywhere, then parts off, troubles, late starts, and cost."""
    if options.quick:
        seeds = options.seeds[:1]
        return [_synth(name, _FULL, seed, options) for name in _QUICK_SCENARIOS for seed in seeds]
    return [
        *_main(options),
        *_few(SWITCHES, _SWITCHED, options),
        *_few((*TROUBLES, 'absent'), _TROUBLED, options),
        *_late_starts(options),
        Cell(_COST, 'inference', 0, {'kind': 'cost', 'values': dict(options.values)}),
    ]


def _main(options: Options) -> list[Cell]:
    from bdgs_ros.data.synth import scenarios

    found = [_real(sequence.name, _FULL, options) for sequence in REAL]
    for name in scenarios():
        found += [_synth(name, _FULL, seed, options) for seed in options.seeds]
        if name in _ALSO_GEOMETRIC:
            found += [_synth(name, _GEOMETRIC, seed, options) for seed in options.seeds]
    return found


def _few(configurations: Iterable[str], scenarios: Sequence[str], options: Options) -> list[Cell]:
    """Some configurations on some scenarios, two seeds, and on the real crowd."""
    found = []
    for configuration in configurations:
        found.append(_real(_CROWD, configuration, options))
        for name in scenarios:
            found += [
                _synth(name, configuration, seed, options) for seed in options.seeds[:_FEW_SEEDS]
            ]
    return found


def _late_starts(options: Options) -> list[Cell]:
    real, synth = _STARTS
    seeds = options.seeds[:_FEW_SEEDS]
    name = synth.removeprefix(sequences.synth_name(''))
    return [
        _real(real, f'from_{_STARTS[real]}', options, start=_STARTS[real]),
        *(_synth(name, f'from_{_STARTS[synth]}', s, options, start=_STARTS[synth]) for s in seeds),
    ]


def _synth(scenario: str, configuration: str, seed: int, options: Options, start: int = 0) -> Cell:
    common = _settings(configuration, options, start)
    settings = {**sequences.synth_settings(options), **common}
    return Cell(sequences.synth_name(scenario), configuration, seed, settings)


def _real(name: str, configuration: str, options: Options, start: int = 0) -> Cell:
    common = _settings(configuration, options, start)
    return Cell(name, configuration, 0, {**sequences.real_settings(options), **common})


def _settings(configuration: str, options: Options, start: int) -> dict[str, Any]:
    alone = configuration in (_GEOMETRIC, 'absent')
    return {
        'values': {**SWITCHES.get(configuration, {}), **options.values},
        'weights': '' if alone else sequences.weights_path(options).name,
        'trouble': TROUBLES.get(configuration, {}),
        'start': start,
    }


def prepare(cell: Cell, options: Options) -> None:
    """Make the recording of a cell if it is not there yet."""
    if cell.settings['kind'] != 'cost':
        sequences.prepare(cell, options)


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Run one recording with one configuration; its result files stay in the work folder."""
    from bdgs_ros.eval.belief_ledger import BeliefLedger
    from bdgs_ros.job import Job, open_truth, run_job

    settings = cell.settings
    config = sequences.config_of(settings['values'], bool(settings.get('weights')), options)
    if settings['kind'] == 'cost':
        return belief_cost.measure(config)
    recording = sequences.cell_recording(cell, options)
    slam = _make_slam(cell, config)
    times_ms = belief_cost.watch_inference(slam.mapper)
    truth = open_truth(recording)
    ledger = None if truth is None else BeliefLedger(slam.mapper, truth, _unknown(truth))
    job = Job(
        recording,
        options.work / 'runs' / cell.key,
        config,
        start=settings['start'],
        frames=sequences.frame_limit(cell),
        progress=options.jobs == 1,
        keyframes=False,
    )
    observers, more = ([], tuple) if ledger is None else ([ledger], ledger.metrics)
    metrics = run_job(job, slam, observers, more)['metrics']
    row = {column: metrics[n]['value'] for column, n in _QUALITY.items() if n in metrics}
    if 'psnr_rest_db' in row:
        row['hidden_minus_rest_db'] = row['psnr_hidden_db'] - row['psnr_rest_db']
    if times_ms:
        row['inference_ms'] = float(np.median(times_ms))
    if truth is not None and ledger is not None:
        row.update(_scores(ledger.score(), any(o.is_mover for o in truth.objects)))
    return row


def _make_slam(cell: Cell, config: BdgsConfig) -> Any:
    """Return the pipeline, with a detector in trouble if the cell asks for one."""
    from bdgs_ros.detection.detector import make_detector
    from bdgs_ros.pipeline import BdgsSlam

    trouble = cell.settings['trouble']
    if not trouble:
        return BdgsSlam(config)
    from bdgs_ros.detection.trouble import TroubledDetector

    inner = make_detector(config.detection)
    return BdgsSlam(config, TroubledDetector(inner, **trouble, seed=cell.seed))


def _unknown(truth: SynthTruth) -> list[int]:
    return [o.object_id for o in truth.objects if o.is_mover and o.kind == _UNKNOWN_KIND]


def _scores(score: BeliefScore, with_movers: bool) -> dict[str, Any]:
    """Return the columns of a score; without movers there is nothing to be found."""
    moving = {
        'precision': score.precision,
        'recall': score.recall,
        'unknown_recall': score.unknown_recall,
    }
    return {
        **(moving if with_movers else {}),
        'false_removal_percent': 100 * score.false_removal,
        'restored_percent': 100 * score.restored_share,
        'settled_percent': 100 * score.settled_share,
        'counts': score.counts(),
    }


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return medians over scenarios and seeds of the full configuration, the worst, and cost."""
    full = [r for r in rows if r['configuration'] == _FULL and _is_synth(r)]
    asked: dict[str, Any] = {
        'recall': _median(full, 'recall'),
        'precision': _median(full, 'precision'),
        'false_removal': _share(_median(full, 'false_removal_percent')),
        'restored': _share(_median(full, 'restored_percent')),
        'unknown_recall': _median(full, 'unknown_recall'),
    }
    summary: dict[str, Any] = {}
    for column in (*_OVERVIEW[3:], 'inference_ms'):
        summary[f'{column}_median'] = _median(full, column)
    for column in _OVERVIEW:
        summary[f'{column}_worst'] = _worst(full, column)
    pooled = BeliefScore()
    for row in full:
        pooled += BeliefScore.of(row.get('counts') or {})
    summary.update(
        pooled_recall=pooled.recall,
        pooled_precision=pooled.precision,
        pooled_false_removal=pooled.false_removal,
        pooled_restored=pooled.restored_share,
        inference_50k_ms=_median(rows, 'inference_50k_ms'),
    )
    return {**asked, **{name: value for name, value in summary.items() if value is not None}}


def overviews(rows: Sequence[Mapping[str, Any]]) -> dict[str, list[dict[str, Any]]]:
    """Return median and worst of each recording and configuration over its seeds."""
    found = []
    for name in dict.fromkeys((row['sequence'], row['configuration']) for row in rows):
        own = [row for row in rows if (row['sequence'], row['configuration']) == name]
        line: dict[str, Any] = {'sequence': name[0], 'configuration': name[1], 'runs': len(own)}
        for column in _OVERVIEW:
            line[column] = _median(own, column)
            line[f'{column}, worst'] = _worst(own, column)
        found.append(line)
    empty = {c for c in _OVERVIEW if all(line[c] is None for line in found)}
    empty |= {f'{column}, worst' for column in empty}
    return {
        'Median and worst over seeds': [
            {k: v for k, v in line.items() if k not in empty} for line in found
        ]
    }


def _is_synth(row: Mapping[str, Any]) -> bool:
    return str(row['sequence']).startswith(sequences.synth_name(''))


def _known(rows: Iterable[Mapping[str, Any]], column: str) -> list[float]:
    values = (row.get(column) for row in rows)
    return [value for value in values if value is not None]


def _median(rows: Sequence[Mapping[str, Any]], column: str) -> float | None:
    values = _known(rows, column)
    return float(np.median(values)) if values else None


def _worst(rows: Sequence[Mapping[str, Any]], column: str) -> float | None:
    values = _known(rows, column)
    return (max if column in _WORST_IS_MOST else min)(values) if values else None


def _share(percent: float | None) -> float | None:
    return None if percent is None else percent / 100
