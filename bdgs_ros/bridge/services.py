"""Services whose failure is an answer, not a crash."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

from rclpy.callback_groups import CallbackGroup
from rclpy.node import Node
from std_srvs.srv import SetBool, Trigger

from bdgs_ros.core.errors import BdgsError


def serve_trigger(
    node: Node, name: str, action: Callable[[], str], group: CallbackGroup | None = None
) -> None:
    """Offer a Trigger; `action` returns what was done, and its errors become the answer."""
    node.create_service(
        Trigger,
        name,
        lambda _, response: _answer(node, name, response, action),
        callback_group=group,
    )


def serve_switch(
    node: Node, name: str, action: Callable[[bool], str], group: CallbackGroup | None = None
) -> None:
    """Offer a SetBool, like `serve_trigger`."""
    node.create_service(
        SetBool,
        name,
        lambda request, response: _answer(node, name, response, lambda: action(request.data)),
        callback_group=group,
    )


def _answer(node: Node, name: str, response: Any, action: Callable[[], str]) -> Any:
    try:
        response.message = action()
        response.success = True
        node.get_logger().info(f'{name}: {response.message}')
    except (BdgsError, OSError) as error:
        response.message = str(error)
        response.success = False
        node.get_logger().error(f'{name}: {error}')
    return response
