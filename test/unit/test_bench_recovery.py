"""Bench `recovery`: which cells there are, and how a run is scored."""

from __future__ import annotations

import numpy as np
import pytest
from test_faults import Straight

from bdgs_ros.bench import recovery
from bdgs_ros.bench.harness import Options
from bdgs_ros.bench.recovery import Watch, make_fault, score
from bdgs_ros.tracking.loss import Evidence


@pytest.fixture
def options(tmp_path) -> Options:
    return Options(tmp_path / 'recovery', tmp_path, seeds=tuple(range(recovery.SEEDS)))


def watch_of(fault, count: int, lost: range, off: range) -> Watch:
    """Return a run that is exact, but has no pose in `lost` and is 0.3 m off in `off`."""
    true = fault.frames.ground_truth.positions[:count]
    positions = [p + np.array([0, 0.3, 0]) if i in off else p for i, p in enumerate(true)]
    evidence = [
        Evidence(0.9, 0.7, 0.7, 2.0, 4.0 if i in lost else 0.02, 0.01) for i in range(count)
    ]
    return Watch(positions, [i not in lost for i in range(count)], [None, *evidence[1:]], [1.0])


def test_cells_are_told_apart_and_plain_covers_have_one_seed(options: Options) -> None:
    labels = [cell.label for cell in recovery.cells(options)]
    assert len(set(labels)) == len(labels)
    assert {'bonn_crowd_part/jump/0', 'synth_crowd/black/4', 'synth_static/none/4'} <= set(labels)
    assert 'synth_crowd/wall/1' not in labels
    assert 'synth_crowd/blind/0' in labels


@pytest.mark.parametrize('name', ['black', 'grey', 'blind', 'wall'])
def test_every_cover_lasts_a_second(name: str) -> None:
    fault = make_fault(Straight(150), name, 0)
    assert (fault.start, fault.stop) == (75, 106)
    has_depth = bool(fault.frames[fault.start].depth_m.any())
    assert has_depth is (name == 'wall')


def test_loss_and_recovery_are_timed() -> None:
    fault = make_fault(Straight(150), 'black', 0)
    assert (fault.start, fault.stop) == (75, 106)
    row = score(fault, watch_of(fault, 150, lost=range(77, 110), off=range(0)))
    assert row['to_lost_s'] == pytest.approx(0.066)
    assert row['to_found_s'] == pytest.approx(4 * 0.033)
    assert (row['false_lost'], row['wrong_ok'], row['never_found']) == (0, 0, 0)
    assert row['after_cm'] == pytest.approx(0.0, abs=1e-6)
    assert row['bad_sigma_share'][0] == 2.0
    assert row['good_sigma_share'][-1] == 0.01


def test_wrong_poses_are_counted_and_do_not_count_as_found() -> None:
    fault = make_fault(Straight(150), 'jump', 0)
    assert row_of(fault, off=range(fault.start, 195))['never_found'] == 1
    row = row_of(fault, off=range(fault.start, fault.start + 5))
    assert row['wrong_ok'] == 5
    assert row['to_lost_s'] is None
    assert row['to_found_s'] == pytest.approx(5 * 0.033)
    assert fault.figures['jumped_m'] > 0.5


def row_of(fault, off: range) -> dict:
    return score(fault, watch_of(fault, 195, lost=range(0), off=off))


def test_a_run_without_a_fault_tells_false_losses() -> None:
    fault = make_fault(Straight(100), 'none', 0)
    row = score(fault, watch_of(fault, 100, lost=range(40, 43), off=range(0)))
    assert row['false_lost'] == 3
    assert 'never_found' not in row


def test_rows_boil_down_to_few_figures() -> None:
    fault = make_fault(Straight(150), 'black', 0)
    row = score(fault, watch_of(fault, 150, lost=range(75, 110), off=range(120, 122)))
    rows = [{'sequence': 's', 'configuration': 'black', 'seed': i, **row} for i in range(2)]
    summary = recovery.summarise(rows)
    assert summary['black_wrong_ok'] == 4
    assert summary['black_to_lost_s_worst'] == 0.0
    assert summary['black_never_found'] == 0
    assert np.isfinite(summary['black_after_cm_median'])
