"""Bench `faults`: a node of the live graph is killed; what was lost, and how soon is all well."""

from __future__ import annotations

import json
import os
import re
import signal
import threading
import time
from collections.abc import Mapping, Sequence
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np

from bdgs_ros.bench import sequences
from bdgs_ros.bench.columns import median, worst
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.bench.live import SHM, bag_of, children_of, graph_values, run_graph
from bdgs_ros.bench.sequences import REAL
from bdgs_ros.core import se3
from bdgs_ros.core.types import Trajectory

NAME = 'faults'
SEEDS = 3
PROTOCOL = """
live, as in bench tracking; at a random moment in the middle half of the recording one process is
killed (SIGKILL), and slam_node starts it again. ready_s: from the kill to the node's word that it
is ready; gap_s: the longest time without a pose from then on; missing: frames sent without a pose
in trajectory.txt; jump_cm: the largest difference between a step from one pose to the next (within
0.2 s) and that of the truth; off_cm: the largest error after the kill, rigidly aligned to the
truth by the frames before it; wrong: poses after it more than 10 cm off; ATE of trajectory.txt and
trajectory_final.txt, and how many poses they have; gaussians at the end; left_in_shm: files that
the run left in /dev/shm.
"""
_NODES = ('none', 'tracking', 'mapping', 'detection')
_MIDDLE = (0.25, 0.75)
_STEP_NS = 200_000_000
_FAR_M = 0.1
_PATIENCE_S = 60.0


def cells(options: Options) -> list[Cell]:
    """List each node on each real recording; several seeds are several moments."""
    common = sequences.detector_settings('weights', options)
    settings = {**sequences.real_settings(options), **common}
    return [
        Cell(recording.name, f'kill_{node}', seed, settings)
        for recording in REAL
        for node in _NODES
        for seed in (options.seeds if node != 'none' else options.seeds[:1])
    ]


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Run the graph on one recording, and kill one node."""
    from bdgs_ros.data.layouts import open_sequence
    from bdgs_ros.data.trajectory_io import read_trajectory

    recording = sequences.cell_recording(cell, options)
    bag = bag_of(recording, cell, options)
    output = options.work / 'runs' / cell.key
    output.mkdir(parents=True, exist_ok=True)
    for old in output.glob('*.*'):
        old.unlink()
    sequence = open_sequence(recording)
    seconds = 1e-9 * (sequence.stamps_ns[-1] - sequence.stamps_ns[0])
    after_s = float(np.random.default_rng(cell.seed).uniform(*_MIDDLE)) * seconds
    killer = _Killer(cell.configuration.removeprefix('kill_'), output, after_s)
    before = set(SHM.iterdir())
    values = graph_values(bag, output, options)
    run_graph({**values, 'journal.folder': output / 'journal'}, output / 'log.txt', killer.watch)
    metrics = json.loads((output / 'metrics.json').read_text(encoding='utf-8'))
    found = {name: entry['value'] for name, entry in metrics['metrics'].items()}
    online = read_trajectory(output / 'trajectory.txt')
    truth = sequence.ground_truth
    assert truth is not None
    row = {
        'missing': found['frames_sent'] - len(online),
        'poses': len(online),
        'poses_final': len(read_trajectory(output / 'trajectory_final.txt')),
        'ate_cm': found.get('ate_rmse'),
        'ate_final_cm': found.get('ate_final_rmse'),
        'gaussians': found.get('gaussians'),
        'ready_s': killer.ready_s(output / 'log.txt'),
        'left_in_shm': len(set(SHM.iterdir()) - before),
    }
    return row | errors_after(truth, online, killer.share)


class _Killer:
    """Kills a node some time after the first pose."""

    def __init__(self, node: str, output: Path, after_s: float) -> None:
        self._node = node
        self._first = output / 'journal' / 'poses.rec'
        self._after_s = after_s
        self.share: int | None = None
        """Poses that were written when the node was killed."""
        self._killed_s = 0.0

    def watch(self, slam_pid: int) -> None:
        """Do it, in a thread that ends with the graph."""
        if self._node != 'none':
            threading.Thread(target=self._kill, args=[slam_pid], daemon=True).start()

    def _kill(self, slam_pid: int) -> None:
        from bdgs_ros.journal.poses import read_told

        deadline = time.monotonic() + _PATIENCE_S
        while not read_told(self._first).poses:
            if time.monotonic() > deadline:
                return
            time.sleep(0.05)
        time.sleep(self._after_s)
        self.share = len(read_told(self._first).poses)
        self._killed_s = time.time()
        for pid in children_of(slam_pid, f'bdgs_ros.nodes.{self._node}_node'):
            os.kill(pid, signal.SIGKILL)

    def ready_s(self, log: Path) -> float | None:
        """Return how long it took until the node said that it is ready again."""
        if not self._killed_s:
            return None
        said = re.findall(
            rf'\[INFO\] \[([0-9.]+)\] .*{self._node} is ready', log.read_text(encoding='utf-8')
        )
        later = [float(stamp) - self._killed_s for stamp in said]
        return min((seconds for seconds in later if seconds > 0), default=None)


def errors_after(truth: Trajectory, online: Trajectory, before: int | None) -> dict[str, Any]:
    """Return the columns of what was published after the first `before` poses."""
    from bdgs_ros.eval.trajectory import associate, ate

    of_truth, of_online = associate(truth, online)
    known = [(online.poses[e], truth.poses[g]) for g, e in zip(of_truth, of_online, strict=True)]
    steps = [
        (one, other)
        for one, other in pairwise(known)
        if other[0].stamp_ns - one[0].stamp_ns <= _STEP_NS
    ]
    jump_m = max((_step_error(one, other) for one, other in steps), default=0.0)
    stamps = np.array([pose.stamp_ns for pose in online.poses])
    first = len(stamps) if before is None else before
    row: dict[str, Any] = {'jump_cm': 100 * jump_m}
    if first < 2 or first >= len(stamps):
        return row
    aligned = ate(truth, Trajectory(online.poses[:first])).T_gt_est
    off = [
        float(np.linalg.norm((aligned @ pose.T_world_camera - true.T_world_camera)[:3, 3]))
        for pose, true in known
        if pose.stamp_ns >= stamps[first]
    ]
    return {
        **row,
        'gap_s': 1e-9 * float(np.diff(stamps[first - 1 :]).max()),
        'off_cm': 100 * max(off, default=0.0),
        'wrong': sum(m > _FAR_M for m in off),
    }


def _step_error(one: Any, other: Any) -> float:
    """Return by how much an estimated step differs from the true one, m."""
    estimated, true = (
        se3.inverse(a.T_world_camera) @ b.T_world_camera for a, b in zip(one, other, strict=True)
    )
    return float(np.linalg.norm(estimated[:3, 3] - true[:3, 3]))


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return median and worst of what was lost, for each recording and node."""
    summary: dict[str, Any] = {}
    for key in dict.fromkeys((row['sequence'], row['configuration']) for row in rows):
        own = [row for row in rows if (row['sequence'], row['configuration']) == key]
        for column in ('ready_s', 'gap_s', 'missing', 'jump_cm', 'off_cm', 'wrong'):
            name = '_'.join((*key, column))
            summary[name] = median(own, column)
            summary[f'{name}_worst'] = worst(own, column, is_most=True)
    return {name: value for name, value in summary.items() if value is not None}
