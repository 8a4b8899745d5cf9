"""What slam_node does where a service's answer is lost on its way."""

from __future__ import annotations

from concurrent.futures import Future
from unittest.mock import Mock

import pytest
from std_srvs.srv import Trigger

from bdgs_ros.core.errors import BdgsError
from bdgs_ros.nodes import slam_node


class Client:
    """Of a service whose first answers get lost."""

    def __init__(self, lost: int, success: bool = True) -> None:
        self.asked, self._lost = 0, lost
        self._answer = Trigger.Response(success=success, message='the disk is full')

    def wait_for_service(self, timeout_s: float) -> bool:
        return True

    def call_async(self, _: Trigger.Request) -> Future[Trigger.Response]:
        future: Future[Trigger.Response] = Future()
        self.asked += 1
        if self.asked > self._lost:
            future.set_result(self._answer)
        return future


def save(client: Client) -> Mock:
    node = Mock(_savers={'save': client})
    slam_node.SlamNode._call(node, 'save')
    return node


@pytest.fixture(autouse=True)
def _soon(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(slam_node, '_SERVICE_TIMEOUT_S', 0.3)


@pytest.mark.parametrize('lost', [0, 2])
def test_an_answer_that_was_lost_is_asked_for_again(lost: int) -> None:
    client = Client(lost)
    save(client)
    assert client.asked == lost + 1


def test_silence_ends_with_the_stacks_of_all_nodes() -> None:
    node = Mock(_savers={'save': Client(lost=100)})
    with pytest.raises(BdgsError, match=r"'save' did not answer within 0\.3 s"):
        slam_node.SlamNode._call(node, 'save')
    node._children.show_stacks.assert_called_once()


def test_a_refusal_is_told() -> None:
    with pytest.raises(BdgsError, match='the disk is full'):
        save(Client(lost=0, success=False))
