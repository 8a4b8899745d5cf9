"""Run several nodes in threads of this process: the other way to bring up the graph."""

from __future__ import annotations

import threading
from collections.abc import Callable, Mapping, Sequence

from rclpy.parameter import Parameter

from bdgs_ros.bridge.runner import GraphNode, make_executor

_SPIN_S = 0.1
_GRACE_S = 2.0


class InProcessNodes:
    """
    Nodes with a thread each.

    Parameters
    ----------
    ros_arguments : list of str
        Remaps and log levels that hold for all nodes.

    """

    def __init__(self, ros_arguments: Sequence[str]) -> None:
        self._arguments = ['--ros-args', *ros_arguments]
        self._nodes: list[GraphNode] = []
        self._threads: list[threading.Thread] = []
        self._stopping = False

    def start(self, kind: Callable[..., GraphNode], values: Mapping[str, object]) -> None:
        """Make a node and spin it."""
        node = kind(
            parameter_overrides=[Parameter(name, value=value) for name, value in values.items()],
            cli_args=self._arguments,
            use_global_arguments=False,  # they name this process's main node
        )
        self._nodes.append(node)
        thread = threading.Thread(target=self._spin, args=(node,), daemon=True)
        self._threads.append(thread)
        thread.start()

    def _spin(self, node: GraphNode) -> None:
        executor = make_executor()
        executor.add_node(node)
        while not self._stopping:
            executor.spin_once(timeout_sec=_SPIN_S)
        executor.shutdown(_GRACE_S)

    def stop(self) -> None:
        """End the nodes; their threads must be gone before rclpy is."""
        self._stopping = True
        for node in self._nodes:
            node.close()
        for thread in self._threads:
            thread.join(_GRACE_S)
