"""Numbers with units, as tables and JSON."""

from __future__ import annotations

import json
from pathlib import Path

import numpy as np

from bdgs_ros.eval import metric
from bdgs_ros.eval.metric import Metric


def test_json_is_strict():
    value = {
        'a': np.float32(0.5),
        'b': float('nan'),
        'c': (np.int64(3), np.arange(2)),
        'd': Path('x'),
        'e': True,
        'f': None,
    }
    assert json.loads(metric.dump_json(value)) == {
        'a': 0.5,
        'b': None,
        'c': [3, [0, 1]],
        'd': 'x',
        'e': True,
        'f': None,
    }


def test_table_aligns_numbers_right_and_keeps_missing_cells():
    table = metric.markdown_table([{'name': 'a|b', 'x': 1.23456}, {'name': 'c', 'y': 1e-6}])
    assert table.splitlines() == [
        '| name | x | y |',
        '|---|---:|---:|',
        '| a\\|b | 1.235 | - |',
        '| c | - | 1.00e-06 |',
    ]
    assert metric.markdown_table([]) == ''


def test_metric_reads_with_its_unit():
    assert str(Metric('ate_rmse', 2.3456, 'cm')) == 'ate_rmse 2.346 cm'
    assert metric.as_dict([Metric('n', 3)]) == {'n': {'value': 3, 'unit': ''}}
