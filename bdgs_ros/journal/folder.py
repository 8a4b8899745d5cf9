"""Where the parts of a journal are, and whose it is."""

from __future__ import annotations

import fcntl
import os
import shutil
from pathlib import Path
from typing import BinaryIO

from bdgs_ros.core.errors import JournalError

_MOST = 16  # graphs at once whose journals are in the cache folder


def poses_file(folder: Path) -> Path:
    """Return the file of what tracking said, see `journal.poses`."""
    return folder / 'poses.rec'


def map_folder(folder: Path) -> Path:
    """Return the folder of the states of the map, see `journal.checkpoints`."""
    return folder / 'map'


def in_cache() -> list[Path]:
    """Return the folders that may be used where nobody names one."""
    base = Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache') / 'bdgs_ros'
    return [base / f'journal_{i}' for i in range(_MOST)]


class Claim:
    """
    A journal's folder that is ours as long as this lives.

    Parameters
    ----------
    folders : list of Path
        The first one that nobody else has is taken.
    keep : bool
        Leave what is in it; otherwise it is emptied.

    Raises
    ------
    JournalError
        If others have all of them, or none can be made.

    """

    def __init__(self, folders: list[Path], *, keep: bool) -> None:
        self.folder, self._lock = _first_free(folders)
        if not keep:
            self._empty()

    def _empty(self) -> None:
        poses_file(self.folder).unlink(missing_ok=True)
        shutil.rmtree(map_folder(self.folder), ignore_errors=True)

    def remove(self) -> None:
        """Remove the folder with all that is in it: the run is over, and its results are saved."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._lock.close()


def _first_free(folders: list[Path]) -> tuple[Path, BinaryIO]:
    why = ''
    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = (folder / 'lock').open('ab')
        except OSError as error:
            why = f"journal folder '{folder}' cannot be made: {error.strerror}"
            continue
        try:
            fcntl.flock(lock, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except OSError:
            lock.close()
            why = f"journal folder '{folder}' is in use by another graph"
            continue
        return folder, lock
    raise JournalError(f"{why}; name another with 'output' or 'journal.folder'")
