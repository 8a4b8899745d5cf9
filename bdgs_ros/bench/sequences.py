"""The recordings that benches run: real ones by folder, synthetic ones made on demand."""

from __future__ import annotations

import sys
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.core.errors import DatasetError, ModelError

SYNTH_FRAMES = 300
SYNTH_FRAMES_QUICK = 60
SYNTH_LENGTHS = {'loop_room': 450, 'low_rate': 75}  # frames: until it is back; 15 s
REAL_FRAMES_QUICK = 60
WEIGHTS = Path('models') / 'yolov5n-320.onnx'
_SYNTH = 'synth_'


@dataclass(frozen=True)
class SynthCamera:
    """Size and rate of a synthetic recording."""

    width: int = 640
    height: int = 480
    rate_hz: int = 30

    @property
    def suffix(self) -> str:
        """What names say of it: nothing where it is the usual one."""
        return '' if self == SynthCamera() else f'_{self.width}x{self.height}_{self.rate_hz}hz'


@dataclass(frozen=True)
class RealSequence:
    """A recording under `data/` of the data folder."""

    name: str
    folder: str
    source: str


REAL = (
    RealSequence(
        'bonn_crowd_part', 'rgbd_bonn_crowd_part', 'BONN RGB-D Dynamic, crowd, first 520 frames'
    ),
    RealSequence(
        'fr1_rpy_part', 'rgbd_dataset_freiburg1_rpy_part', 'TUM fr1/rpy, first 240 frames'
    ),
)


def real_path(name: str, data: Path) -> Path:
    """
    Return the folder of a real recording.

    Raises
    ------
    DatasetError
        If the folder is not there.

    """
    folder = {sequence.name: sequence.folder for sequence in REAL}[name]
    path = data / 'data' / folder
    if not path.is_dir():
        raise DatasetError(
            f"recording '{name}' was expected at '{path}'; say where the recordings are with "
            '--data or BDGS_SHARED'
        )
    return path


def synth_path(
    scenario: str, seed: int, frames: int, work: Path, camera: SynthCamera | None = None
) -> Path:
    """Return the folder of a synthetic recording, made now if it is not there yet."""
    camera = camera or SynthCamera()
    path = work / 'synth' / f'{scenario}_{seed}_{frames}{camera.suffix}'
    if not path.is_dir():
        _record(path, scenario, seed, frames, camera)
    return path


def _record(path: Path, scenario: str, seed: int, frames: int, camera: SynthCamera) -> None:
    from tqdm import tqdm

    from bdgs_ros.data.synth import write_recording

    with tqdm(total=frames, desc=path.name, unit='frame', file=sys.stderr, leave=False) as bar:
        write_recording(
            path,
            scenario,
            seed,
            frames,
            size=(camera.width, camera.height),
            rate_hz=None if camera == SynthCamera() else camera.rate_hz,
            progress=lambda done, total: bar.update(done - bar.n),
        )


def real_settings(options: Options) -> dict[str, Any]:
    """Return what a cell on a real recording is known by."""
    return {'kind': 'real', 'frames': REAL_FRAMES_QUICK if options.quick else None}


def synth_settings(scenario: str, options: Options) -> dict[str, Any]:
    """Return what a cell on a synthetic recording is known by."""
    frames = SYNTH_LENGTHS.get(scenario, SYNTH_FRAMES)
    return {'kind': 'synth', 'frames': SYNTH_FRAMES_QUICK if options.quick else frames}


def cell_recording(cell: Cell, options: Options) -> Path:
    """Return the recording of a cell; its sequence is `synth_SCENARIO` or a real one's name."""
    if cell.settings['kind'] == 'real':
        return real_path(cell.sequence, options.data)
    camera = SynthCamera(*cell.settings.get('camera', ()))
    scenario = cell.sequence.removeprefix(_SYNTH).removesuffix(camera.suffix)
    return synth_path(scenario, cell.seed, cell.settings['frames'], options.work.parent, camera)


def prepare(cell: Cell, options: Options) -> None:
    """Make the recording of a cell if it is not there yet."""
    cell_recording(cell, options)


def synth_name(scenario: str) -> str:
    """Return the sequence name of a scenario."""
    return f'{_SYNTH}{scenario}'


def frame_limit(cell: Cell) -> int | None:
    """Return how many frames of the recording the cell uses; None for all."""
    limit: int | None = cell.settings['frames'] if cell.settings['kind'] == 'real' else None
    return limit


def weights_path(options: Options) -> Path:
    """Return where the detector's weights are looked for."""
    return options.weights or options.data / WEIGHTS


def detector_settings(configuration: str, options: Options) -> Mapping[str, Any]:
    """Return the parameters of a cell and the name of its weights file."""
    weights = weights_path(options).name if configuration == 'weights' else ''
    return {'values': dict(options.values), 'weights': weights}


def cell_config(cell: Cell, options: Options) -> BdgsConfig:
    """
    Return the configuration of a cell: `weights` has the detector, any other has not.

    Raises
    ------
    ModelError
        If there are no weights.

    """
    return config_of(options.values, cell.configuration == 'weights', options)


def config_of(values: Mapping[str, Any], with_weights: bool, options: Options) -> BdgsConfig:
    """
    Return a configuration that differs from the default by some values, with a detector or not.

    Raises
    ------
    ModelError
        If there are no weights.

    """
    values = dict(values)
    if with_weights:
        path = weights_path(options)
        if not path.is_file():
            raise ModelError(f"no weights at '{path}'; give them with --weights")
        values['detection.weights'] = str(path)
    return with_values(BdgsConfig(), values)
