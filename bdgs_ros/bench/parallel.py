"""Processes of one thread each, which do not outlive the one that started them."""

from __future__ import annotations

import multiprocessing
import os
import signal
import threading
from collections.abc import Iterator
from concurrent.futures import ProcessPoolExecutor
from contextlib import contextmanager
from multiprocessing.connection import wait

from bdgs_ros.core.threads import one_thread_in_cv2

_ONE_THREAD = ('OMP_NUM_THREADS', 'OMP_THREAD_LIMIT', 'OPENBLAS_NUM_THREADS', 'MKL_NUM_THREADS')


@contextmanager
def pool(jobs: int) -> Iterator[ProcessPoolExecutor]:
    """
    Start `jobs` processes; however the block is left, none of them stays behind.

    Libraries read the number of threads when they are loaded, so it is in the environment of the
    new processes from the start.
    """
    context = multiprocessing.get_context('spawn')
    before = {name: os.environ.get(name) for name in _ONE_THREAD}
    os.environ.update(dict.fromkeys(_ONE_THREAD, '1'))
    workers = ProcessPoolExecutor(jobs, mp_context=context, initializer=_start)
    try:
        yield workers
    except BaseException:
        # What they compute is lost anyway, and waiting for it may take minutes.
        for process in (getattr(workers, '_processes', None) or {}).values():
            process.terminate()
        raise
    finally:
        workers.shutdown(wait=True, cancel_futures=True)
        _restore(before)


def _restore(environment: dict[str, str | None]) -> None:
    for name, value in environment.items():
        if value is None:
            os.environ.pop(name, None)
        else:
            os.environ[name] = value


def _start() -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the parent hears it and clears up
    one_thread_in_cv2()
    threading.Thread(target=_end_with_parent, daemon=True).start()


def _end_with_parent() -> None:
    """Leave when the parent is gone, also when it was killed."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        wait([parent.sentinel])
        os._exit(1)
