"""Which thread goes first where there are more of them than processors; ROS-free."""

from __future__ import annotations

import contextlib
import os
import sys
import threading


def give_way(nice: int) -> None:
    """
    Lower the priority of the calling thread, and of those that it starts from now on.

    Only Linux has priorities of threads; elsewhere they are of whole processes, and nothing is
    done.
    """
    if nice and sys.platform.startswith('linux'):
        with contextlib.suppress(OSError):  # a wish, not a need
            os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), nice)


def leave_one(threads: int) -> int:
    """Return how many of the threads run at once if one processor is left to others."""
    affinity = getattr(os, 'sched_getaffinity', None)  # what this process may use; Linux
    processors = len(affinity(0)) if affinity else os.cpu_count() or 1
    return max(1, min(threads, processors - 1))
