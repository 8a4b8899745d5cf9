"""Whatever dies, the run goes on in the same world, with its trajectory and its map."""

from __future__ import annotations

import os
import signal
import time
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = [pytest.mark.ros, pytest.mark.slow]

from graph_processes import Graph, Running  # noqa: E402

from bdgs_ros.core.types import StampedPose, Trajectory  # noqa: E402
from bdgs_ros.data.bag_recording import BagSequence  # noqa: E402
from bdgs_ros.data.trajectory_io import read_trajectory  # noqa: E402
from bdgs_ros.eval.trajectory import associate, ate  # noqa: E402
from bdgs_ros.journal.folder import map_folder, poses_file  # noqa: E402
from bdgs_ros.journal.poses import read_told  # noqa: E402

FAR_M = 0.05
RATE = 0.1  # three images a second: a node is away for some of them


def children(running: Running) -> dict[int, str]:
    path = Path(f'/proc/{running.process.pid}/task/{running.process.pid}/children')
    pids = [int(word) for word in path.read_text().split()]
    return {pid: Path(f'/proc/{pid}/cmdline').read_text() for pid in pids}


def wait_for_poses(slam: Running, journal: Path, count: int) -> list[StampedPose]:
    deadline = time.monotonic() + 60
    while len(poses := read_told(poses_file(journal)).poses) < count:
        assert time.monotonic() < deadline and slam.process.poll() is None, slam.text()
        time.sleep(0.05)
    return poses


def finished(slam: Running, output: Path) -> tuple[Trajectory, Trajectory]:
    """Wait for a good end, and return the trajectories that it left, online and final."""
    assert slam.wait(120.0) == 0, slam.text()
    online, final = (read_trajectory(output / f'trajectory{end}.txt') for end in ('', '_final'))
    return online, final


def check_one_world(online: Trajectory, truth: Trajectory, at_once_s: float = 0.5) -> None:
    """All poses are right in one frame, and none jumps against the one before."""
    known = [(truth.poses[g], online.poses[e]) for g, e in zip(*associate(truth, online))]  # noqa: B905
    errors = ate(truth, online).statistics
    assert errors.max < FAR_M
    for (true_a, a), (true_b, b) in pairwise(known):
        if b.stamp_ns - a.stamp_ns < at_once_s * 1e9:
            step = np.linalg.inv(a.T_world_camera) @ b.T_world_camera
            true = np.linalg.inv(true_a.T_world_camera) @ true_b.T_world_camera
            assert np.linalg.norm(step[:3, 3] - true[:3, 3]) < FAR_M


@pytest.mark.parametrize('node', ['tracking', 'mapping', 'detection'])
def test_a_node_that_is_killed_goes_on_in_the_same_world(
    graph: Graph, bag: Path, settings: dict[str, object], tmp_path: Path, node: str
) -> None:
    output = tmp_path / 'out'
    slam = graph.node('slam_node', bag=bag, output=output, rate=RATE, exit_at_end=True, **settings)
    before = wait_for_poses(slam, output / 'journal', 6)
    (pid,) = (pid for pid, line in children(slam).items() if f'{node}_node' in line)
    os.kill(pid, signal.SIGKILL)
    online, final = finished(slam, output)
    assert f'{node}_node ended with status -9; starting it again' in slam.text()
    assert 'Traceback' not in slam.text()

    sequence = BagSequence(bag)
    truth = sequence.ground_truth
    assert truth is not None
    assert {pose.stamp_ns for pose in before} <= set(online.stamps_ns.tolist())
    assert online.stamps_ns[-1] == sequence.stamps_ns[-1], slam.text()
    check_one_world(online, truth)
    assert set(online.stamps_ns.tolist()) <= set(final.stamps_ns.tolist())
    assert ate(truth, final).statistics.max < FAR_M
    assert not (output / 'journal').exists()  # all is saved


def test_a_run_is_gone_on_with_after_a_power_cut(
    graph: Graph, bag: Path, settings: dict[str, object], tmp_path: Path
) -> None:
    output = tmp_path / 'out'
    slam = graph.node('slam_node', bag=bag, output=output, rate=RATE, **settings)
    wait_for_poses(slam, output / 'journal', 8)
    for pid in children(slam):
        os.kill(pid, signal.SIGKILL)
    slam.process.kill()
    slam.wait()
    assert not (output / 'trajectory.txt').exists()
    told = read_told(poses_file(output / 'journal')).poses
    assert len(list(map_folder(output / 'journal').glob('map-*.ply'))) > 0

    sequence = BagSequence(bag)
    truth = sequence.ground_truth
    assert truth is not None
    start_s = 1e-9 * (told[-1].stamp_ns - sequence.stamps_ns[0]) + 0.05
    again = graph.node(
        'slam_node', bag=bag, output=output, rate=RATE, start=start_s, resume=True,
        exit_at_end=True, **settings,
    )  # fmt: skip
    online, final = finished(again, output)
    assert f'going on with {len(told)} poses' in again.text()
    stamps = online.stamps_ns.tolist()
    assert stamps[: len(told)] == [pose.stamp_ns for pose in told]
    assert stamps[-1] == sequence.stamps_ns[-1]
    check_one_world(online, truth)
    assert final.stamps_ns.tolist() == stamps
    assert ate(truth, final).statistics.max < FAR_M


def test_a_run_does_not_go_on_unasked(
    graph: Graph, bag: Path, settings: dict[str, object], tmp_path: Path
) -> None:
    output = tmp_path / 'out'
    slam = graph.node('slam_node', bag=bag, output=output, rate=RATE, **settings)
    wait_for_poses(slam, output / 'journal', 3)
    slam.stop(signal.SIGINT)
    kept = read_told(poses_file(output / 'journal')).poses
    assert len(read_trajectory(output / 'trajectory.txt')) >= len(kept) - 1
    again = graph.node('slam_node', bag=bag, output=output, exit_at_end=True, **settings)
    assert again.wait(120.0) == 0, again.text()
    assert 'going on with' not in again.text()
    assert len(read_trajectory(output / 'trajectory.txt')) <= len(BagSequence(bag))


def test_without_a_journal_a_killed_tracker_still_asks_for_its_world(
    graph: Graph, bag: Path, settings: dict[str, object], tmp_path: Path
) -> None:
    output = tmp_path / 'out'
    slam = graph.node(
        'slam_node', bag=bag, output=output, rate=RATE, exit_at_end=True,
        journal__enabled=False, **settings,
    )  # fmt: skip
    slam.wait_for('playing', 60.0)
    time.sleep(2.0)
    (pid,) = (pid for pid, line in children(slam).items() if 'tracking_node' in line)
    os.kill(pid, signal.SIGKILL)
    assert slam.wait(120.0) == 0, slam.text()
    final = read_trajectory(output / 'trajectory_final.txt')
    assert len(final) > len(read_trajectory(output / 'trajectory.txt'))
    truth = BagSequence(bag).ground_truth
    assert truth is not None and ate(truth, final).statistics.max < FAR_M


def test_stamps_from_before_the_journal_begin_another_world(
    graph: Graph, bag: Path, settings: dict[str, object], tmp_path: Path
) -> None:
    output = tmp_path / 'out'
    slam = graph.node('slam_node', bag=bag, output=output, rate=RATE, **settings)
    wait_for_poses(slam, output / 'journal', 6)
    slam.stop(signal.SIGINT)
    again = graph.node(
        'slam_node', bag=bag, output=output, resume=True, exit_at_end=True, **settings
    )
    assert again.wait(120.0) == 0, again.text()
    assert 'another world begins: the first image' in again.text()
    online = read_trajectory(output / 'trajectory.txt')
    assert len(set(online.stamps_ns.tolist())) == len(online) <= len(BagSequence(bag))
