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


def test_a_signal_ends_everything_and_says_that_nothing_is_saved(graph: Graph) -> None:
    slam = graph.node('slam_node')
    wait_ready(slam)
    pids = children(slam)
    assert len(pids) == 3
    assert slam.stop(signal.SIGTERM) == 0, slam.text()
    wait_gone(pids)
    assert 'Traceback' not in slam.text()
    assert "nothing is saved: the parameter 'output' names no folder" in slam.text()


RESULTS = ('trajectory.txt', 'trajectory_final.txt', 'map.ply', 'metrics.json')


@pytest.mark.parametrize('how', ['ctrl-c', 'terminal closed', 'whole group', 'replay dies'])
def test_every_way_out_saves(
    graph: Graph, bag: Path, settings: dict[str, object], tmp_path: Path, how: str
) -> None:
    """In the middle of a recording; within seconds, and with what there is by then."""
    output = tmp_path / 'results'
    slam = graph.node('slam_node', bag=bag, output=output, rate=0.1, **settings)
    wait_ready(slam)
    time.sleep(5.0)
    pids = children(slam)
    names = {pid: Path(f'/proc/{pid}/cmdline').read_text() for pid in pids}
    begun = time.monotonic()
    if how == 'replay dies':
        (replay,) = (pid for pid, name in names.items() if 'replay_node' in name)
        os.kill(replay, signal.SIGKILL)
        assert slam.wait(20.0) != 0
    else:
        number = signal.SIGHUP if how == 'terminal closed' else signal.SIGINT
        for pid in pids if how == 'whole group' else ():  # as systemd does
            os.kill(pid, number)
        assert slam.stop(number, 20.0) == 0, slam.text()
    assert time.monotonic() - begun < 10.0
    wait_gone(pids)
    assert 'Traceback' not in slam.text()
    assert [name for name in RESULTS if not (output / name).is_file()] == []
    online = read_trajectory(output / 'trajectory.txt')
    assert len(online) >= 5
    assert len(read_trajectory(output / 'trajectory_final.txt')) >= len(online) - 3
    metrics = json.loads((output / 'metrics.json').read_text())['metrics']
    assert metrics['frames_in']['value'] >= len(online)


def test_a_second_signal_ends_at_once(
    graph: Graph, bag: Path, settings: dict[str, object], tmp_path: Path
) -> None:
    slam = graph.node('slam_node', bag=bag, output=tmp_path / 'out', rate=0.1, **settings)
    wait_ready(slam)
    pids = children(slam)
    slam.process.send_signal(signal.SIGINT)
    slam.process.send_signal(signal.SIGTERM)  # another, for two of one kind may arrive as one
    assert slam.wait(10.0) == 0
    wait_gone(pids)
    assert 'ending at once' in slam.text()


def test_nodes_that_lose_their_parent_save_what_they_have(
    graph: Graph, bag: Path, settings: dict[str, object], tmp_path: Path
) -> None:
    output = tmp_path / 'results'
    slam = graph.node('slam_node', bag=bag, output=output, rate=0.1, **settings)
    wait_ready(slam)
    time.sleep(5.0)
    pids = children(slam)
    slam.process.kill()
    wait_gone(pids)
    missing = [name for name in RESULTS[:3] if not (output / name).is_file()]
    assert missing == [], slam.text()
    assert len(read_trajectory(output / 'trajectory.txt')) >= 5


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
