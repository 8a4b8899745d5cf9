"""Benches `faults` and `soak`: what they make of what they saw."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.bench import soak
from bdgs_ros.bench.faults import errors_after
from bdgs_ros.bench.live import children_of
from bdgs_ros.core import se3
from bdgs_ros.core.types import StampedPose, Trajectory

PERIOD_NS = 33_000_000


def path_of(indices: list[int], off_m: dict[int, float] | None = None) -> Trajectory:
    """A camera that goes along x, turning; `off_m` by how much some poses are wrong."""
    poses = []
    for i in indices:
        T = se3.exp(np.array([0.02 * i, 0.1 * np.sin(0.2 * i), 0, 0, 0.01 * i, 0]))
        T[2, 3] += (off_m or {}).get(i, 0.0)
        poses.append(StampedPose(i * PERIOD_NS, T))
    return Trajectory(tuple(poses))


TRUTH = path_of(list(range(60)))


def test_a_gap_is_no_error() -> None:
    online = path_of([*range(20), *range(50, 60)])
    row = errors_after(TRUTH, online, before=20)
    assert row['gap_s'] == pytest.approx(31 * PERIOD_NS * 1e-9)
    assert row['jump_cm'] == pytest.approx(0, abs=1e-6)
    assert row['off_cm'] == pytest.approx(0, abs=1e-6) and row['wrong'] == 0


def test_jumps_and_wrong_poses_are_counted() -> None:
    online = path_of(list(range(60)), {40: 0.2, 41: 0.2, 50: 0.05})
    row = errors_after(TRUTH, online, before=20)
    assert row['jump_cm'] == pytest.approx(20, abs=0.5)
    assert row['off_cm'] == pytest.approx(20, abs=0.5)
    assert row['wrong'] == 2


def test_without_a_kill_only_steps_are_looked_at() -> None:
    assert set(errors_after(TRUTH, path_of(list(range(60)), {30: 0.1}), None)) == {'jump_cm'}


def test_growth_is_a_slope_after_the_warm_up() -> None:
    samples = [
        {'s': float(s), 'mapping_mb': 100.0 + (0 if s < 900 else 10 * (s - 900) / 3600)}
        for s in range(0, 3600, 10)
    ]
    row = soak.growth(samples)
    assert row['mapping_mb_per_h'] == pytest.approx(10, rel=0.01)
    assert row['mapping_mb_most'] == pytest.approx(107.5, abs=0.1)
    assert soak.growth([]) == {}


def test_children_are_found_by_their_module_and_sampled(tmp_path: Path) -> None:
    (tmp_path / 'some').write_bytes(bytes(2_000_000))
    code = 'print(flush=True); input()'  # it runs, and is not still the process it came from
    command = [sys.executable, '-c', code, 'bdgs_ros.nodes.mapping_node']
    with subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE) as child:
        assert child.stdout is not None and child.stdout.readline()
        assert child.pid in children_of(os.getpid(), 'bdgs_ros.nodes.mapping_node')
        found = soak.sample(os.getpid(), tmp_path)
        assert found['mapping_mb'] > 1 and found['mapping_files'] >= 3
        assert found['journal_mb'] == pytest.approx(2.0)
        soak.disturb(os.getpid(), 'kill_mapping')
        assert child.wait(10) == -9
    assert children_of(2**22 + 1, 'x') == []


def test_the_curves_are_drawn(tmp_path: Path) -> None:
    watch = soak.Watch(10, tmp_path, 0)
    watch.samples = [{'s': s, 'slam_mb': 50.0, 'slam_files': 9, 'shm_mb': 1.0} for s in range(9)]
    watch.faults = [(3.0, 'silent')]
    soak.plot(tmp_path / 'soak.png', watch)
    assert (tmp_path / 'soak.png').stat().st_size > 5000
