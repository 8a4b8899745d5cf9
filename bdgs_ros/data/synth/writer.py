"""Write a synthetic recording, each frame on its own so that several processes may share them."""

from __future__ import annotations

import multiprocessing
import os
import shutil
import signal
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.threads import one_thread_in_cv2
from bdgs_ros.data.synth.lists import write_lists, write_objects
from bdgs_ros.data.synth.plan import RecordingPlan
from bdgs_ros.data.synth.render import FrameImages, FrameRenderer
from bdgs_ros.data.synth.scenarios import World, find_scenario
from bdgs_ros.data.synth.sensor import (
    DEPTH_SCALE,
    ColorSensor,
    DepthSensor,
    auto_exposure,
    sense_color,
    sense_depth,
)
from bdgs_ros.data.synth.truth import SynthTruth, stamp_text

Progress = Callable[[int, int], None]
"""Called with the number of frames done and their total."""

_EXPOSURE_S = 0.012
_METER_SIZE = 80  # width in pixels of the image that sets the exposure
_METER_EVERY = 4  # frames
_FOLDERS = ('rgb', 'depth')
_TRUTH_FOLDERS = ('dynamic', 'object_id', 'static_color', 'static_depth')


@dataclass(frozen=True)
class RecordingSummary:
    """What was written; coverage is the share of pixels that see something moving."""

    folder: str
    scenario: str
    seed: int
    frames: int
    duration_s: float
    mean_coverage: float
    max_coverage: float


class FrameWorker:
    """Render and write single frames of a plan; one lives in each process."""

    def __init__(self, plan: RecordingPlan, folder: Path) -> None:
        self._plan, self._folder = plan, folder

    @cached_property
    def world(self) -> World:
        """The world of the plan."""
        return self._plan.world()

    @cached_property
    def _renderer(self) -> FrameRenderer:
        return FrameRenderer(self.world, self._plan.camera, _EXPOSURE_S)

    @cached_property
    def _meter(self) -> FrameRenderer:
        camera = self._plan.camera
        small = camera.scaled(min(1.0, _METER_SIZE / camera.width))
        return FrameRenderer(self.world, small, 0.0)

    def brightness(self, frame: int) -> float:
        """Return the mean light of a frame."""
        return self._meter.brightness(self._plan.time_s(frame))

    def write(self, frame: int, gain: float) -> float:
        """Write all images of a frame and return its dynamic coverage."""
        time_s = self._plan.time_s(frame)
        images = self._renderer.render(time_s)
        dynamic = np.isin(images.object_id, self.world.scene.moving_ids(time_s))
        rng = np.random.default_rng([self._plan.seed, 2, frame])
        name = f'{stamp_text(self._plan.stamp_ns(frame))}.png'
        for kind, image in self._files(images, dynamic, gain, rng).items():
            _write_png(self._folder / kind / name, image)
        return float(dynamic.mean())

    def write_lists(self, gains: Sequence[float]) -> None:
        """Write everything that is not an image."""
        write_lists(self._plan, self.world, self._folder, gains)
        write_objects(self._plan, self.world, self._folder)

    def _files(
        self,
        images: FrameImages,
        dynamic: NDArray[np.bool_],
        gain: float,
        rng: np.random.Generator,
    ) -> dict[str, NDArray[Any]]:
        color = sense_color(images.color, gain, ColorSensor(), rng)
        static = np.minimum(images.static_color + 0.5, 255).astype(np.uint8)
        units = np.minimum(images.static_depth_m * DEPTH_SCALE + 0.5, 65535)
        return {
            'rgb': color[..., ::-1],
            'depth': sense_depth(images.depth_m, self._plan.camera, DepthSensor(), rng),
            'truth/dynamic': dynamic.astype(np.uint8) * 255,
            'truth/object_id': images.object_id,
            'truth/static_color': static[..., ::-1],
            'truth/static_depth': units.astype(np.uint16),
        }


def _write_png(path: Path, image: NDArray[Any]) -> None:
    # adaptive filters cost three times as much; on noisy colour matching finds nothing
    flags = [cv2.IMWRITE_PNG_COMPRESSION, 1, cv2.IMWRITE_PNG_FILTER, cv2.IMWRITE_PNG_FILTER_SUB]
    if image.ndim == 3:
        flags += [cv2.IMWRITE_PNG_STRATEGY, cv2.IMWRITE_PNG_STRATEGY_HUFFMAN_ONLY]
    good, data = cv2.imencode('.png', np.ascontiguousarray(image), flags)
    if not good:
        raise DatasetError(f"cannot encode '{path}'")
    path.write_bytes(data.tobytes())


_worker: FrameWorker | None = None  # of this process, set by `_start`


def _start(plan: RecordingPlan, folder: Path) -> None:
    global _worker
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears it and clears up
    one_thread_in_cv2()
    _worker = FrameWorker(plan, folder)


def _brightness(frame: int) -> float:
    assert _worker is not None
    return _worker.brightness(frame)


def _write(frame: int, gain: float) -> float:
    assert _worker is not None
    return _worker.write(frame, gain)


def _write_lists_there(gains: Sequence[float]) -> None:
    assert _worker is not None
    _worker.write_lists(gains)


def write_recording(
    folder: Path,
    scenario: str,
    seed: int,
    frames: int = 300,
    *,
    size: tuple[int, int] = (640, 480),
    rate_hz: float | None = None,
    jobs: int | None = None,
    force: bool = False,
    progress: Progress | None = None,
) -> RecordingSummary:
    """
    Write a synthetic recording; the files depend on scenario, seed, frames, size and rate alone.

    Parameters
    ----------
    folder : Path
        Where it goes; it appears there when it is complete and not before.
    scenario : str
        One of `scenarios()` or `field_scenarios()`.
    seed, frames : int
        Seed of everything that varies, and length.
    size : (int, int)
        Width and height in pixels; the field of view stays that of TUM freiburg3.
    rate_hz : float, optional
        Frames per second; by default those of the scenario.
    jobs : int, optional
        Processes that share the work, by default one for each processor.
    force : bool
        Replace a recording that is there. A folder with anything else is never replaced.
    progress : callable, optional
        Called as `progress(done, frames)`.

    Raises
    ------
    DatasetError
        If the plan is impossible, or the folder holds something that may not be replaced.

    """
    rate_hz = find_scenario(scenario).rate_hz if rate_hz is None else rate_hz
    plan = RecordingPlan(scenario, seed, frames, size[0], size[1], rate_hz)
    plan.validate()
    folder = Path(folder)
    _check_target(folder, force)
    with _set_aside(folder) as partial:
        for name in (*_FOLDERS, *(f'truth/{kind}' for kind in _TRUTH_FOLDERS)):
            (partial / name).mkdir(parents=True)
        workers = min(jobs or os.cpu_count() or 1, frames)
        run = _run_here if workers == 1 else _run_in_processes
        coverage = run(plan, partial, workers, progress or (lambda done, total: None))
    return RecordingSummary(
        folder=str(folder),
        scenario=scenario,
        seed=seed,
        frames=frames,
        duration_s=frames / rate_hz,
        mean_coverage=float(np.mean(coverage)),
        max_coverage=float(np.max(coverage)),
    )


def _metered(plan: RecordingPlan) -> list[int]:
    return sorted({*range(0, plan.frames, _METER_EVERY), plan.frames - 1})


def _gains(plan: RecordingPlan, brightness: Sequence[float]) -> list[float]:
    every = np.interp(np.arange(plan.frames), _metered(plan), brightness)
    return [float(g) for g in auto_exposure(every, 1 / plan.rate_hz, ColorSensor())]


def _run_here(plan: RecordingPlan, folder: Path, workers: int, progress: Progress) -> list[float]:
    worker = FrameWorker(plan, folder)
    gains = _gains(plan, [worker.brightness(frame) for frame in _metered(plan)])
    coverage = []
    for frame, gain in enumerate(gains):
        coverage.append(worker.write(frame, gain))
        progress(frame + 1, plan.frames)
    worker.write_lists(gains)
    return coverage


def _run_in_processes(
    plan: RecordingPlan, folder: Path, workers: int, progress: Progress
) -> list[float]:
    context = multiprocessing.get_context('spawn')
    pool = ProcessPoolExecutor(workers, context, initializer=_start, initargs=(plan, folder))
    try:
        gains = _gains(plan, list(pool.map(_brightness, _metered(plan), chunksize=4)))
        coverage = []
        for done in pool.map(_write, range(plan.frames), gains):
            coverage.append(done)
            progress(len(coverage), plan.frames)
        pool.submit(_write_lists_there, gains).result()
    finally:
        pool.shutdown(wait=True, cancel_futures=True)
    return coverage


def _check_target(folder: Path, force: bool) -> None:
    if folder.exists() and not folder.is_dir():
        raise DatasetError(f"'{folder}' is a file; name a folder that is new or empty")
    if not folder.is_dir() or not any(folder.iterdir()):
        return
    if not force:
        raise DatasetError(f"'{folder}' is not empty; choose another folder or use --force")
    if not SynthTruth.available(folder):
        raise DatasetError(
            f"'{folder}' is not empty and not a synthetic recording, so it is not replaced; "
            'choose another folder or empty it yourself'
        )


@contextmanager
def _set_aside(folder: Path) -> Iterator[Path]:
    """Yield a folder beside the target that takes its place at the end, or leaves no trace."""
    folder = folder.absolute()
    folder.parent.mkdir(parents=True, exist_ok=True)
    partial = folder.with_name(f'.{folder.name}.partial-{os.getpid()}')
    partial.mkdir()
    try:
        yield partial
        _replace(folder, partial)
    finally:
        shutil.rmtree(partial, ignore_errors=True)


def _replace(folder: Path, partial: Path) -> None:
    if not folder.exists():
        partial.rename(folder)
        return
    old = folder.with_name(f'.{folder.name}.old-{os.getpid()}')
    folder.rename(old)
    partial.rename(folder)
    shutil.rmtree(old)
