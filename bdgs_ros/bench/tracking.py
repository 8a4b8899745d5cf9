"""Bench `tracking`: what a frame costs and where, alone and live beside the other nodes."""

from __future__ import annotations

import json
import time
from collections.abc import Mapping, Sequence
from dataclasses import astuple
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np

from bdgs_ros.bench import sequences
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.bench.live import bag_of, busy_processes, graph_values, run_graph
from bdgs_ros.bench.sequences import REAL
from bdgs_ros.bench.tracking_parts import PARTS, PartTimes
from bdgs_ros.core.types import StampedPose, TrackingStatus, Trajectory

NAME = 'tracking'
PROTOCOL = """
alone: every frame goes through the pipeline in order, and the time of tracking alone is taken;
detection and mapping run between the frames, not beside them. load is reading and decoding the
frame from its files and no part of tracking. live: slam_node starts detection, tracking and
mapping in processes of their own and replays the recording over DDS in real time, at the rate of
its stamps; nobody waits for anybody. tracked_percent: frames with a pose over frames sent;
passed_over are those that tracking had no time for; latency: from the arrival of the later of both
images to the pose; labels_age: how much older the labels are that a frame is tracked with;
keyframes_mapped: of the keyframes found; end_ms: from the last frame until everything is written.
ATE over the frames with a pose, online and final, as in bench slam. live_beside1: beside one
process, in a session of its own, that uses one processor; _rate2: replayed twice as fast; _no_rr:
with ordinary priorities; 848x480_60hz: a camera of that size and rate. CPU: processor seconds per
second of replay.
"""
_NODES = ('tracking', 'detection', 'mapping', 'replay')
TABLES = {
    'Alone': (
        *('alone_ate_cm', 'alone_ms', 'alone_p95_ms'),
        *(f'{part}_ms' for part in ('load', *PARTS, 'rest')),
    ),
    'Live': (
        *('frames', 'tracked_percent', 'passed_over', 'lost'),
        *('ate_rmse_cm', 'ate_final_cm', 'ate_max_cm'),
        *('tracking_ms', 'tracking_p95_ms', 'latency_ms', 'latency_p95_ms', 'latency_max_ms'),
        *('round_trip_p95_ms', 'labels_age_ms', 'labels', 'shed_most'),
    ),
    'Live, the other nodes': (
        *('keyframes', 'keyframes_mapped', 'back_end_ms', 'back_end_p95_ms', 'mapping_ms'),
        *('end_ms', *(f'{node}_cpu' for node in _NODES)),
    ),
}

_SYNTH = ('walking_xyz', 'loop_room')
_OTHER_CAMERAS = (sequences.SynthCamera(848, 480, 60), sequences.SynthCamera(1280, 720, 30))
_LIVE_COLUMNS = {
    'frames': 'frames_sent',
    'passed_over': 'frames_dropped',
    'lost': 'frames_lost',
    'ate_rmse_cm': 'ate_rmse',
    'ate_final_cm': 'ate_final_rmse',
    'ate_max_cm': 'ate_max',
    'tracking_ms': 'tracking_median',
    'tracking_p95_ms': 'tracking_p95',
    'latency_ms': 'image_to_pose_median',
    'latency_p95_ms': 'image_to_pose_p95',
    'keyframes': 'keyframes',
    'mapping_ms': 'mapping_median',
}
_NODE_COLUMNS = {
    'labels_age_ms': ('tracking', 'labels_age_ms_median'),
    'labels': ('detection', 'labels'),
    'shed_most': ('tracking', 'shed_most'),
    'keyframes_mapped': ('mapping', 'keyframes'),
    'back_end_ms': ('mapping', 'back_end_ms_median'),
    'back_end_p95_ms': ('mapping', 'back_end_ms_p95'),
    'round_trip_p95_ms': ('replay', 'image_to_status_ms_p95'),
    'latency_max_ms': ('tracking', 'image_to_pose_ms_max'),
}


def cells(options: Options) -> list[Cell]:
    """List each recording alone and live; several seeds are repetitions of the live ones."""
    common = sequences.detector_settings('weights', options)
    real = {**sequences.real_settings(options), **common}
    chosen = [(sequence.name, real) for sequence in REAL]
    for scenario in _SYNTH:
        synth = {**sequences.synth_settings(scenario, options), **common}
        chosen.append((sequences.synth_name(scenario), synth))
    chosen += [_other_camera(camera, common, options) for camera in _OTHER_CAMERAS]
    found = []
    for name, settings in chosen:
        found.append(Cell(name, 'alone', 0, settings))
        for how in _live_configurations(options):
            found += [Cell(name, how, seed, settings) for seed in options.seeds]
    return found


def _other_camera(
    camera: sequences.SynthCamera, common: Mapping[str, Any], options: Options
) -> tuple[str, dict[str, Any]]:
    """Return name and settings of the first scenario as another camera sees it."""
    settings = {**sequences.synth_settings(_SYNTH[0], options), **common}
    settings['camera'] = astuple(camera)
    return f'{sequences.synth_name(_SYNTH[0])}{camera.suffix}', settings


def _live_configurations(options: Options) -> list[str]:
    """List `live`, with what is beside it and how fast it is, and without real-time threads."""
    names = []
    for beside, rate in product(options.beside, options.rates):
        name = 'live' + (f'_beside{beside}' if beside else '')
        names.append(name if rate == 1 else f'{name}_rate{rate:g}')
    return [*names, *(f'{name}_no_rr' for name in names)] if options.all_cells else names


def _live_values(configuration: str) -> tuple[int, dict[str, Any]]:
    """Return how many processes are beside, and the parameters of a live configuration."""
    beside, values = 0, {}
    for word in configuration.split('_')[1:]:
        if word.startswith('beside'):
            beside = int(word.removeprefix('beside'))
        elif word.startswith('rate'):
            values['rate'] = float(word.removeprefix('rate'))
        elif word == 'rr':
            values['realtime_priority'] = 0
    return beside, values


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Measure one recording, one way."""
    recording = sequences.cell_recording(_first_seed(cell), options)
    if cell.configuration == 'alone':
        return _alone(recording, cell, options)
    return _live(recording, cell, options)


def _first_seed(cell: Cell) -> Cell:
    return Cell(cell.sequence, cell.configuration, 0, cell.settings)


def _alone(recording: Path, cell: Cell, options: Options) -> dict[str, Any]:
    from bdgs_ros.data.layouts import open_sequence
    from bdgs_ros.eval.trajectory import ate
    from bdgs_ros.pipeline import BdgsSlam

    sequence: Any = open_sequence(recording)
    slam = BdgsSlam(sequences.config_of(options.values, True, options))
    rows: list[dict[str, float]] = []
    poses = []
    with PartTimes() as times:
        count = sequences.frame_limit(cell) or len(sequence)
        for index in range(count):
            start = time.perf_counter()
            frame = sequence[index]
            load_ms = 1e3 * (time.perf_counter() - start)
            result = slam.process(frame).tracking
            rows.append({'load': load_ms, **times.take()})
            if result.status is TrackingStatus.OK:
                poses.append(StampedPose(result.stamp_ns, result.T_world_camera))
    errors = ate(sequence.ground_truth, Trajectory(tuple(poses))).statistics
    return {'alone_ate_cm': 100 * errors.rmse, **part_columns(rows)}


def part_columns(rows: Sequence[Mapping[str, float]]) -> dict[str, float]:
    """Return the median of every part over frames, and of the whole also the 95th percentile."""
    names = ('load', *PARTS)
    times = {name: np.array([row.get(name, 0.0) for row in rows]) for name in (*names, 'all')}
    rest = times['all'] - sum(times[name] for name in PARTS)
    columns = {f'{name}_ms': float(np.median(times[name])) for name in names}
    columns['rest_ms'] = float(np.median(rest))
    columns['alone_ms'] = float(np.median(times['all']))
    columns['alone_p95_ms'] = float(np.percentile(times['all'], 95))
    return columns


def _live(recording: Path, cell: Cell, options: Options) -> dict[str, Any]:
    output = options.work / 'runs' / cell.key
    output.mkdir(parents=True, exist_ok=True)
    beside, own = _live_values(cell.configuration)
    values = graph_values(bag_of(recording, cell, options), output, options)
    with busy_processes(beside):
        run_graph({**values, **own}, output / 'log.txt')
    written = output / 'metrics.json'
    metrics = json.loads(written.read_text(encoding='utf-8'))
    last_sent_s = float(metrics['nodes']['replay']['last_sent_s'])
    end_ms = 1e3 * (written.stat().st_mtime - last_sent_s)
    return {**live_columns(metrics), 'end_ms': end_ms}


def live_columns(metrics: Mapping[str, Any]) -> dict[str, Any]:
    """Return the columns of a live row from the `metrics.json` of slam_node."""
    found = {name: entry['value'] for name, entry in metrics['metrics'].items()}
    row = {column: found[name] for column, name in _LIVE_COLUMNS.items() if name in found}
    for column, (node, name) in _NODE_COLUMNS.items():
        text = metrics['nodes'].get(node, {}).get(name)
        if text is not None:
            row[column] = float(text)
    seconds = float(metrics['nodes'].get('replay', {}).get('played_s', 'nan'))
    for node in _NODES:
        used = metrics['nodes'].get(node, {}).get('cpu_s')
        if used is not None and seconds > 0:
            row[f'{node}_cpu'] = float(used) / seconds
    row['tracked_percent'] = 100.0 * found['frames'] / max(found['frames_sent'], 1)
    return row


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the medians over repetitions of what is promised: time, share, latency, error."""
    summary: dict[str, Any] = {}
    columns = (
        'tracking_ms',
        'tracking_p95_ms',
        'tracked_percent',
        'latency_p95_ms',
        'ate_rmse_cm',
    )
    for key in dict.fromkeys((row['sequence'], row['configuration']) for row in rows):
        own = [row for row in rows if (row['sequence'], row['configuration']) == key]
        for column in columns:
            values = [row[column] for row in own if row.get(column) is not None]
            if values:
                summary[f'{key[0]}_{column}'] = float(np.median(values))
    return summary
