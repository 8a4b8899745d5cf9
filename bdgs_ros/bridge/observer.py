"""What slam_node sees of its graph: a status per frame and the diagnostics of every node."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from rclpy.node import Node

from bdgs_ros.bridge import topics
from bdgs_ros.bridge.status import FrameState, FrameStatus, status_from_message
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.types import Pose, TrackingStatus, Trajectory
from bdgs_ros.data.trajectory_io import read_trajectory
from bdgs_ros.eval.metric import Metric
from bdgs_ros.eval.recorder import FrameRow, RunResult

_PREFIX = 'bdgs_ros: '
_STATUSES = (FrameState.OK, FrameState.LOST)
_NO_POSE = np.full((4, 4), np.nan)


class GraphObserver:
    """
    Collect what a run is judged by.

    Parameters
    ----------
    node : Node
        It subscribes.

    """

    def __init__(self, node: Node) -> None:
        self.diagnostics: dict[str, dict[str, str]] = {}
        self._statuses: list[FrameStatus] = []
        node.create_subscription(DiagnosticArray, topics.STATUS, self._on_status, topics.RELIABLE)
        node.create_subscription(
            DiagnosticArray, topics.DIAGNOSTICS, self._on_diagnostics, topics.RELIABLE
        )

    def _on_status(self, message: DiagnosticArray) -> None:
        self._statuses.append(status_from_message(message))

    def _on_diagnostics(self, message: DiagnosticArray) -> None:
        for status in message.status:
            if status.name.startswith(_PREFIX):
                name = status.name.removeprefix(_PREFIX)
                self.diagnostics[name] = {item.key: item.value for item in status.values}
                self.diagnostics[name]['message'] = status.message

    def write_metrics(
        self,
        folder: Path,
        config: BdgsConfig,
        name: str,
        ground_truth: Trajectory | None,
        map_file: Path,
        extra: dict[str, Any],
    ) -> dict[str, Any]:
        """Write `metrics.json` beside the trajectory and map that the nodes have saved."""
        from bdgs_ros.runner import map_metrics, write_results  # draws: slow to import

        result = self._result(read_trajectory(folder / 'trajectory.txt'))
        found = self._node_metrics()
        if map_file.is_file():
            found += map_metrics(map_file)
        return write_results(
            folder,
            result,
            name=name,
            ground_truth=ground_truth,
            final=read_trajectory(folder / 'trajectory_final.txt'),
            config=config,
            frames_expected=self._count('replay', 'frames_sent') or len(result.rows),
            more=found,
            extra={**extra, 'nodes': self.diagnostics},
            with_pictures=False,
        )

    def _result(self, trajectory: Trajectory) -> RunResult:
        poses = {pose.stamp_ns: pose.T_world_camera for pose in trajectory.poses}
        statuses = {s.stamp_ns: s for s in self._statuses if s.state in _STATUSES}
        for stamp_ns in poses:  # a pose counts, even if its status got lost
            statuses.setdefault(stamp_ns, FrameStatus(stamp_ns, FrameState.OK))
        return RunResult(tuple(_row(statuses[s], poses.get(s)) for s in sorted(statuses)), ())

    def _node_metrics(self) -> list[Metric]:
        found = [
            Metric('frames_sent', self._count('replay', 'frames_sent')),
            Metric('frames_missed', self._count('replay', 'frames_missed_by_tracking')),
            Metric('frames_dropped', self._count('tracking', 'frames_dropped')),
            Metric('keyframes_dropped', self._count('mapping', 'keyframes_dropped')),
        ]
        for node, key in (('detection', 'detection'), ('mapping', 'mapping')):
            for statistic in ('median', 'p95'):
                text = self.diagnostics.get(node, {}).get(f'{key}_ms_{statistic}')
                if text is not None:
                    found.append(Metric(f'{key}_{statistic}', float(text), 'ms'))
        return found

    def _count(self, node: str, key: str) -> int:
        return int(self.diagnostics.get(node, {}).get(key, '0'))


def _row(status: FrameStatus, pose: Pose | None) -> FrameRow:
    return FrameRow(
        status.stamp_ns,
        TrackingStatus.LOST if pose is None else TrackingStatus.OK,
        _NO_POSE if pose is None else pose,
        status.is_keyframe,
        status.inlier_ratio,
        status.overlap,
        {'tracking': status.tracking_ms, 'image_to_pose': status.latency_ms},
    )
