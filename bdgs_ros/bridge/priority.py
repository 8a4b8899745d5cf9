"""Which thread goes first where there are more of them than cores; ROS-free."""

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
