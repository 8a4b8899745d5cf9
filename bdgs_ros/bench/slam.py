"""Bench `slam`: accuracy of pose, labels and render on real and synthetic recordings."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from bdgs_ros.bench import sequences
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.bench.sequences import REAL

NAME = 'slam'
PARALLEL = True
prepare = sequences.prepare
PROTOCOL = """
Every colour frame with depth goes through the pipeline in order, none dropped. ATE: RMSE in cm
over all estimated frames, nearest ground truth within 20 ms, rigid Horn alignment without scale;
coverage: frames with a pose over frames. precision and recall: dynamic pixels pooled over all
frames, against exact masks (synthetic only). psnr: the final static map at the estimated poses of
up to 40 evenly spaced frames that were no keyframes; synthetic: against the true image of the
static world, all pixels; real: against the input, pixels called dynamic left out. psnr_hidden:
only the pixels that something moving covered. ms: medians, `mapping` per keyframe.
"""

_QUICK_SCENARIOS = ('static', 'walking_static')

_COLUMNS = {
    'frames': 'frames_in',
    'coverage_percent': 'coverage',
    'ate_rmse_cm': 'ate_rmse',
    'ate_final_cm': 'ate_final_rmse',
    'ate_max_cm': 'ate_max',
    'precision': 'dynamic_precision',
    'recall': 'dynamic_recall',
    'false_positive_rate': 'dynamic_false_positive_rate',
    'psnr_db': 'psnr',
    'psnr_exposure_fit_db': 'psnr_exposure_fit',
    'psnr_hidden_db': 'psnr_hidden',
    'ssim': 'ssim',
    'gaussians': 'gaussians',
    'map_mb': 'map_size',
    'detection_ms': 'detection_median',
    'tracking_ms': 'tracking_median',
    'mapping_ms': 'mapping_median',
    'keyframes': 'keyframes',
}


def cells(options: Options) -> list[Cell]:
    """List real and synthetic recordings, each with weights and with the geometric prior alone."""
    from bdgs_ros.data.synth import scenarios

    names = _QUICK_SCENARIOS if options.quick else tuple(scenarios())
    found = []
    for configuration in ('weights', 'geometric'):
        common = sequences.detector_settings(configuration, options)
        for sequence in REAL:
            settings = {**sequences.real_settings(options), **common}
            found.append(Cell(sequence.name, configuration, 0, settings))
        for name in names:
            settings = {**sequences.synth_settings(name, options), **common}
            sequence_name = sequences.synth_name(name)
            found += [Cell(sequence_name, configuration, s, settings) for s in options.seeds]
    return sorted(found, key=lambda cell: (cell.settings['kind'], cell.sequence, cell.seed))


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Run one recording with one configuration; its result files stay in the work folder."""
    from bdgs_ros.job import Job, run_job

    config = sequences.cell_config(cell, options)
    recording = sequences.cell_recording(cell, options)
    output = options.work / 'runs' / cell.key
    limit = sequences.frame_limit(cell)
    job = Job(recording, output, config, frames=limit, progress=options.jobs == 1)
    metrics = run_job(job)['metrics']
    return {column: metrics[name]['value'] for column, name in _COLUMNS.items() if name in metrics}


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return ATE of each real recording, and medians and worst over the synthetic ones."""
    summary: dict[str, Any] = {}
    for configuration in dict.fromkeys(row['configuration'] for row in rows):
        own = [row for row in rows if row['configuration'] == configuration]
        for sequence in REAL:
            summary[f'{sequence.name}_ate_cm_{configuration}'] = _pick(own, sequence.name)
        synth = [row for row in own if row['sequence'].startswith('synth_')]
        for column in ('ate_rmse_cm', 'precision', 'recall', 'psnr_db'):
            values = [row[column] for row in synth if row.get(column) is not None]
            if values:
                summary[f'synth_{column}_median_{configuration}'] = float(np.median(values))
        errors = [row['ate_rmse_cm'] for row in synth if row.get('ate_rmse_cm') is not None]
        if errors:
            summary[f'synth_ate_rmse_cm_worst_{configuration}'] = max(errors)
    covered = [row.get('coverage_percent') for row in rows]
    known = [value for value in covered if value is not None]
    summary['coverage_percent_min'] = min(known) if known else None
    return {name: value for name, value in summary.items() if value is not None}


def _pick(rows: Sequence[Mapping[str, Any]], sequence: str) -> float | None:
    return next((row.get('ate_rmse_cm') for row in rows if row['sequence'] == sequence), None)
