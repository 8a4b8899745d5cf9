"""Start and stop a node's process."""

from __future__ import annotations

import ctypes
import faulthandler
import gc
import os
import signal
import sys
from collections.abc import Callable

import rclpy
from rclpy.executors import Executor, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node
from rclpy.signals import SignalHandlerOptions

from bdgs_ros.bridge import transport
from bdgs_ros.bridge.priority import give_way, go_first
from bdgs_ros.core.errors import BdgsError

PARENT_VARIABLE = 'BDGS_PARENT_PID'
STACKS_SIGNAL = signal.SIGUSR1
"""A node that gets it writes to its standard error where all its threads are."""
_PR_SET_PDEATHSIG = 1
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

    def finish(self, exit_code: int = 0) -> None:
        """End the process from any thread, when the current callback is over."""
        self.exit_code = exit_code
        self.finished = True
        if self.executor is not None:
            self.executor.wake()

    def close(self) -> None:
        """Stop threads and child processes."""


def run(
    factory: Callable[[], GraphNode],
    args: list[str] | None = None,
) -> int:
    """
    Run a node until it finishes or is interrupted.

    Parameters
    ----------
    factory : callable
        Makes the node, after `rclpy.init`.
    args : list of str, optional
        Command line; that of the process by default.

    Returns
    -------
    exit_code : int
        0 after SIGINT or SIGTERM too; 2 when the node refused its parameters or inputs.

    """
    follow_parent()
    stop = _catch_signals()
    faulthandler.register(STACKS_SIGNAL)
    transport.configure()
    rclpy.init(
        args=args if args is not None else sys.argv,
        signal_handler_options=SignalHandlerOptions.NO,
    )
    node: GraphNode | None = None
    try:
        node = factory()
        _settle_garbage()
        give_way(node.nice)
        note = go_first(node.realtime_priority)
        if note:
            node.get_logger().info(note)
        executor = make_executor()
        executor.add_node(node)
        while not (node.finished or stop):
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
    Return a list that SIGINT and SIGTERM are added to, instead of rclpy's own handlers.

    Those shut the context down under the feet of callbacks and threads that still publish. A
    second signal, when launch and the terminal both send one, changes nothing: nor may it wait
    for a lock that the handler of the first one holds, as that of an Event would.
    """
    received: list[int] = []
    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, lambda number, _: received.append(number))
    return received


def follow_parent() -> None:
    """When slam_node started this process, end with it, however it ends (Linux)."""
    parent = os.environ.get(PARENT_VARIABLE)
    if not parent or not sys.platform.startswith('linux'):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):  # it died before the call above
        raise SystemExit(1)
