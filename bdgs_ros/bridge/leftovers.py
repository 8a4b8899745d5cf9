"""
Remove what dead processes have left in shared memory; ROS-free.

Fast DDS never takes away the segments (64 MiB each) and ports of a process that was killed. Its
tool `fastdds shm clean` does, but is not in the wheels. As there, whoever is alive holds a lock on
the file `_el` or `_sl` beside its own.
"""

from __future__ import annotations

import contextlib
import fcntl
import os
import re
import time
from pathlib import Path

SHM = Path('/dev/shm')
_OURS = re.compile(r'fastrtps_([0-9a-f]{16}|port\d+)')
_LOCKS = ('_el', '_sl')
_YOUNG_S = 10.0  # it may be about to be locked


def remove_leftovers(folder: Path = SHM) -> int:
    """Remove the files of dead processes of this user; return how many bytes they had."""
    removed = 0
    for path in sorted(folder.glob('fastrtps_*')):
        if _OURS.fullmatch(path.name):
            with contextlib.suppress(OSError):  # another node may do the same just now
                removed += _remove_if_left(path)
    return removed


def _remove_if_left(path: Path) -> int:
    status = path.stat()
    locks = [path.with_name(path.name + suffix) for suffix in _LOCKS]
    is_young = time.time() - status.st_mtime < _YOUNG_S
    if is_young or status.st_uid != os.getuid() or any(map(_is_held, locks)):
        return 0
    for file in (path, *locks, path.with_name(f'sem.{path.name}_mutex')):
        file.unlink(missing_ok=True)
    return status.st_size


def _is_held(lock: Path) -> bool:
    """Return whether a living process has locked a file."""
    try:
        descriptor = os.open(lock, os.O_RDWR)
    except FileNotFoundError:
        return False
    except OSError:
        return True
    try:
        fcntl.flock(descriptor, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return True
    finally:
        os.close(descriptor)
    return False
