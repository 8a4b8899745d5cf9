"""The one command: it runs a recording to its end, survives deaths, and leaves nobody behind."""

from __future__ import annotations

import json
import os
import signal
import time
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = [pytest.mark.ros, pytest.mark.slow]

from graph_processes import Graph, Running  # noqa: E402

from bdgs_ros.bridge.runner import STACKS_SIGNAL  # noqa: E402
from bdgs_ros.core.types import Trajectory  # noqa: E402
from bdgs_ros.data.trajectory_io import read_trajectory  # noqa: E402


def children(running: Running) -> list[int]:
    path = Path(f'/proc/{running.process.pid}/task/{running.process.pid}/children')
    return [int(word) for word in path.read_text().split()]


def alive(pid: int) -> bool:
    try:
        return Path(f'/proc/{pid}/stat').read_text().rsplit(')', 1)[1].split()[0] != 'Z'
    except OSError:
        return False


def wait_gone(pids: list[int], timeout_s: float = 10.0) -> None:
    deadline = time.monotonic() + timeout_s
    while any(alive(pid) for pid in pids):
        assert time.monotonic() < deadline, f'{[p for p in pids if alive(p)]} live on'
        time.sleep(0.05)


def wait_ready(slam: Running, count: int = 1) -> None:
    deadline = time.monotonic() + 60
    for stage in ('detection', 'tracking', 'mapping'):
        slam.wait_for(f'{stage} is ready', deadline - time.monotonic())


@pytest.mark.parametrize(
    ('mode', 'processes'), [('lockstep', 'several'), ('lockstep', 'one'), ('realtime', 'several')]
)
def test_a_recording_to_its_end(
    graph: Graph,
    bag: Path,
    offline: Trajectory,
    offline_final: Trajectory,
    settings: dict[str, object],
    tmp_path: Path,
    mode: str,
    processes: str,
) -> None:
    out = tmp_path / 'out'
    slam = graph.node(
        'slam_node', bag=bag, output=out, exit_at_end=True, mode=mode, processes=processes,
        **settings,
    )  # fmt: skip
    assert slam.wait(120.0) == 0, slam.text()
    metrics = json.loads((out / 'metrics.json').read_text())['metrics']
    assert (out / 'map.ply').stat().st_size > 1000
    assert metrics['gaussians']['value'] > 100
    assert metrics['frames_sent']['value'] == len(offline)
    assert metrics['ate_rmse']['value'] < 10.0
    live, final = (read_trajectory(out / f'trajectory{end}.txt') for end in ('', '_final'))
    assert final.stamps_ns.tolist() == live.stamps_ns.tolist()
    assert metrics['ate_final_rmse']['value'] < 10.0
    if mode == 'lockstep':
        check_same(live, offline)
        check_same(final, offline_final)
        assert np.abs(final.positions - live.positions).max() > 1e-4
        assert metrics['frames_missed']['value'] == 0
    else:
        passed_over = metrics['frames_dropped']['value']  # tests share the machine with others
        assert passed_over <= 0.1 * len(offline)
        assert metrics['frames_missed']['value'] == passed_over
        assert metrics['frames_in']['value'] == len(offline) - passed_over


def check_same(live: Trajectory, offline: Trajectory) -> None:
    assert live.stamps_ns.tolist() == offline.stamps_ns.tolist()
    assert live.positions == pytest.approx(offline.positions, abs=1e-4)


@pytest.mark.parametrize('with_signal', [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_everything(graph: Graph, with_signal: signal.Signals) -> None:
    slam = graph.node('slam_node')
    wait_ready(slam)
    pids = children(slam)
    assert len(pids) == 3
    assert slam.stop(with_signal) == 0, slam.text()
    wait_gone(pids)
    assert 'Traceback' not in slam.text()


def test_children_die_with_their_parent_and_dead_ones_are_started_again(graph: Graph) -> None:
    slam = graph.node('slam_node')
    wait_ready(slam)
    before = children(slam)
    names = [Path(f'/proc/{pid}/cmdline').read_text() for pid in before]
    (mapping,) = (pid for pid, name in zip(before, names, strict=True) if 'mapping_node' in name)
    os.kill(mapping, STACKS_SIGNAL)
    slam.wait_for('most recent call first', 10.0)
    assert Path(f'/proc/{mapping}').exists()
    os.kill(mapping, signal.SIGKILL)
    slam.wait_for('mapping_node ended with status -9; starting it again', 10.0)
    deadline = time.monotonic() + 30
    while slam.text().count('mapping is ready') < 2:
        assert time.monotonic() < deadline, slam.text()
        time.sleep(0.1)
    pids = children(slam)
    assert len(pids) == 3
    slam.process.kill()
    wait_gone(pids)
