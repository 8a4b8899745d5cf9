"""Write result files so that a crash or a full disk leaves the old one intact."""

from __future__ import annotations

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
        aside.replace(path)
    finally:
        aside.unlink(missing_ok=True)


def write_text(path: Path, text: str) -> None:
    """Write a text file aside, then rename it."""

    def write(aside: Path) -> None:
        aside.write_text(text, encoding='utf-8')

    write_aside(path, write)
