"""
Improve the map of a finished run for a limited time, and say by how much.

Only frames that were keyframes of the run are used to improve it, so that all others can test it.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from bdgs_ros.core.config import BdgsConfig, MappingConfig
from bdgs_ros.core.errors import ConfigError, EvaluationError, MapError
from bdgs_ros.core.files import write_text
from bdgs_ros.data.trajectory_io import read_trajectory, write_trajectory
from bdgs_ros.eval import pictures, scores
from bdgs_ros.eval.metric import Metric, as_dict, dump_json
from bdgs_ros.runner import map_metrics, metrics_document

if TYPE_CHECKING:
    from bdgs_ros.eval.recorder import Sample
    from bdgs_ros.mapping.mapper import Mapper

OnStep = Callable[[float, float], None]
"""Called after each step with elapsed seconds and loss."""


@dataclass(frozen=True)
class RefineReport:
    """How long a refinement took and what it did to the loss."""

    iterations: int
    seconds: float
    loss_before: float
    """Mean over the first pass through the keyframes."""
    loss_after: float
    """Mean over the last pass."""
    interrupted: bool = False

    def metrics(self) -> list[Metric]:
        """Return the figures with their units."""
        return [
            Metric('refine_iterations', self.iterations),
            Metric('refine_time', self.seconds, 's'),
            Metric('refine_loss_before', self.loss_before),
            Metric('refine_loss_after', self.loss_after),
        ]


@dataclass(frozen=True)
class RefineJob:
    """What to refine, for how long, and where to leave the result."""

    folder: Path
    """Results of a run, with `map.ply` and `map_keyframes`."""
    output: Path
    seconds: float | None = 60.0
    iterations: int | None = None
    """Whichever limit comes first ends the refinement; None is no limit."""
    recording: Path | None = None
    """For scores before and after."""
    camera_file: Path | None = None
    config: BdgsConfig = field(default_factory=BdgsConfig)
    progress: bool = True


def refine_map(
    mapper: Mapper,
    config: MappingConfig,
    seconds: float | None = 60.0,
    iterations: int | None = None,
    on_step: OnStep | None = None,
) -> RefineReport:
    """
    Go on optimising the map that a mapper holds, over the keyframes it holds.

    Parameters
    ----------
    mapper : Mapper
        Of a run, or after `load`; changed in place.
    config : MappingConfig
        Weights, learning rates and seed.
    seconds, iterations : float, int, optional
        Limits; whichever comes first ends it. An interrupt (Ctrl-C) ends it too.
    on_step : callable, optional
        For a progress bar.

    Returns
    -------
    report : RefineReport
        What was done.

    Raises
    ------
    ConfigError
        Without any limit, or with one that is not positive.
    MapError
        If there are no keyframes.

    """
    from bdgs_ros.mapping.refiner import Refiner

    _check_limits(seconds, iterations)
    refiner = Refiner(mapper.map, mapper.keyframes, config)
    losses: list[float] = []
    start, elapsed_s, interrupted = time.perf_counter(), 0.0, False
    try:
        while (done := _progress(elapsed_s, len(losses), seconds, iterations)) < 1.0:
            losses.append(refiner.step(done))
            elapsed_s = time.perf_counter() - start
            if on_step is not None:
                on_step(elapsed_s, losses[-1])
    except KeyboardInterrupt:  # what has been gained by now is worth saving
        interrupted = True
    count = min(len(mapper.keyframes), len(losses))
    before, after = (_mean(losses[:count]), _mean(losses[len(losses) - count :]))
    return RefineReport(len(losses), elapsed_s, before, after, interrupted)


def _check_limits(seconds: float | None, iterations: int | None) -> None:
    if seconds is None and iterations is None:
        raise ConfigError('refinement needs a limit: seconds, iterations or both')
    for name, limit in (('seconds', seconds), ('iterations', iterations)):
        if limit is not None and not limit > 0:
            raise ConfigError(f'{name} of the refinement: expected more than 0, received {limit}')


def _progress(
    elapsed_s: float, count: int, seconds: float | None, iterations: int | None
) -> float:
    """Return the share that is done by the limit that is closer."""
    by_time = 0.0 if seconds is None else elapsed_s / seconds
    by_count = 0.0 if iterations is None else count / iterations
    return max(by_time, by_count)


def _mean(losses: Sequence[float]) -> float:
    return float(np.mean(losses)) if losses else float('nan')


def refine_job(job: RefineJob) -> dict[str, Any]:
    """
    Refine the map of a run and write `map.ply`, its keyframes, `trajectory.txt`, `metrics.json`.

    Returns
    -------
    metrics : dict
        What `metrics.json` holds: `metrics` after the refinement and, with a recording,
        `metrics_before`, both over frames that never were keyframes.

    Raises
    ------
    BdgsError
        If map, keyframes, trajectory or recording are missing, damaged, or do not belong
        together; or if the result cannot be written.

    """
    from bdgs_ros.mapping.mapper import Mapper

    mapper = Mapper(job.config.mapping, job.config.belief)
    mapper.load(job.folder / 'map.ply')
    if not mapper.keyframes:
        raise MapError(
            f"'{job.folder / 'map_keyframes'}' is missing: a map is refined with the keyframes it "
            'was made of; run `bdgs run` again without --no-keyframes'
        )
    views = _Views(job, mapper)
    before = views.metrics()
    report = _refine_with_bar(job, mapper)
    after = views.metrics()
    mapper.save(job.output / 'map.ply')
    views.write(job.output)
    found = [*report.metrics(), *map_metrics(job.output / 'map.ply'), *after]
    extra = {
        'refined_from': str(job.folder),
        'keyframes_used': len(mapper.keyframes),
        'interrupted': report.interrupted,
        'metrics_before': as_dict(before),
        'notes': views.notes,
    }
    metrics = metrics_document(views.name, found, job.config, extra)
    write_text(job.output / 'metrics.json', dump_json(metrics) + '\n')
    return metrics


def _refine_with_bar(job: RefineJob, mapper: Mapper) -> RefineReport:
    from tqdm import tqdm

    by_time = job.seconds is not None
    total = job.seconds if by_time else job.iterations
    form = '{desc}: {percentage:3.0f}%|{bar}| {n:.0f}/{total:.0f} {unit}{postfix}'
    with tqdm(
        total=total,
        desc='refine',
        unit='s' if by_time else 'steps',
        bar_format=form,
        file=sys.stderr,
        disable=not job.progress,
        leave=False,
    ) as bar:
        count = 0

        def on_step(elapsed_s: float, loss: float) -> None:
            nonlocal count
            count += 1
            bar.set_postfix_str(f'loss {loss:.4f}, step {count}', refresh=False)
            bar.update((min(elapsed_s, bar.total) if by_time else count) - bar.n)

        return refine_map(mapper, job.config.mapping, job.seconds, job.iterations, on_step)


class _Views:
    """The frames that test the map, if there is a recording to take them from."""

    def __init__(self, job: RefineJob, mapper: Mapper) -> None:
        self.name = job.folder.name
        self.notes: list[str] = []
        self._mapper = mapper
        self._truth: scores.Truth | None = None
        self._samples: Sequence[Sample] = ()
        self._trajectory_file = job.folder / 'trajectory.txt'
        if job.recording is not None:
            self._read(job, job.recording)

    def _read(self, job: RefineJob, recording: Path) -> None:
        from bdgs_ros.data.layouts import open_sequence
        from bdgs_ros.job import open_truth
        from bdgs_ros.rescore import relabel

        sequence = open_sequence(
            recording, job.camera_file, depth_offset_s=job.config.camera.depth_offset_s
        )
        self.name = sequence.name
        self._truth = open_truth(recording)
        est = read_trajectory(self._trajectory_file)
        trained = frozenset(self._mapper.history.stamps_ns)
        result, _ = relabel(sequence, est, job.config, self._truth, trained)
        self._samples = _untrained(result.samples, trained)

    def metrics(self) -> list[Metric]:
        """Score the map as it is now; nothing without a recording."""
        if not self._samples:
            return []
        return scores.render_metrics(self._render(), self._truth)

    def _render(self) -> list[scores.View]:
        return scores.render_samples(self._samples, self._mapper)

    def write(self, folder: Path) -> None:
        """Leave pictures and the trajectory beside the map, so that the folder is complete."""
        if self._trajectory_file.is_file():
            text = self._trajectory_file.read_text(encoding='utf-8')
            write_text(folder / 'trajectory.txt', text)
            final = self._mapper.final_trajectory(read_trajectory(self._trajectory_file))
            write_trajectory(folder / 'trajectory_final.txt', final)
        if self._samples:
            pictures.write_tiles(folder / 'tiles.png', self._render())


def _untrained(samples: Sequence[Sample], trained: Collection[int]) -> list[Sample]:
    kept = [sample for sample in samples if sample.frame.stamp_ns not in trained]
    if not kept:
        raise EvaluationError(
            f'all {len(samples)} frames that could test the map were keyframes of its run; '
            'leave --recording out'
        )
    return kept
