"""Bench `accuracy`: how far off is the camera pose, and what is each part of tracking worth."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import Any

from bdgs_ros.bench import accuracy_summary, sequences
from bdgs_ros.bench.accuracy_summary import FULL
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.bench.sequences import REAL
from bdgs_ros.core.config import BdgsConfig, specs
from bdgs_ros.eval.honesty import WITHIN

NAME = 'accuracy'
SEEDS = 5
PARALLEL = True
prepare = sequences.prepare
summarise = accuracy_summary.summarise
overviews = accuracy_summary.overviews
draw = accuracy_summary.draw_reliability
PROTOCOL = """
Every colour frame with depth goes through the pipeline in order, none dropped; truth is used for
the figures alone. online: the pose as tracking gave it at its frame; final: with what mapping
found out later. ATE in cm over all frames with a pose, nearest ground truth within 20 ms, rigid
Horn alignment without scale; max: the largest error of a frame; coverage: frames with a pose over
frames. RPE: translation in cm and rotation in degrees from each frame to the next, and over one
second. A frame that is lost has no pose. ms: tracking of a frame. Configurations: weights is the
whole method with a detector, each other one has one part off or another prediction; no_loop joins
keyframes with the newest ones alone.
"""

SWITCHES: dict[str, dict[str, str]] = {
    'no_masks': {'tracking.masked': 'false'},
    'no_belief': {'belief.enabled': 'false'},
    'no_refinement': {'tracking.refine.enabled': 'false'},
    'no_prediction': {'tracking.motion.model': 'none'},
    'plain_velocity': {'tracking.motion.model': 'velocity'},
    'no_bundle': {'back_end.bundle.enabled': 'false'},
    'no_loop': {'back_end.loop.enabled': 'false', 'back_end.bundle.older': '0'},
}
"""The whole method with one part off; one that this version does not have is left out."""

_SWITCHED = ('static', 'walking_xyz', 'walking_rpy', 'walking_halfsphere', 'crowd')
_LOOP = 'loop_room'
_SWITCHED_ELSEWHERE = {'no_bundle': (*_SWITCHED, _LOOP), 'no_loop': (_LOOP,)}
_FEW_SEEDS = 2
_QUICK_SCENARIOS = ('static', 'walking_xyz')
_COLUMNS = {
    'online_cm': 'ate_rmse',
    'online_max_cm': 'ate_max',
    'final_cm': 'ate_final_rmse',
    'final_max_cm': 'ate_final_max',
    'coverage_percent': 'coverage',
    'lost': 'frames_lost',
    'rpe_frame_cm': 'rpe_translation_frame_rmse',
    'rpe_frame_deg': 'rpe_rotation_frame_rmse',
    'rpe_second_cm': 'rpe_translation_second_rmse',
    'rpe_second_deg': 'rpe_rotation_second_rmse',
    'keyframes': 'keyframes',
    'frames': 'frames_in',
    'nees': 'nees',
    'beyond_3_sigma_pct': 'beyond_3_sigma',
    **{f'within_{share}_pct': f'within_{share}' for share in WITHIN},
    'tracking_ms': 'tracking_median',
    'tracking_p95_ms': 'tracking_p95',
}


def cells(options: Options) -> list[Cell]:
    """List the whole method everywhere, then each switch on the real and some synthetic ones."""
    from bdgs_ros.data.synth import field_scenarios, scenarios

    names = _QUICK_SCENARIOS if options.quick else scenarios() + field_scenarios()
    found = _on(FULL, names, options.seeds, options)
    for switch in () if options.quick else known_switches():
        names = _SWITCHED_ELSEWHERE.get(switch, _SWITCHED)
        found += _on(switch, names, options.seeds[:_FEW_SEEDS], options)
    return found


def known_switches() -> list[str]:
    """Return the switches whose parameters exist."""
    known = {spec.name for spec in specs(BdgsConfig())}
    return [name for name, values in SWITCHES.items() if known.issuperset(values)]


def _on(
    configuration: str, scenarios: Sequence[str], seeds: Iterable[int], options: Options
) -> list[Cell]:
    """One configuration on the real recordings and on some seeds of each scenario."""
    common = {
        'values': {**SWITCHES.get(configuration, {}), **options.values},
        'weights': sequences.weights_path(options).name,
    }
    real = {**sequences.real_settings(options), **common}
    found = [Cell(sequence.name, configuration, 0, real) for sequence in REAL]
    for name in scenarios:
        synth = {**sequences.synth_settings(name, options), **common}
        found += [Cell(sequences.synth_name(name), configuration, s, synth) for s in seeds]
    return found


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Run one recording with one configuration; its trajectories stay in the work folder."""
    from bdgs_ros.job import Job, run_job

    job = Job(
        sequences.cell_recording(cell, options),
        options.work / 'runs' / cell.key,
        sequences.config_of(cell.settings['values'], True, options),
        frames=sequences.frame_limit(cell),
        pictures=False,
        samples=0,
        progress=options.jobs == 1,
        keyframes=False,
    )
    metrics = run_job(job)['metrics']
    _draw(job.recording, job.output, cell.label)
    return {column: metrics[name]['value'] for column, name in _COLUMNS.items() if name in metrics}


def _draw(recording: Path, folder: Path, title: str) -> None:
    """Draw the error over time of both trajectories, where the truth is known."""
    from bdgs_ros.data.layouts import open_sequence
    from bdgs_ros.data.trajectory_io import read_trajectory
    from bdgs_ros.eval import plots, trajectory

    truth = open_sequence(recording).ground_truth
    if truth is None:
        return
    results = {
        name: trajectory.ate(truth, read_trajectory(folder / file))
        for name, file in (('online', 'trajectory.txt'), ('final', 'trajectory_final.txt'))
    }
    plots.plot_errors(folder / 'errors.png', results, title)
