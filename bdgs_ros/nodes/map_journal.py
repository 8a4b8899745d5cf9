"""Mapping's part of the journal: the map written down while it grows, and gone on with."""

from __future__ import annotations

from functools import partial
from operator import attrgetter
from pathlib import Path
from typing import BinaryIO

from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.node_config import MappingNodeConfig
from bdgs_ros.bridge.priority import give_way
from bdgs_ros.journal.checkpoints import Checkpoints, read_newest
from bdgs_ros.journal.folder import map_folder, poses_file, use
from bdgs_ros.journal.keeper import MapKeeper
from bdgs_ros.journal.poses import Told, read_told
from bdgs_ros.mapping.keyframe_store import KeyframeSet
from bdgs_ros.mapping.keyframes import MapKeyframe
from bdgs_ros.nodes.map_services import LiveMap

_NICE = 15  # whatever else the machine does comes first


class MapJournal:
    """
    Keeps the live map on the disk, where a journal is kept.

    Parameters
    ----------
    config : MappingNodeConfig
        Where, and whether to go on with what is there.
    live : LiveMap
        The map.
    health : Health
        Gets what goes wrong.

    """

    def __init__(self, config: MappingNodeConfig, live: LiveMap, health: Health) -> None:
        self._config = config
        self._live = live
        self._health = health
        self._keeper: MapKeeper | None = None
        self._checkpoints: Checkpoints | None = None
        self._kept: MapKeyframe | None = None  # the newest keyframe of the last state
        self._used: BinaryIO | None = None
        self._goes_on = False  # with a run that began before this process
        self._since_ns: int | None = None  # the newest keyframe of the map that was taken up

    def begin(self) -> bool:
        """Take up the map that is there, if that is wanted, and keep it from now on."""
        folder = self._config.journal_folder
        if folder is None:
            return False
        self._used = use(folder)
        kept = self._take_up(folder) if self._config.resume else None
        self._checkpoints = Checkpoints(map_folder(folder), kept)
        if kept is None and not self._live.mapper.frozen:
            self._checkpoints.clear()
        self._keeper = MapKeeper(
            self._checkpoints,
            partial(self._health.set_problem, 'journal'),
            partial(give_way, _NICE),
        )
        return kept is not None

    def _take_up(self, folder: Path) -> KeyframeSet | None:
        """Go on with the poses, and with the map if it is of the same world."""
        live, config = self._live, self._config
        told = read_told(poses_file(folder))
        self._goes_on = True
        live.poses = list(told.poses)
        if live.mapper.frozen or not told.poses:
            return None
        found = read_newest(map_folder(folder), config.belief, config.mapping)
        if found is None:
            return None
        gaussians, kept = found
        newest = kept.history.newest
        if newest is not None and newest.stamp_ns < told.poses[0].stamp_ns:  # of a world before
            return None
        live.mapper.take(gaussians, kept)
        live.version += 1
        self._since_ns = 0 if newest is None else newest.stamp_ns
        self._hear(told)
        return kept

    def catch_up(self) -> None:
        """Take what tracking said while mapping was not there, and what it had not written yet."""
        folder = self._config.journal_folder
        if folder is not None and self._goes_on:
            self._hear(read_told(poses_file(folder)))

    def _hear(self, told: Told) -> None:
        with self._live.lock:
            if not self._goes_on:  # all was forgotten meanwhile
                return
            poses = self._live.poses
            known = {pose.stamp_ns for pose in poses}
            poses += [pose for pose in told.poses if pose.stamp_ns not in known]
            poses.sort(key=attrgetter('stamp_ns'))  # in one step: newer ones come meanwhile
            if self._since_ns is not None:
                self._live.mapper.history.catch_up(self._since_ns, told.moves, told.pieces)

    def keep(self) -> None:
        """Have the map written if it is time, and has a new keyframe; its owner has locked it."""
        mapper = self._live.mapper
        if self._keeper is None or self._checkpoints is None or not self._keeper.is_due:
            return
        newest = mapper.keyframes[-1] if mapper.grows and mapper.keyframes else None
        if newest is not self._kept:
            self._kept = newest
            if newest is not None:
                self._keeper.put(self._checkpoints.state(mapper.map, mapper.kept()))

    def part(self) -> None:
        """Take that the world is given up: nothing that was said before is of the next one."""
        self._goes_on, self._since_ns = False, None

    def forget(self) -> None:
        """Take that the map was forgotten."""
        self.part()
        if self._keeper is not None:
            self._keeper.forget()

    def close(self) -> None:
        """Write what has changed, and end."""
        if self._keeper is not None:
            self._keeper.close()
        if self._used is not None:
            self._used.close()
