"""
The map on the disk while it grows: the newest state of it that is whole, and the one before.

Each state is two files of one number: `map-N.ply`, the Gaussians, and `map-N.rec`, what
`transforms.json` of a saved map says. Images of keyframes are written once, when they are new.
Nothing that an older state needs is touched before a newer one is on the disk.
"""

from __future__ import annotations

import json
import logging
import zlib
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from numpy.typing import NDArray

from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.core.errors import BdgsError, JournalError
from bdgs_ros.core.files import flush, remove_folder, write_bytes
from bdgs_ros.core.types import Keyframe
from bdgs_ros.journal.records import framed_file, read_records
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.keyframe_store import (
    KeyframeSet,
    document_of,
    images_of,
    keyframes_from,
    write_images,
)
from bdgs_ros.mapping.keyframes import photograph
from bdgs_ros.mapping.ply import load_ply, ply_content

_log = logging.getLogger(__name__)

_IMAGES = 'keyframes'


@dataclass(frozen=True)
class State:
    """What a map is at a moment: everything that changes is copied, images are shared."""

    rows: tuple[bytes, bytes]
    """Header and rows of the .ply."""
    document: Mapping[str, Any]
    images: Mapping[str, NDArray[Any]]
    """Those that are not on the disk yet, by their paths."""


class Checkpoints:
    """
    Writes states of a map into a folder.

    Parameters
    ----------
    folder : Path
        Made if it is not there; what is in it stays until the first state is written.
    kept : KeyframeSet, optional
        As it was read from there, to go on with.

    """

    def __init__(self, folder: Path, kept: KeyframeSet | None = None) -> None:
        self._folder = folder
        self._number = max((_number(path) for path in _states(folder)), default=0)
        begun = () if kept is None else kept.keyframes
        self._held = {keyframe.index: list(keyframe.depth_bend) for keyframe in begun}
        """Keyframes whose images are on the disk, and by what bend their depth was corrected."""

    def state(self, gaussians: GaussianMap, kept: KeyframeSet) -> State:
        """Return what is to be written; the map must not change meanwhile."""
        document = document_of(kept, len(gaussians))
        images: dict[str, NDArray[Any]] = {}
        for keyframe, frame in zip(kept.keyframes, document['frames'], strict=True):
            if keyframe.index in self._held:
                frame['depth_bend'] = self._held[keyframe.index]
            else:
                images |= images_of(keyframe)
        return State(ply_content(gaussians), document, images)

    def write(self, state: State) -> None:
        """
        Write a state, then remove those that are older than the last one.

        Raises
        ------
        OSError
            If it cannot be written; the state before is whole then.

        """
        images = self._folder / _IMAGES
        images.mkdir(parents=True, exist_ok=True)
        write_images(images, state.images)
        for name in state.images:
            flush(images / name)
        document = {**state.document, 'crc32': zlib.crc32(b''.join(state.rows))}
        self._number += 1
        rows = self._folder / f'map-{self._number:06d}.ply'
        write_bytes(rows, *state.rows)
        text = json.dumps(document).encode('utf-8')
        write_bytes(rows.with_suffix('.rec'), framed_file(text))
        before, self._held = (
            self._held,
            {frame['keyframe_index']: frame['depth_bend'] for frame in document['frames']},
        )
        self._remove_older({f'{index:06d}' for index in before.keys() | self._held.keys()})

    def _remove_older(self, needed: set[str]) -> None:
        """Leave this state and the one before it; `needed` are the images of both."""
        for path in [*_states(self._folder), *self._folder.glob('map-*.ply')]:
            if _number(path) < self._number - 1:
                path.unlink(missing_ok=True)
        for path in (self._folder / _IMAGES).glob('*/*.png'):
            if path.stem not in needed:
                path.unlink(missing_ok=True)

    def clear(self) -> None:
        """Remove all states: the map was forgotten."""
        self._held = {}
        for path in self._folder.glob('map-*'):
            path.unlink(missing_ok=True)
        remove_folder(self._folder / _IMAGES)


def read_newest(
    folder: Path, belief: BeliefConfig, mapping: MappingConfig
) -> tuple[GaussianMap, KeyframeSet] | None:
    """Return the newest state that is whole; None where there is none, and say what was not."""
    for path in sorted(_states(folder), key=_number, reverse=True):
        found = _read_if_whole(path, belief, mapping)
        if found is not None:
            return found
    return None


def read_places(folder: Path) -> list[Keyframe]:
    """Return the keyframes of the newest state as places that may be recognised."""
    found = read_newest(folder, BeliefConfig(), MappingConfig())
    return [] if found is None else [photograph(keyframe) for keyframe in found[1].keyframes]


def _read_if_whole(
    path: Path, belief: BeliefConfig, mapping: MappingConfig
) -> tuple[GaussianMap, KeyframeSet] | None:
    try:
        return _read(path, belief, mapping)
    except (BdgsError, OSError) as error:  # it may just be removed
        _log.warning('%s', error)
        return None


def _read(
    path: Path, belief: BeliefConfig, mapping: MappingConfig
) -> tuple[GaussianMap, KeyframeSet]:
    records = read_records(path)
    if len(records) != 1:
        raise JournalError(f"'{path}' is damaged: expected one record, found {len(records)}")
    document = json.loads(records[0])
    rows = path.with_suffix('.ply')
    gaussians = load_ply(rows, belief, mapping.color.degree)
    if zlib.crc32(rows.read_bytes()) != document['crc32']:
        raise JournalError(f"'{rows}' is damaged: its checksum is not that of '{path.name}'")
    return gaussians, keyframes_from(document, path.parent / _IMAGES, mapping.pyramid.levels)


def _states(folder: Path) -> list[Path]:
    return [path for path in folder.glob('map-*.rec') if path.stem[4:].isdigit()]


def _number(path: Path) -> int:
    """Return the number of a state by one of its files; 0 for others."""
    digits = path.stem[4:]
    return int(digits) if digits.isdigit() else 0
