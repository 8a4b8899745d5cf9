"""Bench `belief`: which cells, what a row holds, and what rows boil down to."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bdgs_ros.bench import belief, belief_cost, sequences
from bdgs_ros.bench.harness import Cell, Options, to_markdown
from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.data.synth import write_recording
from bdgs_ros.eval.belief_score import BeliefScore


@pytest.fixture
def options(tmp_path):
    return Options(tmp_path / 'belief', tmp_path, seeds=tuple(range(belief.SEEDS)))


def test_every_scenario_has_five_seeds_and_switches_fewer(options):
    labels = [cell.label for cell in belief.cells(options)]
    assert len(set(labels)) == len(labels)
    for scenario in ('crowd', 'unknown_box', 'static'):
        assert sum(label.startswith(f'synth_{scenario}/weights/') for label in labels) == 5
    assert 'synth_chair_moved/no_multi_view/1' in labels
    assert 'synth_chair_moved/no_multi_view/2' not in labels
    assert {'bonn_crowd_part/no_belief/0', 'bonn_crowd_part/from_300/0'} <= set(labels)
    assert {'synth_crowd/absent/0', 'synth_crowd/late300/1', 'synth_crowd/from_150/0'} <= set(
        labels
    )


def test_every_switch_is_a_parameter(options):
    for values in belief.SWITCHES.values():
        with_values(BdgsConfig(), values)


def test_settings_tell_cells_apart_and_the_command_line_has_the_last_word(options):
    by_label = {cell.label: cell for cell in belief.cells(options)}
    off = by_label['synth_walking_xyz/no_belief/0']
    assert off.settings['values'] == {'belief.enabled': 'false'}
    assert by_label['synth_crowd/absent/0'].settings['weights'] == ''
    assert by_label['synth_crowd/drop30/0'].settings['trouble']['drop'] == 0.3
    late = by_label['bonn_crowd_part/from_300/0']
    assert late.settings['start'] == 300
    keys = [cell.key for cell in by_label.values()]
    assert len(set(keys)) == len(keys)
    mine = Options(options.work, options.data, values={'belief.enabled': 'true'})
    again = {cell.label: cell for cell in belief.cells(mine)}
    assert again[off.label].settings['values'] == {'belief.enabled': 'true'}


def test_quick_is_two_short_scenarios(options):
    quick = Options(options.work, options.data, quick=True, seeds=options.seeds)
    found = belief.cells(quick)
    assert [cell.label for cell in found] == [
        'synth_unknown_box/weights/0',
        'synth_walking_xyz/weights/0',
    ]
    assert {cell.settings['frames'] for cell in found} == {sequences.SYNTH_FRAMES_QUICK}


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp('synth') / 'unknown_box'
    write_recording(folder, 'unknown_box', 3, 24, size=(160, 120), jobs=1)
    return folder


def test_a_row_of_a_short_run(recording, options, monkeypatch):
    monkeypatch.setattr(sequences, 'cell_recording', lambda cell, options: recording)
    values = {'mapping.iterations': 4, 'mapping.width': 80, 'mapping.threads': 1}
    values |= {'mapping.growth_width': 80, 'tracking.keyframe.max_interval': 3}
    settings = {'kind': 'synth', 'frames': 20, 'values': values, 'weights': '', 'trouble': {}}
    cell = Cell('synth_unknown_box', 'geometric', 0, {**settings, 'start': 4})
    row = belief.run_cell(cell, options)
    assert row['frames'] == 20  # from the fifth to the end
    score = BeliefScore.of(row['counts'])
    assert score.statics > 100
    assert score.true_negatives > 100
    assert row['false_removal_percent'] == pytest.approx(100 * score.false_removal)
    assert row['hidden_minus_rest_db'] == row['psnr_hidden_db'] - row['psnr_rest_db']
    assert row['inference_ms'] > 0
    page = cv2.imread(str(options.work / 'runs' / cell.key / 'posterior.png'))
    assert page is not None
    assert page.shape[1] == 4 * 160 + 3 * 4


def test_without_movers_there_is_nothing_to_be_found():
    score = BeliefScore(true_positives=1, false_positives=1, statics=8, statics_removed=2)
    row = belief._scores(score, with_movers=False)
    assert 'precision' not in row
    assert 'recall' not in row
    assert row['false_removal_percent'] == 25.0


def rows():
    def row(scenario, configuration, seed, **columns):
        name = f'synth_{scenario}'
        return {'sequence': name, 'configuration': configuration, 'seed': seed, **columns}

    common = {'false_removal_percent': 2.0, 'restored_percent': 90.0}
    return [
        row('crowd', 'weights', 0, recall=0.9, precision=0.8, **common),
        row('crowd', 'weights', 1, recall=0.7, precision=1.0, **common),
        row('unknown_box', 'weights', 0, recall=0.8, precision=None, unknown_recall=0.6, **common),
        row('unknown_box', 'geometric', 0, recall=0.1, precision=0.1, unknown_recall=0.1),
        {'sequence': 'bonn_crowd_part', 'configuration': 'weights', 'seed': 0, 'ate_cm': 2.0},
        {'sequence': 'gaussians_50000', 'configuration': 'inference', 'seed': 0,
         'inference_50k_ms': 12.0},
    ]  # fmt: skip


def test_the_summary_is_of_the_full_configuration_in_fractions():
    summary = belief.summarise(rows())
    assert {name: summary[name] for name in list(summary)[:5]} == {
        'recall': 0.8,
        'precision': 0.9,
        'false_removal': 0.02,
        'restored': 0.9,
        'unknown_recall': 0.6,
    }
    assert summary['recall_worst'] == 0.7
    assert summary['false_removal_percent_worst'] == 2.0
    assert summary['inference_50k_ms'] == 12.0
    assert 'ate_cm_median' not in summary  # the real recording is no part of it


def test_the_overview_has_median_and_worst_of_each_recording():
    (table,) = belief.overviews(rows()).values()
    crowd = table[0]
    assert (crowd['sequence'], crowd['runs']) == ('synth_crowd', 2)
    assert crowd['recall'] == pytest.approx(0.8)
    assert crowd['recall, worst'] == 0.7
    assert 'psnr_db' not in crowd
    assert 'gaussians_50000' not in {line['sequence'] for line in table}


def test_the_page_has_the_overview(options):
    results = {
        'bench': 'belief', 'protocol': '', 'quick': False, 'commits': ['c'], 'rows': rows(),
        'tables': belief.TABLES, 'overviews': belief.overviews(rows()), 'summary': {},
        'provenance': {'machine': {'processor': 'p', 'cores': 1, 'python': '3'}},
    }  # fmt: skip
    page = to_markdown(results)
    assert '## Median and worst over seeds' in page
    assert '| synth_unknown_box | geometric | 1 |' in page


def test_cost_is_measured_with_the_memory_of_views_full(monkeypatch):
    monkeypatch.setattr(belief_cost, '_GAUSSIANS', 500)
    monkeypatch.setattr(belief_cost, '_TIMED', 2)
    row = belief_cost.measure(BdgsConfig())
    assert row['cost_views'] == BdgsConfig().belief.views
    assert row['cost_gaussians'] > 500  # the camera saw more of the room
    assert np.isfinite(row['inference_50k_ms'])
