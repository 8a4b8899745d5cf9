"""Bench `recovery`: how soon loss is noticed, how soon the camera is found, and how wrongly."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.bench import sequences
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.bench.sequences import REAL
from bdgs_ros.core.types import TrackingStatus

if TYPE_CHECKING:
    from bdgs_ros.data.faults import FaultySequence
    from bdgs_ros.data.sequence import Sequence as Frames
    from bdgs_ros.tracking.loss import Evidence

NAME = 'recovery'
SEEDS = 5
PARALLEL = True
prepare = sequences.prepare
PROTOCOL = """
Every frame goes through the pipeline in order, none dropped, until 3 s after the fault. black,
grey: the lens is covered for 1 s half way, dark or by something bright, without depth; blind:
depth alone is lost for 1 s; wall: a plane of one colour fills the view for 1 s; jump: the
recording jumps back by 0.5 m or 30 degrees (as far as the recording allows: jumped_m, jumped_deg),
stamps go on at camera rate; none: no fault. Errors are of the position, after rigid alignment of
the frames before the fault to the truth. false_lost: frames without a pose before the fault.
to_lost_s: from its first frame to the first without a pose; empty if it was found again at once.
wrong_ok: frames after the beginning of the fault with a pose more than 10 cm off. to_found_s: from
the first frame with a view to the first good pose (within 10 cm); never_found: 1 if there is none.
sigma_share, the standard deviation of the position that the images leave over the depth of the
view, is the test: largest, 99.8 %, 99 % and median of the good frames; median, 1 % and least of
those that show no known view or were aligned more than 10 cm off.
"""

FAULTS = ('jump', 'black', 'grey', 'blind', 'wall', 'none')
_FAR_M = 0.1  # a pose further off is wrong
_COVERED_S = 1.0
_AFTER_S = 3.0
_QUICK = (('walking_xyz', 'black'),)
_ONLY_ONE_SEED = ('grey', 'blind', 'wall')


def cells(options: Options) -> list[Cell]:
    """List every fault on real recordings and scenarios; the plainer covers with one seed."""
    from bdgs_ros.data.synth import scenarios

    if options.quick:
        return [_synth(name, fault, 0, options) for name, fault in _QUICK]
    real = {**sequences.real_settings(options), **sequences.detector_settings('weights', options)}
    found = [Cell(s.name, fault, 0, real) for s in REAL for fault in FAULTS]
    for name in scenarios():
        for fault in FAULTS:
            seeds = options.seeds[:1] if fault in _ONLY_ONE_SEED else options.seeds
            found += [_synth(name, fault, seed, options) for seed in seeds]
    return found


def _synth(scenario: str, fault: str, seed: int, options: Options) -> Cell:
    detector = sequences.detector_settings('weights', options)
    settings = {**sequences.synth_settings(scenario, options), **detector}
    return Cell(sequences.synth_name(scenario), fault, seed, settings)


@dataclass(frozen=True)
class Fault:
    """A recording with a fault, and between which frames."""

    frames: FaultySequence
    start: int
    stop: int
    figures: Mapping[str, Any]


def make_fault(sequence: Frames, name: str, seed: int) -> Fault:
    """
    Put a fault into a recording.

    Raises
    ------
    DatasetError
        If there is no ground truth, or too little of the recording, for a jump.

    """
    from bdgs_ros.core.errors import DatasetError
    from bdgs_ros.data import faults

    count = len(sequence)
    if name == 'none':
        return Fault(faults.FaultySequence(sequence, np.arange(count)), count, count, {})
    if name != 'jump':
        frames = faults.covered(sequence, count // 2, _COVERED_S, getattr(faults, name), seed)
        return Fault(frames, frames.covered.start, frames.covered.stop, {})
    if sequence.ground_truth is None:
        raise DatasetError(f"'{sequence.name}' has no ground truth to choose a jump by")
    jump = faults.choose_jump(sequence.ground_truth, np.asarray(sequence.stamps_ns))
    figures = {'jumped_m': jump.distance_m, 'jumped_deg': jump.angle_deg}
    return Fault(faults.jumped(sequence, jump), jump.at + 1, jump.at + 1, figures)


@dataclass
class Watch:
    """What came of every frame."""

    positions: list[NDArray[np.float64]]
    has_pose: list[bool]
    evidence: list[Evidence | None]
    tracking_ms: list[float]


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Run one recording with one fault."""
    from bdgs_ros.data.layouts import open_sequence

    config = sequences.config_of(options.values, True, options)
    sequence = open_sequence(sequences.cell_recording(cell, options))
    fault = make_fault(sequence, cell.configuration, cell.seed)
    watch = _run(fault, config)
    times_ms = np.array(watch.tracking_ms)
    lost = ~np.array(watch.has_pose)
    return {
        **fault.figures,
        **score(fault, watch),
        'tracking_ms': float(np.median(times_ms[~lost])),
        'lost_ms': float(np.median(times_ms[lost])) if lost.any() else None,
    }


def _run(fault: Fault, config: Any) -> Watch:
    from bdgs_ros.core.types import Keyframe
    from bdgs_ros.pipeline import BdgsSlam

    slam, watch = BdgsSlam(config), Watch([], [], [], [])
    stamps_ns = fault.frames.stamps_ns
    seen_ns = stamps_ns[min(fault.stop, len(stamps_ns) - 1)]
    stop = int(np.searchsorted(stamps_ns, seen_ns + round(_AFTER_S * 1e9)))
    for index in range(min(stop, len(fault.frames))):
        frame = fault.frames[index]
        labels = slam.detection.process(frame)
        start = time.perf_counter()
        result = slam.tracker.process(frame, labels)
        watch.tracking_ms.append(1e3 * (time.perf_counter() - start))
        slam.tracker.rest()
        if result.is_keyframe:
            keyframe = Keyframe(frame, result.T_world_camera, labels.p_dynamic)
            slam.tracker.set_model(slam.mapper.process(keyframe))
        watch.positions.append(result.T_world_camera[:3, 3])
        watch.has_pose.append(result.status is TrackingStatus.OK)
        watch.evidence.append(slam.tracker.evidence)
    return watch


def score(fault: Fault, watch: Watch) -> dict[str, Any]:
    """Compare what tracking said with the truth."""
    count, start, stop = len(watch.positions), fault.start, fault.stop
    seconds = fault.frames.stamps_ns[:count] * 1e-9
    has_pose = np.array(watch.has_pose)
    error = _errors(fault, watch)
    after = np.arange(count) >= start
    good = has_pose & (error <= _FAR_M)
    before = has_pose & ~after
    bad = after & (~good | (np.arange(count) < stop))
    lost, found = np.flatnonzero(~has_pose & after), np.flatnonzero(good[stop:]) + stop
    row = {
        'false_lost': int((~has_pose & ~after).sum()),
        'ate_before_cm': 100 * float(np.sqrt(np.mean(error[before] ** 2))),
        'wrong_ok': int((has_pose & after & (error > _FAR_M)).sum()),
        **_distribution(watch, good, bad),
    }
    if start >= count:
        return row
    return {
        **row,
        'to_lost_s': float(seconds[lost[0]] - seconds[start]) if len(lost) else None,
        'to_found_s': float(seconds[found[0]] - seconds[stop]) if len(found) else None,
        'never_found': int(not len(found)),
        'after_cm': 100 * float(np.median(error[found])) if len(found) else None,
        'after_max_cm': 100 * float(error[found].max()) if len(found) else None,
    }


def _errors(fault: Fault, watch: Watch) -> NDArray[np.float64]:
    """Return how far each position is off, metres, [N]."""
    from bdgs_ros.eval.trajectory import align

    truth = fault.frames.ground_truth
    assert truth is not None
    positions = np.array(watch.positions)
    true = truth.positions[: len(positions)]
    trusted = np.flatnonzero(watch.has_pose)
    trusted = trusted[trusted < fault.start]
    T = align(true[trusted], positions[trusted])
    return np.asarray(np.linalg.norm(positions @ T[:3, :3].T + T[:3, 3] - true, axis=1))


def _distribution(
    watch: Watch, good: NDArray[np.bool_], bad: NDArray[np.bool_]
) -> dict[str, list[float]]:
    known = np.array([e is not None for e in watch.evidence])
    sigma = np.array([np.nan if e is None else e.sigma_share for e in watch.evidence])
    row = {}
    for name, chosen, shares in (
        ('good_sigma_share', good & known, (1.0, 0.998, 0.99, 0.5)),
        ('bad_sigma_share', bad & known, (0.5, 0.01, 0.0)),
    ):
        if chosen.any():
            row[name] = [round(float(q), 3) for q in np.quantile(sigma[chosen], shares)]
    return row


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return worst and median of each fault over all recordings."""
    summary: dict[str, Any] = {'false_lost': sum(row['false_lost'] for row in rows)}
    for fault in dict.fromkeys(row['configuration'] for row in rows):
        own = [row for row in rows if row['configuration'] == fault]
        summary[f'{fault}_wrong_ok'] = sum(row['wrong_ok'] for row in own)
        summary[f'{fault}_never_found'] = sum(row.get('never_found', 0) for row in own)
        for column in ('to_lost_s', 'to_found_s', 'after_cm'):
            values = [row[column] for row in own if row.get(column) is not None]
            if values:
                summary[f'{fault}_{column}_median'] = float(np.median(values))
                summary[f'{fault}_{column}_worst'] = max(values)
    return summary
