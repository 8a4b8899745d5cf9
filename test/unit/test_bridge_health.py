"""What a node says of itself: a problem warns, a failure is an error, and both can pass."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')

from diagnostic_msgs.msg import DiagnosticStatus
from rclpy.clock import Clock

from bdgs_ros.bridge.health import Health


class FakeNode:
    def __init__(self):
        self.sent, self.logged = [], []

    def create_publisher(self, *_):
        return SimpleNamespace(publish=lambda message: self.sent.append(message.status[0]))

    def create_timer(self, *_, **__):
        return None

    def get_logger(self):
        return SimpleNamespace(warning=self.logged.append)

    def get_fully_qualified_name(self):
        return '/mapping_node'

    def get_clock(self):
        return Clock()


def test_a_failure_is_an_error_until_it_passes():
    node = FakeNode()
    health = Health(node, 'mapping')
    for failure, problem, level in (
        ('', '', DiagnosticStatus.OK),
        ('', 'late', DiagnosticStatus.WARN),
        ('drift stays', 'late', DiagnosticStatus.ERROR),
        ('drift stays', '', DiagnosticStatus.ERROR),
        ('', 'late', DiagnosticStatus.WARN),
        ('', '', DiagnosticStatus.OK),
    ):
        health.set_failure('back_end', failure)
        health.set_problem('other', problem)
        health.publish()
        assert node.sent[-1].level == level
        said = [text for text in (problem, failure) if text]
        assert sorted(node.sent[-1].message.split('; ')) == sorted(said or ['ok'])
    assert 'drift stays' in node.logged
