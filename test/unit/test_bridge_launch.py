"""The launch files, run against a stand-in for `launch`, which pip does not have."""

from __future__ import annotations

import runpy
import sys
from pathlib import Path
from types import ModuleType
from typing import Any
from unittest.mock import MagicMock

import pytest
import yaml

from bdgs_ros.bridge.node_config import known_names

ROOT = Path(__file__).resolve().parents[2]


class Recorder(ModuleType):
    """A module whose classes remember how they were called."""

    def __getattr__(self, name: str) -> Any:
        if name.startswith('__'):
            raise AttributeError(name)
        return lambda *args, **kwargs: MagicMock(kind=name, args=args, kwargs=kwargs)


@pytest.fixture
def described(monkeypatch: pytest.MonkeyPatch) -> Any:
    for name in (
        'launch', 'launch.actions', 'launch.conditions', 'launch.substitutions', 'launch_ros',
        'launch_ros.actions', 'launch_ros.parameter_descriptions', 'launch_ros.substitutions',
    ):  # fmt: skip
        monkeypatch.setitem(sys.modules, name, Recorder(name))
    monkeypatch.setattr(sys, 'path', list(sys.path))

    def describe(file: str) -> list[Any]:
        monkeypatch.delitem(sys.modules, '_args', raising=False)
        description = runpy.run_path(str(ROOT / 'launch' / file))['generate_launch_description']()
        return list(description.args[0])

    yield describe
    sys.modules.pop('_args', None)


@pytest.mark.parametrize(
    ('file', 'executables'),
    [
        ('bdgs.launch.py', {'detection_node', 'tracking_node', 'mapping_node', 'rviz2'}),
        (
            'replay.launch.py',
            {'detection_node', 'tracking_node', 'mapping_node', 'rviz2', 'replay_node'},
        ),
    ],
)
def test_launch_files(described: Any, file: str, executables: set[str]) -> None:
    actions = described(file)
    arguments = [a for a in actions if a.kind == 'DeclareLaunchArgument']
    nodes = [a for a in actions if a.kind == 'Node']
    assert all(a.kwargs['description'] for a in arguments)
    assert {n.kwargs['executable'] for n in nodes} == executables
    known = {*known_names(), 'use_sim_time'}
    ours = [n for n in nodes if n.kwargs['package'] == 'bdgs_ros']
    tunables = [n.kwargs['additional_env']['GLIBC_TUNABLES'].kwargs for n in ours]
    import bdgs_ros.nodes

    assert tunables == [{'default_value': bdgs_ros.nodes.MEMORY}] * len(ours)
    for node in nodes:
        for parameters in node.kwargs.get('parameters', []):
            if isinstance(parameters, dict):
                assert set(parameters) <= known


def test_every_argument_used_is_declared(described: Any) -> None:
    declared = {
        a.args[0] for a in described('replay.launch.py') if a.kind == 'DeclareLaunchArgument'
    }
    text = (ROOT / 'launch' / '_args.py').read_text()
    words = text.replace("_value('", "LaunchConfiguration('").split("LaunchConfiguration('")[1:]
    assert {word.split("'")[0] for word in words} <= declared


def test_rviz_shows_topics_of_the_graph() -> None:
    pytest.importorskip('rclpy', reason='needs rclpy')
    from bdgs_ros.bridge import topics

    config = yaml.safe_load((ROOT / 'rviz' / 'bdgs.rviz').read_text())
    shown = {
        display['Topic']['Value']
        for display in config['Visualization Manager']['Displays']
        if 'Topic' in display
    }
    known = {f'/{v}' for v in vars(topics).values() if isinstance(v, str)}
    assert shown <= known
