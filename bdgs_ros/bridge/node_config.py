"""
The parameters of the nodes: what the stages' own configs do not know.

ROS-free, so that the reference yaml and the tests can read it anywhere. Every node accepts the
parameters of all nodes and uses its own: one yaml file serves the whole graph.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from pathlib import Path

from bdgs_ros.core.config import (
    BackEndConfig,
    BeliefConfig,
    CameraConfig,
    DetectionConfig,
    MappingConfig,
    TrackingConfig,
    param,
    specs,
)


@dataclass(frozen=True)
class QosConfig:
    """How the camera topics travel."""

    reliability: str = param(
        'reliable',
        'of the camera topics; live cameras often publish best_effort',
        choices=('reliable', 'best_effort'),
    )
    depth: int = param(10, 'images kept for a slow reader', low=1, high=1000)


@dataclass(frozen=True)
class SyncConfig:
    """How colour and depth find each other."""

    tolerance_s: float = param(
        0.03, 'colour and depth further apart are no pair', unit='s', low=0.0, high=1.0
    )
    jump_back_s: float = param(
        0.5, 'stamps that jump back further reset everything', unit='s', low=0.0
    )


@dataclass(frozen=True)
class JournalConfig:
    """What a run leaves on the disk while it goes on."""

    enabled: bool = param(True, 'write poses and map down while they come, to go on after a crash')
    folder: str = param(
        '', 'where; empty: in output, else in the cache folder (slam_node), or not (other nodes)'
    )
    limit_mb: float = param(
        512.0, 'of the poses, 3 kB a second; the map has limits of its own', unit='MB', low=1.0
    )


@dataclass(frozen=True)
class GraphConfig:
    """What every node of the graph shares."""

    mode: str = param(
        'realtime',
        'realtime: never wait, drop and count what is late; lockstep: wait, drop nothing',
        choices=('realtime', 'lockstep'),
    )
    lockstep_timeout_s: float = param(
        60.0, 'lockstep goes on without a peer that is silent', unit='s', low=0.1
    )
    silence_s: float = param(
        3.0, 'a topic silent for longer is warned about', unit='s', low=0.5, high=60.0
    )
    load_at_start: bool = param(
        False, 'begin in the map of map_file, if it exists, and go on mapping'
    )
    localization: bool = param(
        False, 'begin in the map of map_file and leave it as it is: localisation alone'
    )
    resume: bool = param(False, 'go on with the world that the journal holds')
    journal: JournalConfig = field(default_factory=JournalConfig)
    camera: CameraConfig = field(default_factory=CameraConfig)
    qos: QosConfig = field(default_factory=QosConfig)
    sync: SyncConfig = field(default_factory=SyncConfig)

    @property
    def lockstep(self) -> bool:
        """Whether nodes wait for each other."""
        return self.mode == 'lockstep'

    @property
    def begins_in_map(self) -> bool:
        """Whether tracking starts in a map that exists."""
        return self.load_at_start or self.localization

    @property
    def journal_folder(self) -> Path | None:
        """Where the journal is; None where none is kept."""
        return Path(self.journal.folder) if self.journal.enabled and self.journal.folder else None


@dataclass(frozen=True)
class DetectionNodeConfig(GraphConfig):
    """Parameters of detection_node."""

    labels_rate: float = param(
        10.0, 'images labelled at most, others are passed over (realtime)', unit='Hz', low=0.1
    )
    detection_nice: int = param(5, 'how much detection gives way to tracking', low=0, high=19)
    detection: DetectionConfig = field(default_factory=DetectionConfig)


@dataclass(frozen=True)
class TrackingNodeConfig(GraphConfig):
    """Parameters of tracking_node."""

    map_frame: str = param('map', 'frame id of the world: x forward, y left, z up at the start')
    camera_frame: str = param('', 'frame id of the camera; empty: that of the colour image')
    publish_tf: bool = param(True, 'publish map to camera on /tf where tf2_msgs is installed')
    path_period_s: float = param(1.0, 'between two messages of the path', unit='s', low=0.0)
    labels_max_age_s: float = param(
        0.5, 'older labels are not used (realtime)', unit='s', low=0.0, high=10.0
    )
    realtime_priority: int = param(
        1,
        "of tracking's threads, SCHED_RR, if the system grants it (docs/realtime.md); 0: never",
        low=0,
        high=90,
    )
    tracking_cpus: str = param('', "processors that tracking keeps to, such as '3'; empty: any")
    map_file: str = param(
        '', 'where bdgs/save_map writes and bdgs/load_map reads; may change at run time'
    )
    trajectory_file: str = param('', 'where bdgs/save_trajectory writes; may change at run time')
    tracking: TrackingConfig = field(default_factory=TrackingConfig)


@dataclass(frozen=True)
class MappingNodeConfig(GraphConfig):
    """Parameters of mapping_node."""

    map_frame: str = param('map', 'frame id of the world: x forward, y left, z up at the start')
    map_file: str = param(
        '', 'where bdgs/save_map writes and bdgs/load_map reads; may change at run time'
    )
    start_pose: str = param(
        '',
        "about where the camera starts in the map of map_file: 'x y z qx qy qz qw' in metres, as "
        "in the trajectory files; empty: the map's origin; may change at run time",
    )
    final_trajectory_file: str = param(
        '', 'where bdgs/save_final_trajectory writes; may change at run time'
    )
    render_rate: float = param(
        5.0,
        'of bdgs/rendered, while subscribed and the map grows (frozen: every pose); 0: never',
        unit='Hz',
        low=0.0,
        high=1000.0,
    )
    render_width: int = param(
        320, 'of bdgs/rendered, and mapping.width at most', unit='px', low=20, high=4096
    )
    map_period_s: float = param(2.0, 'between two messages of bdgs/map', unit='s', low=0.0)
    keyframe_queue: int = param(
        2, 'keyframes that may wait for the map; older ones only move (realtime)', low=1, high=1000
    )
    frame_buffer: int = param(60, 'frames kept until their keyframe arrives', low=2, high=10000)
    back_end_nice: int = param(0, 'how much the back end gives way to tracking', low=0, high=19)
    mapping_nice: int = param(5, 'how much mapping gives way to tracking', low=0, high=19)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    back_end: BackEndConfig = field(default_factory=BackEndConfig)


@dataclass(frozen=True)
class ReplayConfig(GraphConfig):
    """Parameters of replay_node."""

    bag: str = param('', 'path of the recording: a rosbag2 folder or file, or a ROS 1 .bag')
    rate: float = param(1.0, 'speed of real-time replay', low=0.01, high=100.0)
    start: float = param(0.0, 'offset into the recording', unit='s', low=0.0)
    duration: float = param(0.0, 'how much to play; 0: all', unit='s', low=0.0)
    loop: bool = param(False, 'begin again at the end')
    paused: bool = param(False, 'start paused; bdgs/replay/pause and bdgs/replay/step go on')
    wait_subscribers: int = param(
        1, 'subscribers of the colour topic to wait for before the start', low=0, high=100
    )
    wait_timeout_s: float = param(
        30.0, 'then start anyway, with a warning', unit='s', low=0.0, high=3600.0
    )
    report_file: str = param('', 'where the counts go at the end, as JSON; empty: nowhere')
    color_topic: str = param('', 'colour topic in the bag; empty: found by its name')
    depth_topic: str = param('', 'depth topic in the bag; empty: found by its name')
    info_topic: str = param('', 'camera_info topic in the bag; empty: found by its name')


@dataclass(frozen=True)
class SlamConfig(GraphConfig):
    """Parameters of slam_node itself; it hands everything else to the nodes it starts."""

    bag: str = param('', 'recording to replay through the graph; empty: wait for a camera')
    output: str = param(
        '', 'folder for trajectory.txt, trajectory_final.txt, map.ply and metrics.json'
    )
    exit_at_end: bool = param(False, 'write the results and stop when the recording is over')
    processes: str = param(
        'several',
        'one process per node, or all nodes in this one',
        choices=('one', 'several'),
    )
    respawns: int = param(3, 'times that a dead node is started again', low=0, high=1000)


NODE_CONFIGS: dict[str, type[GraphConfig]] = {
    'detection_node': DetectionNodeConfig,
    'tracking_node': TrackingNodeConfig,
    'mapping_node': MappingNodeConfig,
    'replay_node': ReplayConfig,
    'slam_node': SlamConfig,
}


def known_names() -> list[str]:
    """Return the name of every parameter that any node has, sorted."""
    return sorted({spec.name for config in NODE_CONFIGS.values() for spec in specs(config())})
