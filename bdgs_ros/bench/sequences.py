"""The recordings that benches run: real ones by folder, synthetic ones made on demand."""

from __future__ import annotations

import sys
from dataclasses import dataclass
from pathlib import Path

from bdgs_ros.core.errors import DatasetError

SYNTH_FRAMES = 300
SYNTH_FRAMES_QUICK = 60


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


def synth_path(scenario: str, seed: int, frames: int, work: Path) -> Path:
    """Return the folder of a synthetic recording, made now if it is not there yet."""
    path = work / 'synth' / f'{scenario}_{seed}_{frames}'
    if not path.is_dir():
        _record(path, scenario, seed, frames)
    return path


def _record(path: Path, scenario: str, seed: int, frames: int) -> None:
    from tqdm import tqdm

    from bdgs_ros.data.synth import write_recording

    with tqdm(total=frames, desc=path.name, unit='frame', file=sys.stderr, leave=False) as bar:
        write_recording(
            path, scenario, seed, frames, progress=lambda done, total: bar.update(done - bar.n)
        )
