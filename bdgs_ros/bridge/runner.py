"""Start and stop a node's process."""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import os
import signal
import sys
import threading
import time
from collections.abc import Callable

import rclpy
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from bdgs_ros.bridge import transport
from bdgs_ros.bridge.leftovers import remove_leftovers
from bdgs_ros.bridge.priority import give_way, go_first
from bdgs_ros.core.errors import BdgsError

PARENT_VARIABLE = 'BDGS_PARENT_PID'
STACKS_SIGNAL = signal.SIGUSR1
"""A node that gets it writes to its standard error where all its threads are."""
END_SIGNAL = signal.SIGUSR2
"""By which slam_node ends its children: there is nothing to be saved any more."""
_PR_SET_PDEATHSIG = 1
_PATIENCE_S = 15.0  # with a parent that does not say what is to be done
_SPIN_S = 0.1
REFUSED = 2
"""Exit status when parameters or inputs were refused."""


class GraphNode(Node):
    """A node that can end its process."""

    def __init__(self, name: str, **kwargs: object) -> None:
        super().__init__(name, **kwargs)
        self.exit_code = 0
        self.finished = False
        self.nice = 0
        """How much its callbacks give way to other processes; workers have their own."""
        self.realtime_priority = 0
        """Of all threads of its process, see `priority.go_first`."""
        self._ending = False

    def finish(self, exit_code: int = 0) -> None:
        """End the process from any thread, when the current callback is over."""
        self.exit_code = exit_code
        self.finished = True
        if self.executor is not None:
            self.executor.wake()

    def results(self) -> list[Callable[[], str]]:
        """Return what saves the node's results, each saying what it saved; none by default."""
        return []

    def interrupt(self) -> None:
        """
        Save the results and end the process, at the second time without.

        Where slam_node, which started this process, lives, it is left to it to ask for them: who
        stops a service sends all of its processes a signal at once.
        """
        if self._ending:
            self.finish()
        else:
            self._ending = True
            threading.Thread(target=self._save_and_finish, daemon=True).start()

    def _save_and_finish(self) -> None:
        deadline = time.monotonic() + _PATIENCE_S
        while has_living_parent() and time.monotonic() < deadline:
            time.sleep(_SPIN_S)
        if not has_living_parent():
            for save in self.results():
                self._save(save)
        self.finish()

    def _save(self, save: Callable[[], str]) -> None:
        try:
            self.get_logger().info(f'saved at the end: {save()}')
        except (BdgsError, OSError) as error:
            self.get_logger().error(f'not saved: {error}')

    def close(self) -> None:
        """Stop threads and child processes."""


def run(
    factory: Callable[[], GraphNode],
    args: list[str] | None = None,
) -> int:
    """
    Run a node until it finishes; a signal has it save its results first, a second one has not.

    Parameters
    ----------
    factory : callable
        Makes the node, after `rclpy.init`.
    args : list of str, optional
        Command line; that of the process by default.

    Returns
    -------
    exit_code : int
        0 after SIGINT, SIGTERM or SIGHUP too; 2 when the node refused its parameters or inputs.

    """
    follow_parent()
    stop = _catch_signals()
    faulthandler.register(STACKS_SIGNAL)
    removed = remove_leftovers()
    transport.configure()
    rclpy.init(
        args=args if args is not None else sys.argv,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    node: GraphNode | None = None
    try:
        if removed:
            get_logger('bdgs_ros').info(
                f'removed {removed / 1e6:.0f} MB that killed processes had left in shared memory'
            )
        node = factory()
        _settle_garbage()
        give_way(node.nice)
        note = go_first(node.realtime_priority)
        if note:
            node.get_logger().info(note)
        executor = make_executor()
        executor.add_node(node)
        while not node.finished:
            if stop:
                node.finish() if stop.pop() == END_SIGNAL else node.interrupt()
            executor.spin_once(timeout_sec=_SPIN_S)
        return node.exit_code
    except BdgsError as error:
        get_logger('bdgs_ros').fatal(str(error))
        return REFUSED
    finally:
        if node is not None:
            node.close()
        rclpy.try_shutdown()


def make_executor() -> Executor:
    """
    Return the executor of a node whose callbacks never wait.

    The older ones build their list of what to wait for anew in Python for every message: 2 to 9 ms
    of every frame in each node, with the interpreter lock held. That of rclpy 7.1.5 and newer is
    told what has come.
    """
    try:
        from rclpy.experimental import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def _settle_garbage() -> None:
    """
    Take what was imported out of the garbage collector's rounds.

    A full round over it takes 36 ms, in which no frame is tracked.
    """
    gc.collect()
    gc.freeze()


def _catch_signals() -> list[int]:
    """
    Return a list that the signals to end are added to, instead of rclpy's own handlers.

    Those shut the context down under the feet of callbacks and threads that still publish. The
    handler may not wait for a lock that the one of an earlier signal holds, as an Event would.
    """
    received: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP, END_SIGNAL):
        signal.signal(number, lambda number, _: received.append(number))
    return received


def has_living_parent() -> bool:
    """Return whether slam_node started this process and still runs."""
    return os.environ.get(PARENT_VARIABLE) == str(os.getppid())


def follow_parent() -> None:
    """When slam_node started this process, end with it, however it ends (Linux)."""
    parent = os.environ.get(PARENT_VARIABLE)
    if not parent or not sys.platform.startswith('linux'):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if not has_living_parent():  # it died before the call above
        raise SystemExit(1)
