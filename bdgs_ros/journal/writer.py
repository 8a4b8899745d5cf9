"""Bring records to the disk in a thread of its own: nobody waits for a slow or full one."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable
from pathlib import Path
from typing import BinaryIO

from bdgs_ros.core.errors import JournalError
from bdgs_ros.journal.records import framed, open_at_end

PERIOD_S = 0.5
"""What is older than this, and the time the disk takes, is on the disk."""
_MOST_WAITING = 1 << 24  # bytes that a full disk keeps waiting


class RecordWriter:
    """
    Appends to a file of records.

    Parameters
    ----------
    path : Path
        Of the file; it is made if it is not there.
    limit : int
        Bytes of the file; what would come after is left out, and said.
    on_problem : callable
        Called, in the thread, with what is wrong, and with an empty text when it is right again.
    keep : bool
        Go on after what is there; otherwise begin anew.

    """

    def __init__(
        self, path: Path, limit: int, on_problem: Callable[[str], None], *, keep: bool
    ) -> None:
        self._path = path
        self._limit = limit
        self._on_problem = on_problem
        self._lock = threading.Lock()  # of what waits
        self._waiting: list[bytes] = []
        self._is_new = not keep
        self._file: BinaryIO | None = None
        self._problem = ''
        self._is_over = False
        self._wake = threading.Event()
        self._thread = threading.Thread(target=self._run, name='journal', daemon=True)
        self._thread.start()

    def put(self, content: bytes) -> None:
        """Have a record written soon."""
        with self._lock:
            self._waiting.append(framed(content))

    def restart(self) -> None:
        """Forget everything: the next record is the first."""
        with self._lock:
            self._waiting = []
            self._is_new = True
        self._wake.set()  # what is of another world must not be there when this process dies

    def close(self) -> None:
        """Write what waits, and end."""
        self._is_over = True
        self._wake.set()
        self._thread.join()

    def _run(self) -> None:
        while not self._is_over:
            self._wake.wait(PERIOD_S)
            self._wake.clear()
            self._flush()
        self._flush()
        if self._file is not None:
            self._file.close()

    def _flush(self) -> None:
        with self._lock:
            taken, self._waiting = self._waiting, []
            is_new, self._is_new = self._is_new, False
        if not taken and not is_new:
            return
        try:
            problem = self._append(b''.join(taken), is_new)
        except (OSError, JournalError) as error:
            problem = f"journal '{self._path}' cannot be written: {_reason(error)}"
            self._put_back(taken, is_new)
        if problem != self._problem:
            self._problem = problem
            self._on_problem(problem)

    def _put_back(self, taken: list[bytes], is_new: bool) -> None:
        """Keep what could not be written, in order, as long as it is not too much."""
        with self._lock:
            if self._is_new:  # forgotten meanwhile
                return
            self._is_new = is_new
            self._waiting = taken + self._waiting
            while sum(map(len, self._waiting)) > _MOST_WAITING:
                del self._waiting[-max(1, len(self._waiting) // 8) :]

    def _append(self, records: bytes, is_new: bool) -> str:
        if is_new:
            if self._file is not None:
                self._file.close()
            self._file = None
            self._path.unlink(missing_ok=True)
        if self._file is None:
            self._file = open_at_end(self._path)
        end = self._file.tell()
        if end + len(records) > self._limit:
            return (
                f"journal '{self._path}' has reached {self._limit / 1e6:.0f} MB: poses from now "
                "on are kept in memory alone; raise 'journal.limit_mb'"
            )
        if records:
            try:
                _write_all(self._file, records)
                os.fsync(self._file.fileno())
            except OSError:
                self._file.truncate(end)
                self._file.seek(end)
                raise
        return ''


def _write_all(file: BinaryIO, data: bytes) -> None:
    view = memoryview(data)
    while view:
        view = view[file.write(view) :]


def _reason(error: Exception) -> str:
    return str(getattr(error, 'strerror', None) or error)
