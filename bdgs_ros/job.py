"""One whole run: open a recording, run it, score it, write the results."""

from __future__ import annotations

import logging
import sys
import time
from collections import abc
from collections.abc import Callable, Iterable
from contextlib import closing
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

from bdgs_ros.ahead import DetectedAhead
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import Pose, RgbdFrame
from bdgs_ros.data.bag_recording import CameraTopics
from bdgs_ros.data.loop import LoopedSequence, LoopedTruth
from bdgs_ros.data.sequence import ReadableFrames, Sequence
from bdgs_ros.data.synth.truth import SynthTruth
from bdgs_ros.eval.metric import Metric
from bdgs_ros.eval.pictures import write_posterior
from bdgs_ros.eval.posterior import PosteriorWatch
from bdgs_ros.eval.recorder import Recorder, RunResult
from bdgs_ros.eval.scores import Truth
from bdgs_ros.runner import LabelObserver, Observer, run_sequence, write_results
from bdgs_ros.tracking.registration import RegistrationWatch

_LOGGER = logging.getLogger(__name__)


@dataclass(frozen=True)
class Job:
    """What to run and where to leave the results."""

    recording: Path
    output: Path
    config: BdgsConfig = field(default_factory=BdgsConfig)
    camera_file: Path | None = None
    allow_truncated: bool = False
    topics: CameraTopics = field(default_factory=CameraTopics)
    """Of a bag; by default found by their names."""
    start: int = 0
    frames: int | None = None
    loop_frames: int | None = None
    """Play the recording forth and back until there are so many; start and frames are of those."""
    pictures: bool = True
    samples: int = Recorder.max_samples
    """Frames kept for pictures and for scores of the render; 0 for a run for its poses alone."""
    progress: bool = True
    keyframes: bool = True
    """Whether to leave the images too that the map can be refined with."""
    map_file: Path | None = None
    """Map to continue from."""
    start_pose: Pose | None = None
    """About where the camera starts in that map; by default its origin."""
    localise: bool = False
    """Leave that map as it is."""


def run_job(
    job: Job,
    slam: Any = None,
    observers: abc.Sequence[Observer] = (),
    more: Callable[[], Iterable[Metric]] = tuple,
) -> dict[str, Any]:
    """
    Run a recording and write its results.

    Beside what `bdgs_ros.runner.write_results` writes there is `posterior.png`, what the map
    believed at each second of the run.

    Parameters
    ----------
    job : Job
        What and where.
    slam : BdgsSlam, optional
        To run it with; a new one by default. It is left holding the final map.
    observers : sequence of callable
        See `bdgs_ros.runner.run_sequence`.
    more : callable
        Asked for further metrics after the run.

    Returns
    -------
    metrics : dict
        What `metrics.json` holds.

    Raises
    ------
    BdgsError
        If the recording, the weights or the results cannot be read or written.

    """
    from bdgs_ros.pipeline import BdgsSlam

    job, notes = _with_offset(job)
    sequence, truth = _open(job)
    chosen = choose_frames(len(sequence), job.start, job.frames)
    labels = None if truth is None else LabelObserver(truth)
    slam = BdgsSlam(job.config) if slam is None else slam
    posterior = PosteriorWatch(slam.mapper) if job.pictures else None
    if job.map_file is not None:
        slam.start_from(job.map_file, sequence.camera, job.start_pose, localise=job.localise)
    start = time.perf_counter()
    watching = [watch for watch in (labels, posterior) if watch is not None]
    frames = ReadableFrames(sequence, _with_progress(sequence.name, chosen, job.progress))
    result = _run(frames, slam, [*watching, *observers], Recorder(job.samples))
    wall_s = time.perf_counter() - start
    metrics = write_results(
        job.output,
        result,
        slam.mapper,
        name=sequence.name,
        ground_truth=sequence.ground_truth,
        truth=truth,
        more=[
            Metric('frames_skipped', len(frames.skipped) + getattr(sequence, 'repeated', 0)),
            *([] if labels is None else labels.score.metrics()),
            *more(),
        ],
        config=job.config,
        notes=[*notes, *_left_out(sequence, frames), *_apart(slam)],
        extra={'frames': [chosen.start, chosen.stop], 'wall_s': wall_s},
        keep_keyframes=job.keyframes,
        with_pictures=job.pictures,
    )
    if posterior is not None and posterior.samples:
        write_posterior(job.output / 'posterior.png', posterior.samples)
    return metrics


def _run(
    frames: Iterable[RgbdFrame], slam: Any, observers: list[Observer], recorder: Recorder
) -> RunResult:
    """Run all frames, labelled ahead."""
    stage = slam.detection
    slam.detection = ahead = DetectedAhead(stage)
    try:
        with closing(ahead.frames(frames)) as labelled:
            return run_sequence(labelled, slam, observers, recorder)
    finally:
        slam.detection = stage


def _left_out(sequence: Sequence, frames: ReadableFrames) -> list[str]:
    """Say which frames were not run."""
    notes, repeated = [], getattr(sequence, 'repeated', 0)
    if repeated:
        notes.append(f'{repeated} frames have the stamp of the one before: left out')
    if frames.skipped:
        notes.append(f'{len(frames.skipped)} frames left out, the first: {frames.skipped[0]}')
    return notes


def _apart(slam: Any) -> list[str]:
    """Return what is wrong with colour and depth of a run that is over."""
    watch = getattr(slam, 'registration', None)
    if watch is None:
        return []
    watch.finish()
    return [watch.objection] if watch.objection else []


def _with_offset(job: Job) -> tuple[Job, list[str]]:
    """Find out by how much stamps of depth are late, if that was asked for; and say so."""
    camera = job.config.camera
    if not camera.estimate_depth_offset:
        return job, []
    sequence = _paired(job)
    first = choose_frames(len(sequence), job.start, job.frames)
    watch = RegistrationWatch(job.config.tracking.registration)
    late_s = watch.measured_offset_s(sequence[index] for index in first)
    if not late_s:
        return job, []
    camera = replace(camera, depth_offset_s=camera.depth_offset_s + late_s)
    note = f'stamps of depth are late by {camera.depth_offset_s:.3f} s, as measured: corrected'
    _LOGGER.warning('%s', note)
    return replace(job, config=replace(job.config, camera=camera)), [note]


def _open(job: Job) -> tuple[Sequence, Truth | None]:
    sequence, truth = _paired(job), open_truth(job.recording)
    if job.loop_frames is None:
        return sequence, truth
    loop = LoopedSequence(sequence, job.loop_frames)
    return loop, None if truth is None else LoopedTruth(truth, loop)


def _paired(job: Job) -> Sequence:
    from bdgs_ros.data.layouts import open_sequence

    return open_sequence(
        job.recording,
        job.camera_file,
        allow_truncated=job.allow_truncated,
        depth_offset_s=job.config.camera.depth_offset_s,
        topics=job.topics,
    )


def choose_frames(available: int, start: int, count: int | None) -> range:
    """Return the frames to run; `DatasetError` if the recording does not have them."""
    stop = available if count is None else start + count
    if not 0 <= start < stop <= available:
        raise DatasetError(
            f'frames {start} to {stop} were asked for, but the recording has {available}'
        )
    return range(start, stop)


def open_truth(recording: Path) -> SynthTruth | None:
    """Return the truth of a synthetic recording, or None for any other."""
    return SynthTruth(recording) if SynthTruth.available(recording) else None


def _with_progress(name: str, chosen: range, show: bool) -> Iterable[int]:
    from tqdm import tqdm

    bar: Iterable[int] = tqdm(
        chosen, desc=name, unit='frame', file=sys.stderr, disable=not show, leave=False
    )
    return bar
