"""What users ask of the map: save it, load another, freeze it, and the final trajectory."""

from __future__ import annotations

import threading
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

from std_msgs.msg import Bool, String

from bdgs_ros.bridge import topics
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.node_config import MappingNodeConfig
from bdgs_ros.bridge.runner import GraphNode
from bdgs_ros.bridge.services import SideNode
from bdgs_ros.core import se3
from bdgs_ros.core.errors import ConfigError
from bdgs_ros.core.types import Pose, StampedPose, Trajectory
from bdgs_ros.data.trajectory_io import parse_pose, write_trajectory
from bdgs_ros.mapping.mapper import Mapper

AT_RUN_TIME = ('map_file', 'final_trajectory_file', 'start_pose')
"""Parameters that are read when a service is called."""


@dataclass
class LiveMap:
    """A map that keyframes change while services read or replace it."""

    mapper: Mapper
    lock: threading.Lock = field(default_factory=threading.Lock)
    """Of the mapper."""
    version: int = 0
    """Changes with the map."""
    poses: list[StampedPose] = field(default_factory=list)
    """Of every frame in this world, as tracking gave them."""
    start_pose: Pose = field(default_factory=se3.identity)
    """`T_world_camera`: about where the camera is when tracking comes in."""
    is_entered: bool = True
    """False from a load until tracking asks for the map: what it says is of another world."""


class MapServices:
    """
    Answers the services of mapping, in a thread of their own.

    Parameters
    ----------
    node : GraphNode
        Its parameters say which files; it publishes.
    config : MappingNodeConfig
        What it begins with.
    health : Health
        Published with what is saved.
    live : LiveMap
        The map.
    settle : callable
        Returns once the keyframes that have arrived are in the map.
    on_loaded : callable
        Called when another map is there, with the lock held.

    """

    def __init__(
        self,
        node: GraphNode,
        config: MappingNodeConfig,
        health: Health,
        live: LiveMap,
        settle: Callable[[], None],
        on_loaded: Callable[[], None],
    ) -> None:
        self._node = node
        self._config = config
        self._health = health
        self._live = live
        self._settle = settle
        self._on_loaded = on_loaded
        self._localization = node.create_publisher(Bool, topics.LOCALIZATION, topics.LATCHED)
        self._loaded = node.create_publisher(String, topics.MAP_LOADED, topics.LATCHED)
        # A service waits for the keyframe at hand; meanwhile images must still be taken.
        self._side = SideNode(node)

    def start(self) -> None:
        """
        Load what the parameters ask for, and begin to answer.

        Raises
        ------
        ConfigError, MapError
            If there is no map to localise in, or one that cannot be read.

        """
        # Without the map there is nothing to localise in; mapping can begin without.
        self._live.start_pose = self._start_pose()
        if self._config.localization or (self._config.load_at_start and self.map_file().is_file()):
            self._node.get_logger().info(self._load())
        self._freeze(self._config.localization)
        self._side.serve_trigger(topics.SAVE_MAP, self._on_save)
        self._side.serve_trigger(topics.LOAD_MAP, self._on_load)
        self._side.serve_trigger(topics.SAVE_FINAL_TRAJECTORY, self._on_save_trajectory)
        self._side.serve_switch(topics.SET_LOCALIZATION_MODE, self._freeze)
        self._side.start()

    def stop(self) -> None:
        """Answer no more."""
        self._side.stop()

    def map_file(self) -> Path:
        """Return where the map is saved and loaded; raises `ConfigError` if nobody said so."""
        return self._file('map_file', 'where?')

    def withdraw(self) -> None:
        """Say that the map is of no file any more: it was forgotten."""
        self._loaded.publish(String())

    def _file(self, parameter: str, question: str) -> Path:
        file = str(self._node.get_parameter(parameter).value)
        if not file:
            raise ConfigError(f"{question} set the parameter '{parameter}' of mapping_node")
        return Path(file)

    def _start_pose(self) -> Pose:
        text = str(self._node.get_parameter('start_pose').value)
        try:
            return parse_pose(text) if text else se3.identity()
        except ValueError as error:
            raise ConfigError(f"'start_pose': {error}") from error

    def _on_save(self) -> str:
        self._settle()  # keyframes that have arrived belong into the file
        file = self.map_file()
        with self._live.lock:
            self._live.mapper.save(file)
            count = len(self._live.mapper.map)
        self._health.publish()
        return f"{count} Gaussians in '{file}'"

    def results(self) -> list[Callable[[], str]]:
        """Return what saves the final trajectory and the map, if files were named for them."""
        node, saves = self._node, [('final_trajectory_file', self._on_save_trajectory)]
        if not self._live.mapper.frozen:
            saves.append(('map_file', self._on_save))
        return [save for name, save in saves if node.get_parameter(name).value]

    def _on_load(self) -> str:
        """Replace the map, and have tracking look for the camera in it."""
        start_pose = self._start_pose()
        answer = self._load(is_entered=False)
        self._live.start_pose = start_pose
        self._loaded.publish(String(data=str(self.map_file().absolute())))
        return answer

    def _load(self, is_entered: bool = True) -> str:
        file = self.map_file()
        with self._live.lock:
            self._live.mapper.load(file)
            self._live.mapper.history.begin_run()
            self._live.poses = []
            self._live.version += 1
            self._live.is_entered = is_entered
            self._on_loaded()
            count = len(self._live.mapper.map)
        return f"{count} Gaussians from '{file}'"

    def _on_save_trajectory(self) -> str:
        file = self._file('final_trajectory_file', 'where to?')
        self._settle()
        with self._live.lock:
            online = Trajectory(tuple(self._live.poses))
            final = self._live.mapper.final_trajectory(online)
        write_trajectory(file, final)
        return f"{len(final)} poses in '{file}'"

    def _freeze(self, enabled: bool) -> str:
        with self._live.lock:
            self._live.mapper.frozen = enabled
        self._localization.publish(Bool(data=enabled))
        return 'the map is frozen' if enabled else 'the map grows'
