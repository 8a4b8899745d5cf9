"""Which thread goes first where there are more of them than processors; ROS-free."""

from __future__ import annotations

import contextlib
import logging
import os
import signal
import sys
import threading
from pathlib import Path

from bdgs_ros.core.errors import ConfigError

_log = logging.getLogger(__name__)

_LONGEST_RUN_US = 1_000_000
"""A real-time thread that computes for so long without sleeping is one no longer."""


def give_way(nice: int) -> None:
    """
    Lower the priority of the calling thread, and of those that it starts from now on.

    Only Linux has priorities of threads; elsewhere they are of whole processes, and nothing is
    done.
    """
    if nice and sys.platform.startswith('linux'):
        with contextlib.suppress(OSError):  # a wish, not a need
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)


def go_first(priority: int) -> str:
    """
    Let all threads of this process run before any that has no real-time priority.

    Where a thread does not sleep for a second, the kernel says so (`RLIMIT_RTTIME`), and the
    process has ordinary priorities from then on: it can never take a processor for good.

    Parameters
    ----------
    priority : int
        Of `SCHED_RR`, 1 to 99; 0 does nothing.

    Returns
    -------
    note : str
        What was granted, for the log; empty for priority 0.

    """
    if not priority:
        return ''
    if not _is_safe():
        return 'real-time scheduling: not on this system; ordinary priorities'
    try:
        _bound_run_time()
        _schedule(os.SCHED_RR, priority)
    except (OSError, ValueError) as error:
        _schedule(os.SCHED_OTHER, 0)
        return (
            f'real-time scheduling was not granted ({error}); ordinary priorities. '
            'docs/realtime.md says what to allow'
        )
    return f'real-time scheduling: SCHED_RR, priority {priority}'


def may_go_first(priority: int) -> bool:
    """Return whether the system would grant a real-time priority; nothing stays changed."""
    if not (priority and _is_safe()):
        return False
    try:
        os.sched_setscheduler(0, os.SCHED_RR, os.sched_param(priority))
    except OSError:
        return False
    os.sched_setscheduler(0, os.SCHED_OTHER, os.sched_param(0))
    return True


def _is_safe() -> bool:
    """Return whether a real-time thread can be bounded and leaves a processor to others."""
    return sys.platform.startswith('linux') and processors() > 1


def _bound_run_time() -> None:
    import resource  # Unix has it

    _, hard = resource.getrlimit(resource.RLIMIT_RTTIME)
    soft = _LONGEST_RUN_US if hard == resource.RLIM_INFINITY else min(_LONGEST_RUN_US, hard)
    resource.setrlimit(resource.RLIMIT_RTTIME, (soft, hard))
    signal.signal(signal.SIGXCPU, _be_ordinary)


def _be_ordinary(*_: object) -> None:
    _schedule(os.SCHED_OTHER, 0)
    _log.warning(
        'a thread with real-time priority computed for %.1f s without sleeping: all threads of '
        'this process have ordinary priorities from now on',
        _LONGEST_RUN_US * 1e-6,
    )


def _schedule(policy: int, priority: int) -> None:
    """Schedule all threads of this process in one way; those they start follow them."""
    for task in Path('/proc/self/task').iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has ended
            os.sched_setscheduler(int(task.name), policy, os.sched_param(priority))


def keep_to(cpus: str) -> None:
    """
    Keep all threads of this process, and those to come, to some processors (Linux).

    Parameters
    ----------
    cpus : str
        Their numbers, such as '2,3'; empty: any.

    Raises
    ------
    ConfigError
        If these are no processors that this process may use.

    """
    if not cpus or not sys.platform.startswith('linux'):
        return
    allowed = os.sched_getaffinity(0)
    numbers = {int(word) for word in cpus.split(',') if word.strip().isdigit()}
    if len(numbers) != cpus.count(',') + 1 or not numbers <= allowed:
        raise ConfigError(
            f"expected numbers of processors out of {sorted(allowed)}, such as '0,1', "
            f"received '{cpus}'"
        )
    for task in Path('/proc/self/task').iterdir():
        with contextlib.suppress(ProcessLookupError):  # it has ended
            os.sched_setaffinity(int(task.name), numbers)


def leave_one(threads: int) -> int:
    """Return how many of the threads run at once if one processor is left to others."""
    return max(1, min(threads, processors() - 1))


def processors() -> int:
    """Return how many processors this process may use."""
    affinity = getattr(os, 'sched_getaffinity', None)  # Linux
    return len(affinity(0)) if affinity else os.cpu_count() or 1
