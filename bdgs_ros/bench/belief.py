"""Bench `belief`: is what the map believes of each Gaussian true, and what is each part worth."""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from bdgs_ros.bench import belief_cost, belief_summary, sequences
from bdgs_ros.bench.belief_summary import FULL, SCORED
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.bench.sequences import REAL
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.eval.belief_score import BeliefScore

if TYPE_CHECKING:
    from bdgs_ros.data.synth.truth import SynthTruth
    from bdgs_ros.job import Job

NAME = 'belief'
SEEDS = 5
PARALLEL = True
summarise = belief_summary.summarise
overviews = belief_summary.overviews
PROTOCOL = """
Every frame goes through the pipeline in order, none dropped; truth is used for the figures alone.
A Gaussian is dynamic if it lies in front of everything that is static at that time (farther than
4 cm + 1 cm/m^2 z^2), static if it lies on a static surface (within 3 cm + 0.5 cm/m^2 z^2), else
not scored; map and camera are as estimated. It is judged once it was visible in three keyframes
since its truth last changed, that of its birth not counted: called dynamic if it is not rendered,
was deleted because of its belief, or because keyframes did not confirm it. precision, recall:
over these. unknown_recall: of those on the box, which no detector knows. false_removal: of the
Gaussians static at the end, those not rendered or deleted by belief. restored: statics that had
been rendered, were hidden, and are seen by the camera: rendered again at a keyframe within 1 s;
settled: the same of statics never rendered before, such as what was just put down. hidden_static:
share of the static pixels that the map knows and belief does not show. label: dynamic pixels of
the labels at camera rate. psnr: as in bench slam; psnr_hidden: pixels that something moving
covered, psnr_rest: the others of the same views. inference_ms: filter and multi-view update of
one keyframe.
"""

SWITCHES: dict[str, dict[str, str]] = {
    'no_belief': {'belief.enabled': 'false'},
    'no_multi_view': {'belief.multi_view': 'false'},
    'no_mapping': {'mapping.enabled': 'false'},
    'no_feedback': {'tracking.refine.posterior': 'false'},
}
"""The full configuration with one part off (Table 6)."""
TROUBLES: dict[str, dict[str, float]] = {
    'drop30': {'drop': 0.3, 'false': 0.0, 'delay_s': 0.0},
    'false10': {'drop': 0.0, 'false': 0.1, 'delay_s': 0.0},
    'late300': {'drop': 0.0, 'false': 0.0, 'delay_s': 0.3},
}
"""The full configuration with a detector that misses, sees ghosts, or answers late."""

_GEOMETRIC = 'geometric'
_SWITCHED = ('walking_xyz', 'unknown_box', 'chair_moved')
_TROUBLED = ('walking_xyz', 'crowd')
_ALSO_GEOMETRIC = ('unknown_box', 'chair_moved')
_FEW_SEEDS = 2
_QUICK_SCENARIOS = ('unknown_box', 'walking_xyz')
_CROWD = REAL[0].name
_STARTS = {_CROWD: 300, sequences.synth_name('crowd'): 150}
_UNKNOWN_KIND = 'box'
_COST = 'gaussians_50000'

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
    'Beliefs': (*SCORED, 'keyframes', 'inference_ms'),
    'Pose, labels and render': (
        'ate_cm', 'coverage_percent', 'label_precision', 'label_recall', 'psnr_db',
        'psnr_hidden_db', 'psnr_rest_db', 'hidden_minus_rest_db', 'gaussians', 'frames',
    ),
    'Cost': ('cost_gaussians', 'cost_views', 'inference_50k_ms'),
}  # fmt: skip


def cells(options: Options) -> list[Cell]:
    """List the full configuration everywhere, then parts off, troubles, late starts, and cost."""
    if options.quick:
        seeds = options.seeds[:1]
        return [_synth(name, FULL, seed, options) for name in _QUICK_SCENARIOS for seed in seeds]
    return [
        *_main(options),
        *_few(SWITCHES, _SWITCHED, options),
        *_few((*TROUBLES, 'absent'), _TROUBLED, options),
        *_late_starts(options),
        Cell(_COST, 'inference', 0, {'kind': 'cost', 'values': dict(options.values)}),
    ]


def _main(options: Options) -> list[Cell]:
    from bdgs_ros.data.synth import scenarios

    found = [_real(sequence.name, FULL, options) for sequence in REAL]
    for name in scenarios():
        found += [_synth(name, FULL, seed, options) for seed in options.seeds]
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
    settings = {**sequences.synth_settings(scenario, options), **common}
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
    from bdgs_ros.job import open_truth, run_job

    job = _job(cell, options)
    if job is None:
        return belief_cost.measure(_config(cell, options))
    slam = _make_slam(cell, job.config)
    times_ms = belief_cost.watch_inference(slam.mapper)
    truth = open_truth(job.recording)
    if truth is None:
        return _row(run_job(job, slam)['metrics'], times_ms)
    ledger = BeliefLedger(slam.mapper, truth, _unknown(truth))
    row = _row(run_job(job, slam, [ledger], ledger.metrics)['metrics'], times_ms)
    return {**row, **_scores(ledger.score(), any(o.is_mover for o in truth.objects))}


def _config(cell: Cell, options: Options) -> BdgsConfig:
    with_weights = bool(cell.settings.get('weights'))
    return sequences.config_of(cell.settings['values'], with_weights, options)


def _job(cell: Cell, options: Options) -> Job | None:
    """Return what is to be run; None for the cell that has no recording."""
    from bdgs_ros.job import Job

    if cell.settings['kind'] == 'cost':
        return None
    return Job(
        sequences.cell_recording(cell, options),
        options.work / 'runs' / cell.key,
        _config(cell, options),
        start=cell.settings['start'],
        frames=sequences.frame_limit(cell),
        progress=options.jobs == 1,
        keyframes=False,
    )


def _row(metrics: Mapping[str, Any], times_ms: Sequence[float]) -> dict[str, Any]:
    row = {column: metrics[n]['value'] for column, n in _QUALITY.items() if n in metrics}
    if not row['gaussians']:  # without mapping there is no render to score
        row = {column: value for column, value in row.items() if not column.endswith('_db')}
    if 'psnr_rest_db' in row:
        row['hidden_minus_rest_db'] = row['psnr_hidden_db'] - row['psnr_rest_db']
    if times_ms:
        row['inference_ms'] = float(np.median(times_ms))
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
