"""The graph as four processes over DDS, and strangers that listen to it."""

from __future__ import annotations

import importlib.util
import json
import threading
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = [pytest.mark.ros, pytest.mark.slow]

from graph_processes import Graph  # noqa: E402
from rclpy.node import Node  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402

from bdgs_ros.bridge.conversions import T_MAP_WORLD  # noqa: E402
from bdgs_ros.core.types import Trajectory  # noqa: E402
from bdgs_ros.data.trajectory_io import read_trajectory  # noqa: E402

HAS_CYCLONE = importlib.util.find_spec('cyclonedds') is not None


def call(node: Node, kind: type, name: str, **fields: object) -> tuple[bool, str]:
    client = node.create_client(kind, name)
    assert client.wait_for_service(20.0), f'nobody offers {name}'
    done = threading.Event()
    future = client.call_async(kind.Request(**fields))
    future.add_done_callback(lambda _: done.set())
    assert done.wait(60.0), f'{name} did not answer'
    return future.result().success, future.result().message


def test_four_processes_and_strangers(
    graph: Graph,
    ros: Callable,
    bag: Path,
    offline: Trajectory,
    settings: dict[str, object],
    tmp_path: Path,
) -> None:
    plain = graph.script('plain_subscriber.py', str(len(offline)), '90', str(tmp_path / 'p.json'))
    other = None
    if HAS_CYCLONE:
        other = graph.script(
            'cyclone_subscriber.py', str(graph.domain), str(len(offline)), '90',
            str(tmp_path / 'c.json'),
        )  # fmt: skip
        other.wait_for('ready')
    names = ('detection_node', 'tracking_node', 'mapping_node')
    nodes = [graph.node(name, mode='lockstep', **settings) for name in names]
    for node in nodes:
        node.wait_for('is ready', 60.0)
    plain.wait_for('matched', 30.0)
    replay = graph.node('replay_node', bag=bag, mode='lockstep', wait_subscribers=3, paused=True)
    replay.wait_for('playing', 40.0)
    with ros() as me:
        assert call(me, Trigger, 'bdgs/replay/step') == (True, 'one frame')
        assert call(me, SetBool, 'bdgs/replay/pause', data=False) == (True, 'playing')
        assert replay.wait(90.0) == 0
        assert f'{len(offline)} ok' in replay.text()
        check_services(me, graph, tmp_path, len(offline))

    assert plain.wait(20.0) == 0
    check_stranger(json.loads((tmp_path / 'p.json').read_text()), offline)
    if other is not None:
        assert other.wait(20.0) == 0
        check_stranger(json.loads((tmp_path / 'c.json').read_text()), offline)
    assert [node.stop() for node in nodes] == [0, 0, 0]


def check_stranger(report: dict, offline: Trajectory) -> None:
    """Compare what a stranger received with the pipeline without ROS."""
    received = {pose[0]: np.array(pose[1:4]) for pose in report['poses']}
    assert sorted(received) == offline.stamps_ns.tolist()
    for pose in offline.poses:
        expected = (T_MAP_WORLD @ pose.T_world_camera)[:3, 3]
        assert received[pose.stamp_ns] == pytest.approx(expected, abs=1e-4)
    width, height, encoding, content = report['images'][0]
    assert (width, height, encoding) == (160, 120, 'rgb8')
    assert content > 0


def check_services(me: Node, graph: Graph, folder: Path, poses: int) -> None:
    """Save, fail to save, freeze and reset."""
    from rcl_interfaces.msg import Parameter, ParameterType, ParameterValue
    from rcl_interfaces.srv import SetParameters

    def set_text(node: str, name: str, text: str) -> None:
        client = me.create_client(SetParameters, f'{node}/set_parameters')
        assert client.wait_for_service(10.0)
        value = ParameterValue(type=ParameterType.PARAMETER_STRING, string_value=text)
        done = threading.Event()
        future = client.call_async(
            SetParameters.Request(parameters=[Parameter(name=name, value=value)])
        )
        future.add_done_callback(lambda _: done.set())
        assert done.wait(10.0)
        assert future.result().results[0].successful

    ok, message = call(me, Trigger, 'bdgs/save_map')
    assert not ok
    assert 'map_file' in message
    set_text('tracking_node', 'trajectory_file', str(folder / 't.txt'))
    set_text('mapping_node', 'map_file', str(folder / 'map.ply'))
    assert call(me, Trigger, 'bdgs/save_trajectory')[0]
    assert len(read_trajectory(folder / 't.txt')) == poses
    assert call(me, Trigger, 'bdgs/save_map')[0]
    saved = (folder / 'map.ply').read_bytes()
    (folder / 'file').write_text('not a folder')
    set_text('mapping_node', 'map_file', str(folder / 'file' / 'map.ply'))
    ok, message = call(me, Trigger, 'bdgs/save_map')
    assert not ok
    assert str(folder / 'file') in message
    assert (folder / 'map.ply').read_bytes() == saved
    set_text('mapping_node', 'map_file', str(folder / 'map.ply'))
    assert call(me, Trigger, 'bdgs/load_map')[0]
    assert call(me, SetBool, 'bdgs/set_localization_mode', data=True)[0]
    assert call(me, SetBool, 'bdgs/pause', data=True)[0]
    assert call(me, Trigger, 'bdgs/reset')[0]
    assert call(me, Trigger, 'bdgs/save_trajectory')[0]
