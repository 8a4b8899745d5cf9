"""
Run a whole recording through the pipeline, and write down what came out.

`bdgs run`, the benches and the end of `slam_node` all write their results here, so that the files
are the same whichever way a recording was run.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Protocol

from bdgs_ros.core.config import BdgsConfig, specs
from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.files import write_text
from bdgs_ros.core.threads import one_thread_in_cv2
from bdgs_ros.core.types import RgbdFrame, TrackingResult, Trajectory
from bdgs_ros.data.trajectory_io import write_trajectory
from bdgs_ros.eval import pictures, plots, provenance, scores, trajectory
from bdgs_ros.eval.honesty import honesty_metrics
from bdgs_ros.eval.labels import LabelScore, score_labels
from bdgs_ros.eval.metric import Metric, as_dict, dump_json
from bdgs_ros.eval.recorder import Recorder, RunResult

_LOGGER = logging.getLogger(__name__)


class Outcome(Protocol):
    """What the pipeline says about a frame; see `bdgs_ros.pipeline.FrameResult`."""

    @property
    def tracking(self) -> TrackingResult:
        """The camera pose."""

    @property
    def gave_up(self) -> bool:
        """Whether all poses before this frame are in a world that is no more."""


class Slam(Protocol):
    """What can be run; see `bdgs_ros.pipeline.BdgsSlam`."""

    detection: Any
    tracker: Any
    back_end: Any
    mapper: Any

    def process(self, frame: RgbdFrame) -> Outcome:
        """Take the next frame."""


class StaticMap(scores.Renderer, Protocol):
    """The map at the end of a run; see `bdgs_ros.mapping.mapper.Mapper`."""

    def final_trajectory(self, online: Trajectory) -> Trajectory:
        """Return poses with what mapping found out later."""

    def save(self, path: Path, *, keyframes: bool = True) -> None:
        """Write the Gaussians as .ply and, if wanted, the keyframes beside it."""


Observer = Callable[[RgbdFrame, TrackingResult], None]


@dataclass
class LabelObserver:
    """Pool the label scores of all frames of a recording with truth."""

    truth: scores.Truth
    score: LabelScore = field(default_factory=LabelScore)

    def __call__(self, frame: RgbdFrame, tracking: TrackingResult) -> None:
        """Compare what tracking called dynamic with the truth."""
        mask = self.truth.dynamic(frame.stamp_ns)
        self.score = self.score + score_labels(tracking.p_dynamic, mask)


class _Timed:
    """Stand in front of a stage and note how long `process` took."""

    def __init__(self, stage: Any, name: str, times_ms: dict[str, float]) -> None:
        self._stage, self._name, self._times_ms = stage, name, times_ms

    def process(self, *arguments: Any) -> Any:
        start = time.perf_counter()
        try:
            return self._stage.process(*arguments)
        finally:
            self._times_ms[self._name] = 1e3 * (time.perf_counter() - start)

    def __getattr__(self, name: str) -> Any:
        return getattr(self._stage, name)


def run_sequence(
    frames: Iterable[RgbdFrame],
    slam: Slam,
    observers: Sequence[Observer] = (),
    recorder: Recorder | None = None,
) -> RunResult:
    """
    Process every frame in order, timing each stage.

    Parameters
    ----------
    frames : iterable of RgbdFrame
        The recording; wrap it in a progress bar if wanted.
    slam : BdgsSlam
        Left holding the final map.
    observers : sequence of callable
        Called with every frame and its tracking result, outside of the timing.
    recorder : Recorder, optional
        Collects the result; a new one by default.

    Returns
    -------
    result : RunResult
        One row per frame, times in milliseconds: `detection`, `tracking`, `back_end` and
        `mapping` (keyframes alone) and `frame`, all of them together.

    """
    one_thread_in_cv2()
    recorder = Recorder() if recorder is None else recorder
    times_ms: dict[str, float] = {}
    stages = slam.detection, slam.tracker, slam.back_end, slam.mapper
    names = 'detection', 'tracking', 'back_end', 'mapping'
    slam.detection, slam.tracker, slam.back_end, slam.mapper = (
        _Timed(stage, name, times_ms) for stage, name in zip(stages, names, strict=True)
    )
    begun, watched_s = time.perf_counter(), 0.0
    try:
        for frame in frames:
            times_ms.clear()
            start = time.perf_counter()
            outcome = slam.process(frame)
            times_ms['frame'] = 1e3 * (time.perf_counter() - start)
            if outcome.gave_up:
                recorder.give_up()
            recorder.add(frame, outcome.tracking, times_ms)
            watching = time.perf_counter()
            for observe in observers:
                observe(frame, outcome.tracking)
            watched_s += time.perf_counter() - watching
    finally:
        slam.detection, slam.tracker, slam.back_end, slam.mapper = stages
    return recorder.result(time.perf_counter() - begun - watched_s)


def write_results(
    folder: Path,
    result: RunResult,
    static_map: StaticMap | None = None,
    *,
    name: str = '',
    ground_truth: Trajectory | None = None,
    final: Trajectory | None = None,
    truth: scores.Truth | None = None,
    more: Sequence[Metric] = (),
    config: BdgsConfig | None = None,
    frames_expected: int | None = None,
    notes: Sequence[str] = (),
    extra: Mapping[str, Any] | None = None,
    save_map: bool = True,
    keep_keyframes: bool = True,
    with_pictures: bool = True,
) -> dict[str, Any]:
    """
    Write trajectory, map, metrics and pictures of a run.

    Ground truth is used for the figures and the plot alone, after the run.

    Parameters
    ----------
    folder : Path
        Gets `trajectory.txt` (TUM, as tracking gave it), `trajectory_final.txt` (with what
        mapping found out later), `map.ply`, `map_keyframes`, `metrics.json`, and the pictures
        `tiles.png`, `animation.gif` and `trajectory.png`.
    result : RunResult
        What `run_sequence` or a `Recorder` collected.
    static_map : Mapper, optional
        Without it there is no map and no render.
    name : str
        Of the recording, for titles.
    ground_truth : Trajectory, optional
        For ATE and RPE.
    final : Trajectory, optional
        With what mapping found out later; by default what the map says.
    truth : Truth, optional
        Static views of a synthetic recording.
    more : sequence of Metric
        Further figures, for example the label scores of an observer.
    config : BdgsConfig, optional
        Written into the metrics.
    frames_expected : int, optional
        For the coverage; by default the number of frames that came.
    notes : sequence of str
        What else is to be said of the run.
    extra : mapping, optional
        More entries for the metrics file, for example how the run was started.
    save_map : bool
        False where `map.ply` in the folder is the map already.
    keep_keyframes : bool
        Whether to write the images too that the map can be refined with.
    with_pictures : bool
        Whether to draw.

    Returns
    -------
    metrics : dict
        What `metrics.json` holds.

        A ground truth that does not belong to the run is a note in it, not an error.

    Raises
    ------
    DatasetError, MapError, OSError
        If a file cannot be written.

    """
    folder.mkdir(parents=True, exist_ok=True)
    est = result.trajectory
    write_trajectory(folder / 'trajectory.txt', est)
    found = [*result.count_metrics(), *result.time_metrics()]
    expected = len(result.rows) if frames_expected is None else frames_expected
    ate, objections = _compare(ground_truth, est, expected)
    found += _trajectory_metrics(est, expected, ground_truth, ate)
    if ground_truth is not None and ate is not None:
        found += honesty_metrics(ground_truth, est, result.rows)
    found += more
    views: list[scores.View] = []
    if static_map is not None:
        if save_map:
            static_map.save(folder / 'map.ply', keyframes=keep_keyframes)
        found += map_metrics(folder / 'map.ply')
        final = static_map.final_trajectory(est) if final is None else final
        views = scores.render_samples(result.samples, static_map)
        found += scores.render_metrics(views, truth)
    if final is not None:
        write_trajectory(folder / 'trajectory_final.txt', final)
        found += _final_metrics(final, ground_truth, ate)
    if with_pictures:
        _draw(folder, est, views, ground_truth, ate, name)
    metrics = metrics_document(
        name, found, config, {**(extra or {}), 'notes': [*notes, *objections]}
    )
    write_text(folder / 'metrics.json', dump_json(metrics) + '\n')
    return metrics


def _compare(
    gt: Trajectory | None, est: Trajectory, expected: int
) -> tuple[trajectory.AteResult | None, list[str]]:
    """Compare if possible; a truth that does not fit must not cost the results of the run."""
    if gt is None or not len(gt):
        return None, []
    try:
        return trajectory.ate(gt, est, frames_expected=expected), []
    except EvaluationError as error:
        message = f'no comparison with the ground truth: {error}'
        _LOGGER.warning('%s', message)
        return None, [message]


def _trajectory_metrics(
    est: Trajectory, expected: int, gt: Trajectory | None, ate: trajectory.AteResult | None
) -> list[Metric]:
    if gt is not None and ate is not None:
        return scores.trajectory_metrics(gt, est, expected)
    share = 100.0 * len(est) / expected if expected else float('nan')
    return [Metric('coverage', share, '%'), Metric('frames', len(est))]


def _final_metrics(
    final: Trajectory, gt: Trajectory | None, online: trajectory.AteResult | None
) -> list[Metric]:
    """Return the error of the final trajectory where that of the online one is known."""
    if gt is None or online is None:
        return []
    errors = trajectory.ate(gt, final).statistics
    return [
        Metric('ate_final_rmse', 100.0 * errors.rmse, 'cm'),
        Metric('ate_final_max', 100.0 * errors.max, 'cm'),
    ]


def map_metrics(path: Path) -> list[Metric]:
    """Return the number of Gaussians and the size of a saved map."""
    return [
        Metric('gaussians', _vertices(path)),
        Metric('map_size', path.stat().st_size / 1e6, 'MB'),
    ]


def _vertices(path: Path) -> int:
    with path.open('rb') as file:
        for line in file:
            words = line.split()
            if words[:2] == [b'element', b'vertex']:
                return int(words[2])
            if words == [b'end_header']:
                break
    raise EvaluationError(f"'{path}' is no .ply map: its header has no 'element vertex'")


def _draw(
    folder: Path,
    est: Trajectory,
    views: Sequence[scores.View],
    ground_truth: Trajectory | None,
    ate: trajectory.AteResult | None,
    name: str,
) -> None:
    if views:
        pictures.write_tiles(folder / 'tiles.png', views)
        pictures.write_animation(folder / 'animation.gif', views)
    if len(est):
        plots.plot_trajectory(folder / 'trajectory.png', est, ground_truth, ate, name)


def metrics_document(
    name: str,
    metrics: Iterable[Metric],
    config: BdgsConfig | None,
    extra: Mapping[str, Any],
) -> dict[str, Any]:
    """Return the content of `metrics.json`: figures, how they came about, and on what."""
    values = {} if config is None else {spec.name: spec.value for spec in specs(config)}
    return {
        'sequence': name,
        'metrics': as_dict(metrics),
        **extra,
        'config': values,
        'provenance': provenance.provenance(),
    }
