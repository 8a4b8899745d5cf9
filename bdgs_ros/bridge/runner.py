"""Start and stop a node's process."""

from __future__ import annotations

import ctypes
import os
import signal
import sys
from collections.abc import Callable
from typing import Protocol

import rclpy
from rclpy.executors import Executor, ExternalShutdownException, SingleThreadedExecutor
from rclpy.logging import get_logger
from rclpy.node import Node

from bdgs_ros.bridge import transport
from bdgs_ros.core.errors import BdgsError

PARENT_VARIABLE = 'BDGS_PARENT_PID'
_PR_SET_PDEATHSIG = 1
REFUSED = 2
"""Exit status when parameters or inputs were refused."""


class Runnable(Protocol):
    """What `run` needs of a node beyond rclpy's own."""

    exit_code: int

    def close(self) -> None:
        """Stop threads and child processes."""


class GraphNode(Node):
    """A node that can end its process."""

    def __init__(self, name: str, **kwargs: object) -> None:
        super().__init__(name, **kwargs)
        self.exit_code = 0
        self.finished = False

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
    make_executor: Callable[[], Executor] = SingleThreadedExecutor,
) -> int:
    """
    Run a node until it finishes or is interrupted.

    Parameters
    ----------
    factory : callable
        Makes the node, after `rclpy.init`.
    args : list of str, optional
        Command line; that of the process by default.
    make_executor : callable
        Makes the executor.

    Returns
    -------
    exit_code : int
        0 after SIGINT or SIGTERM too; 2 when the node refused its parameters or inputs.

    """
    follow_parent()
    transport.configure()
    rclpy.init(args=args if args is not None else sys.argv)
    node: GraphNode | None = None
    try:
        node = factory()
        executor = make_executor()
        executor.add_node(node)
        while rclpy.ok() and not node.finished:
            executor.spin_once(timeout_sec=0.5)
        return node.exit_code
    except (KeyboardInterrupt, ExternalShutdownException):
        return 0
    except BdgsError as error:
        get_logger('bdgs_ros').fatal(str(error))
        return REFUSED
    finally:
        # launch and the terminal may both signal: a second one must not break the shutdown
        signal.signal(signal.SIGINT, signal.SIG_IGN)
        signal.signal(signal.SIGTERM, signal.SIG_IGN)
        if node is not None:
            node.close()
        rclpy.try_shutdown()


def follow_parent() -> None:
    """When slam_node started this process, end with it, however it ends (Linux)."""
    parent = os.environ.get(PARENT_VARIABLE)
    if not parent or not sys.platform.startswith('linux'):
        return
    ctypes.CDLL(None).prctl(_PR_SET_PDEATHSIG, signal.SIGTERM)
    if os.getppid() != int(parent):  # it died before the call above
        raise SystemExit(1)
