"""A map and its keyframes as one thing on the disk: `NAME.ply` and `NAME_keyframes/`."""

from __future__ import annotations

from pathlib import Path

from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.errors import MapError
from bdgs_ros.core.files import previous_folder, remove_folder, write_folder_aside
from bdgs_ros.core.types import Keyframe
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.keyframe_store import (
    KeyframeSet,
    gaussians_of,
    read_keyframes,
    write_keyframes,
)
from bdgs_ros.mapping.keyframes import photograph
from bdgs_ros.mapping.ply import load_ply, save_ply, write_points


def keyframe_folder(path: Path) -> Path:
    """Return where the keyframes of the map in file `path` are."""
    return path.with_name(f'{path.stem}_keyframes')


def save_map(path: Path, gaussians: GaussianMap, kept: KeyframeSet | None = None) -> None:
    """
    Write a map and its keyframes, both or neither.

    Parameters
    ----------
    path : Path
        Of the .ply.
    gaussians : GaussianMap
        The map.
    kept : KeyframeSet, optional
        Without keyframes the folder of an older map of this name is removed: it would not fit.

    Raises
    ------
    MapError
        If something cannot be written; the old files are still there then.

    """
    folder = keyframe_folder(path)
    try:
        if kept is None or not kept.keyframes:
            save_ply(path, gaussians)
            remove_folder(folder)
            return

        def fill(aside: Path) -> None:
            write_keyframes(aside, kept, len(gaussians))
            write_points(aside / 'points.ply', gaussians)

        write_folder_aside(folder, fill, lambda: save_ply(path, gaussians))
    except OSError as error:
        raise MapError(
            f"keyframes not saved to '{folder}': {error}; the files of the last save are intact"
        ) from error


def load_map(
    path: Path, config: BeliefConfig, levels: int, degree: int | None = None
) -> tuple[GaussianMap, KeyframeSet]:
    """
    Read a map and, where there are any, its keyframes.

    Parameters
    ----------
    path : Path
        Of the .ply; a map of another program will do.
    config : BeliefConfig
        Of the filter.
    levels : int
        Of the pyramid of each keyframe.
    degree : int, optional
        Of view-dependent colour; None: that of the file.

    Returns
    -------
    gaussians : GaussianMap
        The map.
    kept : KeyframeSet
        Empty without a folder; `next_index` then follows those that the Gaussians came from.

    Raises
    ------
    MapError
        If a file is missing, damaged, or belongs to another map.

    """
    gaussians = load_ply(path, config, degree)
    newest = int(gaussians.keyframe_index.max()) if len(gaussians) else -1
    folder = _folder_of(path, len(gaussians))
    if folder is None:
        return gaussians, KeyframeSet(next_index=newest + 1)
    kept = read_keyframes(folder, levels)
    if newest >= kept.next_index:
        raise MapError(
            f"'{path}' has Gaussians of keyframe {newest}, but '{folder}' ends before keyframe "
            f'{kept.next_index}: they are of different runs; remove the folder to use the map '
            'alone'
        )
    return gaussians, kept


def load_places(path: Path) -> list[Keyframe]:
    """
    Read the keyframes of a saved map as places that may be recognised; none without a folder.

    Raises
    ------
    MapError
        As `load_map`.

    """
    _, kept = load_map(path, BeliefConfig(), 1)
    return [photograph(keyframe) for keyframe in kept.keyframes]


def _folder_of(path: Path, count: int) -> Path | None:
    """Return the folder that belongs to a map of `count` Gaussians."""
    folder = keyframe_folder(path)
    # After a crash between two renames of a save the older folder is the one that fits.
    found = [f for f in (folder, previous_folder(folder)) if f.is_dir()]
    sizes = [gaussians_of(f) for f in found]
    for candidate, size in zip(found, sizes, strict=True):
        if size in (None, count):
            return candidate
    if not found:
        return None
    raise MapError(
        f"'{path}' has {count} Gaussians, but '{found[0]}' belongs to a map of {sizes[0]}; remove "
        f"the folder to use the map alone or, if you edited the map, the entry 'gaussians' of its "
        'transforms.json'
    )
