"""The services of mapping: what loading a map at run time gives up, and when tracking is in it."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')

from bdgs_ros.bridge import topics
from bdgs_ros.bridge.node_config import MappingNodeConfig
from bdgs_ros.core import se3
from bdgs_ros.core.errors import ConfigError, MapError
from bdgs_ros.core.types import StampedPose
from bdgs_ros.nodes import map_services
from bdgs_ros.nodes.map_entrance import MapEntrance
from bdgs_ros.nodes.map_services import LiveMap, MapServices


class FakeNode:
    """Parameters, and what is published and subscribed by topic."""

    def __init__(self, **values: str) -> None:
        self.values = {'map_file': '', 'start_pose': '', 'final_trajectory_file': '', **values}
        self.sent: dict[str, list[object]] = {}
        self.callbacks: dict[str, object] = {}
        self.actions: dict[str, object] = {}

    def get_parameter(self, name: str) -> SimpleNamespace:
        return SimpleNamespace(value=self.values[name])

    def create_publisher(self, kind: type, topic: str, qos: object) -> SimpleNamespace:
        return SimpleNamespace(publish=self.sent.setdefault(topic, []).append)

    def create_subscription(self, kind: type, topic: str, callback: object, qos: object) -> None:
        self.callbacks[topic] = callback


class FakeSideNode:
    def __init__(self, node: FakeNode) -> None:
        self._node = node

    def serve_trigger(self, name: str, action: object) -> None:
        self._node.actions[name] = action

    serve_switch = serve_trigger

    def start(self) -> None:
        pass


class FakeMapper:
    frozen = False

    def __init__(self) -> None:
        self.map = [0] * 3
        self.history = SimpleNamespace(begin_run=lambda: None)

    def load(self, path: Path) -> None:
        if not path.is_file():
            raise MapError(f"no map at '{path}'")
        self.map = [0] * 5


@pytest.fixture
def served(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> SimpleNamespace:
    """Services with a map that tracking has been in for a frame, and a file to load."""
    monkeypatch.setattr(map_services, 'SideNode', FakeSideNode)
    (tmp_path / 'map.ply').touch()
    node, live, loads = FakeNode(), LiveMap(FakeMapper()), []
    services = MapServices(
        node, MappingNodeConfig(), None, live, lambda: None, lambda: loads.append(len(live.poses))
    )
    services.start()
    live.poses.append(StampedPose(1, np.eye(4)))
    return SimpleNamespace(node=node, live=live, loads=loads, file=tmp_path / 'map.ply')


def test_a_loaded_map_is_another_world_until_tracking_asks_for_it(served: SimpleNamespace) -> None:
    served.node.values.update(map_file=str(served.file), start_pose='1 2 3 0 0 0 1')
    assert served.node.actions[topics.LOAD_MAP]() == f"5 Gaussians from '{served.file}'"
    assert served.loads == [0] and served.live.version == 1
    assert not served.live.is_entered
    assert se3.log(served.live.start_pose) == pytest.approx([1, 2, 3, 0, 0, 0])
    assert [m.data for m in served.node.sent[topics.MAP_LOADED]] == [str(served.file)]
    MapEntrance(served.node, served.live, None, None, None, None, 320, None, None)
    served.node.callbacks[topics.MAP_REQUEST](None)
    assert served.live.is_entered


@pytest.mark.parametrize(
    ('values', 'error', 'words'),
    [
        ({}, ConfigError, "set the parameter 'map_file'"),
        ({'map_file': 'none.ply'}, MapError, 'none.ply'),
        ({'map_file': 'map.ply', 'start_pose': '1 2'}, ConfigError, "'start_pose'"),
    ],
)
def test_what_cannot_be_loaded_changes_nothing(
    served: SimpleNamespace, values: dict[str, str], error: type, words: str
) -> None:
    folder = served.file.parent
    served.node.values.update(
        {n: str(folder / v) if n == 'map_file' else v for n, v in values.items()}
    )
    with pytest.raises(error, match=words):
        served.node.actions[topics.LOAD_MAP]()
    assert served.live.is_entered and len(served.live.poses) == 1 and not served.loads
    assert len(served.live.mapper.map) == 3
    assert not served.node.sent[topics.MAP_LOADED]
