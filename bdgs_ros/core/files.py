"""Write files and folders so that a crash or a full disk leaves the old ones intact."""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path


def write_aside(path: Path, write: Callable[[Path], None]) -> None:
    """
    Let `write` fill a temporary file beside `path`, then rename it.

    The temporary keeps the suffix, because writers of pictures choose their format by it.

    Raises
    ------
    OSError
        If the file cannot be written; the old one is untouched.

    """
    path.parent.mkdir(parents=True, exist_ok=True)
    aside = path.with_name(f'.{path.stem}.part{path.suffix}')
    try:
        write(aside)
        flush(aside)
        aside.replace(path)
        flush(path.parent)
    finally:
        aside.unlink(missing_ok=True)


def write_bytes(path: Path, *parts: bytes) -> None:
    """Write the parts one after the other aside, then rename the file."""

    def write(aside: Path) -> None:
        with aside.open('wb') as file:
            file.writelines(parts)

    write_aside(path, write)


def write_text(path: Path, text: str) -> None:
    """Write a text file aside, then rename it."""
    write_bytes(path, text.encode('utf-8'))


def write_folder_aside(
    folder: Path, fill: Callable[[Path], None], then: Callable[[], None] = lambda: None
) -> None:
    """
    Let `fill` write into a new folder beside `folder`, swap the two, and do `then`.

    A folder cannot be renamed over one that is not empty, so the old one steps aside first. It
    comes back if `then` fails, and is removed if it does not; should the machine stop in
    between, it is still there as `previous_folder(folder)`.

    Raises
    ------
    OSError
        If the folder cannot be written; the old one is untouched.

    """
    folder.parent.mkdir(parents=True, exist_ok=True)
    aside, previous = folder.with_name(f'.{folder.name}.part'), previous_folder(folder)
    try:
        remove_folder(aside)
        aside.mkdir()
        fill(aside)
        for path in (aside, *aside.rglob('*')):
            flush(path)
        _swap(aside, folder, previous, then)
    finally:
        remove_folder(aside)
    remove_folder(previous)


def previous_folder(folder: Path) -> Path:
    """Return where `write_folder_aside` keeps the old folder while it swaps."""
    return folder.with_name(f'.{folder.name}.old')


def remove_folder(folder: Path) -> None:
    """Remove a folder with all that is in it, if it is there."""
    if folder.exists():
        shutil.rmtree(folder)


def _swap(new: Path, folder: Path, previous: Path, then: Callable[[], None]) -> None:
    if folder.exists():
        remove_folder(previous)
        folder.rename(previous)
    try:
        new.rename(folder)
        then()
    except BaseException:
        remove_folder(folder)
        if previous.exists():
            previous.rename(folder)
        raise


def flush(path: Path) -> None:
    """Bring a file's content, or the names in a folder, to the disk, for when the power fails."""
    descriptor = os.open(path, os.O_RDONLY if path.is_dir() else os.O_RDWR)
    try:
        os.fsync(descriptor)
    finally:
        os.close(descriptor)
