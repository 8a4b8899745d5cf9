"""Where the parts of a journal are, and whose it is."""

from __future__ import annotations

import fcntl
import os
import shutil
import time
from pathlib import Path
from typing import BinaryIO

from bdgs_ros.core.errors import JournalError

_PATIENCE_S, _POLL_S = 20.0, 0.1
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
        with _used_file(self.folder).open('ab') as used:
            _wait_for(used, self.folder)
            if not keep:
                self._empty()

    def _empty(self) -> None:
        poses_file(self.folder).unlink(missing_ok=True)
        shutil.rmtree(map_folder(self.folder), ignore_errors=True)

    def remove(self) -> None:
        """Remove the folder with all that is in it: the run is over, and its results are saved."""
        shutil.rmtree(self.folder, ignore_errors=True)
        self._lock.close()


def use(folder: Path) -> BinaryIO:
    """Say that this process writes into a journal, as long as the file that it gets is open."""
    folder.mkdir(parents=True, exist_ok=True)
    used = _used_file(folder).open('ab')
    fcntl.flock(used, fcntl.LOCK_SH)
    return used


def _used_file(folder: Path) -> Path:
    return folder / 'used'


def _wait_for(used: BinaryIO, folder: Path) -> None:
    """Wait for nodes that have outlived their slam_node and still save what they have."""
    deadline = time.monotonic() + _PATIENCE_S
    while not _is_locked_now(used):
        if time.monotonic() > deadline:
            raise JournalError(
                f"nodes of an earlier graph still write into '{folder}': end them first"
            )
        time.sleep(_POLL_S)


def _is_locked_now(file: BinaryIO) -> bool:
    """Take a lock that nobody else has; return whether that went well."""
    try:
        fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


def _first_free(folders: list[Path]) -> tuple[Path, BinaryIO]:
    why = ''
    for folder in folders:
        try:
            folder.mkdir(parents=True, exist_ok=True)
            lock = (folder / 'lock').open('ab')
        except OSError as error:
            why = f"journal folder '{folder}' cannot be made: {error.strerror}"
            continue
        if _is_locked_now(lock):
            return folder, lock
        lock.close()
        why = f"journal folder '{folder}' is in use by another graph"
    raise JournalError(f"{why}; name another with 'output' or 'journal.folder'")
