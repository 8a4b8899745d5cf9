"""Services whose failure is an answer, not a crash."""

from __future__ import annotations

import threading
from collections.abc import Callable
from typing import Any

from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from bdgs_ros.core.errors import BdgsError

_SPIN_S = 0.1
_GRACE_S = 2.0


def serve_trigger(
    node: Node, name: str, action: Callable[[], str], speaker: Node | None = None
) -> None:
    """
    Offer a Trigger; `action` returns what was done, and its errors become the answer.

    `speaker` is the node that logs it; by default the one that serves.
    """
    node.create_service(
        Trigger, name, lambda _, response: _answer(speaker or node, name, response, action)
    )


def serve_switch(
    node: Node, name: str, action: Callable[[bool], str], speaker: Node | None = None
) -> None:
    """Offer a SetBool, like `serve_trigger`."""
    node.create_service(
        SetBool,
        name,
        lambda request, response: _answer(
            speaker or node, name, response, lambda: action(request.data)
        ),
    )


class SideNode:
    """
    A hidden node with a thread of its own, for services that wait while images must be taken.

    Parameters
    ----------
    node : Node
        Whose services they are; names are resolved as it resolves them.

    """

    def __init__(self, node: Node) -> None:
        self._owner = node
        self._node = Node(
            f'_{node.get_name()}_services',
            context=node.context,
            namespace=node.get_namespace(),
            use_global_arguments=False,  # they name this process's main node
            enable_rosout=False,
            start_parameter_services=False,
        )
        self._stopping = threading.Event()
        self._thread = threading.Thread(target=self._spin, daemon=True)

    def serve_trigger(self, name: str, action: Callable[[], str]) -> None:
        """Offer a Trigger that may take its time."""
        serve_trigger(self._node, self._resolved(name), action, self._owner)

    def serve_switch(self, name: str, action: Callable[[bool], str]) -> None:
        """Offer a SetBool that may take its time."""
        serve_switch(self._node, self._resolved(name), action, self._owner)

    def _resolved(self, name: str) -> str:
        return str(self._owner.resolve_service_name(name))

    def start(self) -> None:
        """Begin to answer."""
        self._thread.start()

    def stop(self) -> None:
        """End the thread."""
        self._stopping.set()
        if self._thread.is_alive():
            self._thread.join(_GRACE_S)

    def _spin(self) -> None:
        executor = SingleThreadedExecutor(context=self._node.context)
        executor.add_node(self._node)
        while not self._stopping.is_set() and self._node.context.ok():
            executor.spin_once(timeout_sec=_SPIN_S)


def _answer(node: Node, name: str, response: Any, action: Callable[[], str]) -> Any:
    try:
        response.message = action()
        response.success = True
        node.get_logger().info(f'{name}: {response.message}')
    except (BdgsError, OSError) as error:
        response.message = str(error)
        response.success = False
        node.get_logger().error(f'{name}: {error}')
    except Exception as error:  # nobody shall wait in vain, or find nobody the next time
        response.message = f'{type(error).__name__}: {error}'
        response.success = False
        node.get_logger().error(f'{name}: please report: {response.message}')
    return response
