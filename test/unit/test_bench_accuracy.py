"""Bench `accuracy`: which cells, what a row holds, and what rows boil down to."""

from __future__ import annotations

import cv2
import pytest

from bdgs_ros.bench import accuracy, sequences
from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.data.synth import scenarios, write_recording


@pytest.fixture
def options(tmp_path):
    weights = tmp_path / 'weights.onnx'
    return Options(tmp_path / 'accuracy', tmp_path, seeds=(0, 1, 2, 3, 4), weights=weights)


def test_the_whole_method_has_five_seeds_and_each_switch_two(options):
    labels = [cell.label for cell in accuracy.cells(options)]
    assert len(set(labels)) == len(labels)
    for scenario in scenarios():
        assert sum(label.startswith(f'synth_{scenario}/weights/') for label in labels) == 5
    for scenario in ('static', 'walking_rpy', 'crowd'):
        assert sum(label.startswith(f'synth_{scenario}/no_masks/') for label in labels) == 2
    assert {'bonn_crowd_part/weights/0', 'fr1_rpy_part/plain_velocity/0'} <= set(labels)


def test_a_loop_is_recorded_to_its_end_and_run_without_closing_it(options):
    by_label = {cell.label: cell for cell in accuracy.cells(options)}
    assert by_label['synth_loop_room/weights/0'].settings['frames'] == 450
    assert by_label['synth_static/weights/0'].settings['frames'] == 300
    assert {'synth_loop_room/no_loop/1', 'synth_loop_room/no_bundle/0'} <= set(by_label)
    assert 'synth_static/no_loop/0' not in by_label


def test_switches_are_parameters_or_left_out(options, monkeypatch):
    for name in accuracy.known_switches():
        with_values(BdgsConfig(), accuracy.SWITCHES[name])
    monkeypatch.setitem(accuracy.SWITCHES, 'no_wings', {'tracking.wings': 'false'})
    assert 'no_wings' not in accuracy.known_switches()
    assert all(cell.configuration != 'no_wings' for cell in accuracy.cells(options))


def test_the_command_line_has_the_last_word(options):
    mine = Options(options.work, options.data, values={'tracking.masked': 'true'})
    by_label = {cell.label: cell for cell in accuracy.cells(mine)}
    cell = by_label['synth_static/no_masks/0']
    assert cell.settings['values'] == {'tracking.masked': 'true'}


def test_a_row_of_a_short_run(options, monkeypatch):
    recording = options.data / 'synth'
    write_recording(recording, 'walking_xyz', 3, 12, size=(160, 120), jobs=1)
    monkeypatch.setattr(sequences, 'cell_recording', lambda cell, options: recording)
    # the detector is tested elsewhere; here nobody knows what moves
    monkeypatch.setattr(
        sequences, 'config_of', lambda values, weights, options: with_values(BdgsConfig(), values)
    )
    values = {'mapping.iterations': 2, 'mapping.width': 80, 'mapping.threads': 1}
    values |= {'mapping.growth_width': 80, 'tracking.keyframe.max_interval': 4}
    cell = Cell('synth_walking_xyz', 'weights', 0, {'kind': 'synth', 'values': values})
    row = accuracy.run_cell(cell, options)
    assert row['frames'] == 12
    assert row['lost'] == 0
    assert 0 < row['online_cm'] <= row['online_max_cm'] < 5
    assert 0 < row['final_cm'] <= row['final_max_cm'] < 5
    assert row['rpe_frame_cm'] > 0
    folder = options.work / 'runs' / cell.key
    assert cv2.imread(str(folder / 'errors.png')).shape[2] == 3
    assert not (folder / 'tiles.png').exists()


def rows():
    def row(sequence, configuration, seed, online, final, **columns):
        errors = {'online_cm': online, 'final_cm': final, 'online_max_cm': 3 * online}
        return {
            'sequence': sequence, 'configuration': configuration, 'seed': seed, **errors, **columns
        }  # fmt: skip

    return [
        row('bonn_crowd_part', 'weights', 0, 1.5, 1.4, coverage_percent=100.0),
        row('synth_crowd', 'weights', 0, 0.5, 0.4, coverage_percent=100.0),
        row('synth_crowd', 'weights', 1, 0.7, 0.6, coverage_percent=90.0),
        row('synth_crowd', 'weights', 2, 2.0, 1.0, coverage_percent=99.0),
        row('synth_crowd', 'no_masks', 0, 4.0, 3.0, coverage_percent=99.0),
        row('synth_crowd', 'no_masks', 1, 6.0, 5.0, coverage_percent=99.0),
    ]


def test_the_summary_has_the_goals():
    summary = accuracy.summarise(rows())
    assert summary['bonn_crowd_part_online_cm'] == 1.5
    assert summary['bonn_crowd_part_online_max_cm'] == 4.5
    assert summary['synth_online_cm_median'] == 0.7
    assert summary['synth_online_cm_worst'] == 2.0
    assert summary['synth_coverage_percent_worst'] == 90.0
    assert 'synth_walking_online_cm_worst' not in summary


def test_overviews_compare_parts_over_the_seeds_that_both_have():
    whole, parts = accuracy.overviews(rows()).values()
    crowd = next(line for line in whole if line['sequence'] == 'synth_crowd')
    assert (crowd['runs'], crowd['online_cm'], crowd['online_cm, worst']) == (3, 0.7, 2.0)
    assert crowd['coverage_percent, worst'] == 90.0
    crowd = next(line for line in parts if line['sequence'] == 'synth_crowd')
    assert crowd['runs'] == 2
    assert crowd['weights'] == '0.60 / 0.50'
    assert crowd['no_masks'] == '5.00 / 4.00'


def test_without_switches_there_is_no_table_of_parts():
    assert len(accuracy.overviews(rows()[:4])) == 1


def test_the_diagram_shows_how_honest_the_whole_method_is(tmp_path):
    shares = {50: 40.0, 80: 70.0, 95: 90.0, 99: 97.0}
    measured = [
        {
            'sequence': name,
            'configuration': 'weights',
            'seed': 0,
            **{f'within_{said}_pct': found for said, found in shares.items()},
        }
        for name in ('bonn_crowd_part', 'synth_static', 'synth_crowd', 'synth_door', 'synth_hall')
    ]
    accuracy.draw([*measured, {'sequence': 'x', 'configuration': 'no_masks', 'seed': 0}], tmp_path)
    picture = cv2.imread(str(tmp_path / 'reliability.png'))
    assert picture is not None
    assert picture.std() > 10
    accuracy.draw([], tmp_path / 'nowhere')
    assert not (tmp_path / 'nowhere').exists()
