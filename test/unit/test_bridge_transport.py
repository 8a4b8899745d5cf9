"""The shared-memory profile for Fast DDS."""

from __future__ import annotations

import os
from pathlib import Path
from xml.etree import ElementTree

import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = pytest.mark.ros

from bdgs_ros.bridge import processes, transport  # noqa: E402


@pytest.fixture(autouse=True)
def clean(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in (*transport.PROFILES_VARIABLES, 'RMW_IMPLEMENTATION'):
        monkeypatch.setenv(name, '')
        monkeypatch.delenv(name)
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))


def test_writes_a_profile_with_a_large_segment(tmp_path: Path) -> None:
    note = transport.configure(shm=tmp_path)
    path = Path(os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'])
    assert path.parent == tmp_path / 'bdgs_ros'
    sizes = [e.text for e in ElementTree.parse(path).iter() if e.tag.endswith('segment_size')]
    assert sizes == [str(64 * 1024 * 1024)]
    assert '64 MiB' in note


def test_the_users_profile_wins(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', '/etc/mine.xml')
    transport.configure(shm=tmp_path)
    assert os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] == '/etc/mine.xml'


def test_another_middleware_is_left_alone(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_cyclonedds_cpp')
    transport.configure(shm=tmp_path)
    assert 'FASTRTPS_DEFAULT_PROFILES_FILE' not in os.environ


def test_without_shared_memory_the_default_stays(tmp_path: Path) -> None:
    assert 'too little room' in transport.configure(shm=tmp_path / 'absent')
    assert 'FASTRTPS_DEFAULT_PROFILES_FILE' not in os.environ


def test_forwarded_arguments_hold_for_all_nodes() -> None:
    given = [
        'slam_node', '--ros-args', '-r', '__node:=other', '-r', '__ns:=/robot', '-p', 'bag:=x',
        '--remap', 'a:=b', '--params-file', 'f.yaml', '--log-level', 'debug', '--', '-r', 'c:=d',
    ]  # fmt: skip
    assert processes.forwarded_arguments(given) == [
        '-r', '__ns:=/robot', '--remap', 'a:=b', '--log-level', 'debug',
    ]  # fmt: skip
