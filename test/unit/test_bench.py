"""The bench harness: resumable, honest about failures, readable results."""

from __future__ import annotations

import json
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from bdgs_ros.bench.harness import Cell, Options, run_bench, to_markdown
from bdgs_ros.cli.main import main
from bdgs_ros.core.errors import ConfigError, DatasetError


class FakeBench:
    NAME = 'fake'
    PROTOCOL = 'Counts\nits calls.'

    def __init__(self):
        self.ran = []
        self.broken = set()

    def cells(self, options):
        return [
            Cell(sequence, configuration, seed, {'values': dict(options.values)})
            for sequence in ('a', 'b')
            for configuration in ('x', 'y')
            for seed in options.seeds
        ]

    def run_cell(self, cell, options):
        self.ran.append(cell.label)
        if cell.label in self.broken:
            raise DatasetError('no such recording')
        return {'score': np.float64(len(self.ran)), 'none': float('nan')}

    def summarise(self, rows):
        return {'total': sum(row['score'] for row in rows)}


class IsolatedBench(FakeBench):
    ISOLATED = True

    def run_cell(self, cell, options):
        if cell.sequence == 'b':
            raise DatasetError('no such recording')
        return {'process': os.getpid()}

    def summarise(self, rows):
        return {}


class ParallelBench(FakeBench):
    PARALLEL = True

    def prepare(self, cell, options):
        self.ran.append(cell.label)

    def run_cell(self, cell, options):
        if cell.sequence == 'b' and cell.configuration == 'y':
            raise DatasetError('no such recording')
        time.sleep(0.2)
        threads = int(os.environ['OMP_NUM_THREADS'])
        return {'process': os.getpid(), 'threads': threads, 'slow_ms': 1.0}

    def summarise(self, rows):
        return {}


class SlowBench(ParallelBench):
    """Leaves its process numbers in a folder and does not end by itself."""

    def run_cell(self, cell, options):
        (options.data / str(os.getpid())).touch()
        if len(list(options.data.glob('[0-9]*'))) == 2:
            (options.data / 'both').touch()
        time.sleep(60)
        return {}


@pytest.fixture
def options(tmp_path):
    return Options(work=tmp_path / 'work', data=tmp_path)


def test_finished_cells_are_not_measured_again(options):
    bench = FakeBench()
    first = run_bench(bench, options)
    assert len(bench.ran) == 4
    second = run_bench(bench, options)
    assert len(bench.ran) == 4
    assert second['rows'] == first['rows']
    run_bench(bench, options, force=True)
    assert len(bench.ran) == 8


def test_isolated_cells_have_a_process_each_and_their_errors_arrive(options):
    results = run_bench(IsolatedBench(), options, ['*/x/0'])
    done, failed = results['rows']
    assert done['process'] != os.getpid()
    assert failed['error'] == 'no such recording'


def test_cells_at_once_have_processes_of_one_thread_and_no_times(options, monkeypatch):
    monkeypatch.delenv('OMP_NUM_THREADS', raising=False)
    bench = ParallelBench()
    results = run_bench(bench, replace(options, jobs=2))
    assert [row['configuration'] for row in results['rows']] == ['x', 'y', 'x', 'y']
    assert results['rows'][3]['error'] == 'no such recording'
    good = results['rows'][:3]
    assert os.getpid() not in {row['process'] for row in good}
    assert {row['threads'] for row in good} == {1}
    assert all('slow_ms' not in row and row['jobs'] == 2 for row in good)
    assert bench.ran == ['a/x/0', 'a/y/0', 'b/x/0', 'b/y/0']  # prepared one after the other
    assert 'OMP_NUM_THREADS' not in os.environ
    again = run_bench(bench, replace(options, jobs=2))
    assert again['rows'][:3] == good


def test_benches_that_measure_times_run_in_turn_whatever_is_asked_for(options):
    bench = FakeBench()
    run_bench(bench, replace(options, jobs=2))
    assert len(bench.ran) == 4


def test_one_job_keeps_the_times(options, monkeypatch):
    monkeypatch.setenv('OMP_NUM_THREADS', '3')
    row = run_bench(ParallelBench(), options)['rows'][0]
    assert row['slow_ms'] == 1.0
    assert 'jobs' not in row


_INTERRUPTED = """
import sys
sys.path.insert(0, sys.argv[1])
from pathlib import Path
from test_bench import Options, SlowBench, run_bench
folder = Path(sys.argv[2])
run_bench(SlowBench(), Options(folder / 'work', folder, jobs=2))
"""


@pytest.mark.parametrize('how', [signal.SIGINT, signal.SIGKILL])
def test_an_interrupted_bench_leaves_no_process_behind(tmp_path, how):
    script = tmp_path / 'interrupted.py'
    guarded = _INTERRUPTED.replace(
        'run_bench(Slow', "if __name__ == '__main__':\n    run_bench(Slow"
    )
    script.write_text(guarded)
    here = str(Path(__file__).parent)
    parent = subprocess.Popen(
        [sys.executable, str(script), here, str(tmp_path)], stderr=subprocess.DEVNULL
    )
    try:
        _wait_for(lambda: (tmp_path / 'both').exists(), 60)
        workers = [int(path.name) for path in tmp_path.glob('[0-9]*')]
        assert len(workers) == 2
        parent.send_signal(how)
        assert parent.wait(90) != 0
        _wait_for(lambda: not any(_alive(pid) for pid in workers), 90)
    finally:
        parent.kill()


def _wait_for(condition, limit_s):
    end = time.monotonic() + limit_s
    while not condition():
        assert time.monotonic() < end, f'not within {limit_s} s'
        time.sleep(0.05)


def _alive(pid):
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except FileNotFoundError:
        return False
    return state != 'Z'


def test_other_settings_are_other_cells(options):
    bench = FakeBench()
    run_bench(bench, options)
    run_bench(bench, Options(options.work, options.data, values={'mapping.iterations': '5'}))
    run_bench(bench, Options(options.work, options.data, seeds=(0, 1)))
    assert len(bench.ran) == 4 + 4 + 4


@pytest.mark.parametrize(
    ('only', 'count'), [(['a'], 2), (['y'], 2), (['a/x/0'], 1), (['a', 'b'], 4)]
)
def test_only_chooses_by_sequence_configuration_or_label(options, only, count):
    bench = FakeBench()
    assert len(run_bench(bench, options, only)['rows']) == count == len(bench.ran)


@pytest.mark.parametrize('only', [['c*'], ['a', 'b/z/0']])
def test_a_pattern_that_matches_nothing_is_refused_with_what_it_could_match(options, only):
    bench = FakeBench()
    with pytest.raises(ConfigError) as error:
        run_bench(bench, options, only)
    assert f"--only '{only[-1]}' matches none of the 4 cells of bench fake" in str(error.value)
    assert 'sequences a, b and the configurations x, y' in str(error.value)
    assert "'a/x/0'" in str(error.value)
    assert not bench.ran and not options.work.exists()


def test_of_many_names_the_likeliest_are_shown(options):
    bench = FakeBench()
    names = [f'recording_{i}' for i in range(20)]
    bench.cells = lambda options: [Cell(name, 'x') for name in [*names, 'walking_xyz']]
    with pytest.raises(ConfigError, match=r'sequences walking_xyz, recording_0, .*, \.\.\. and'):
        run_bench(bench, options, ['walkin_xyz*'])


def test_the_command_line_refuses_a_pattern_that_matches_nothing(tmp_path, capsys):
    code = main(['bench', 'recovery', '--only', 'nowhere', '--work', str(tmp_path)])
    assert code == 2
    out, err = capsys.readouterr()
    assert out == ''
    assert err.startswith("bdgs bench: --only 'nowhere' matches none") and 'black' in err


def test_a_failure_stays_in_the_table_and_is_tried_again(options):
    bench = FakeBench()
    bench.broken = {'a/y/0'}
    results = run_bench(bench, options)
    assert results['failed'] == 1
    assert [row.get('error') for row in results['rows']].count('no such recording') == 1
    assert 'no such recording' in to_markdown(results)
    bench.broken = set()
    assert run_bench(bench, options)['failed'] == 0
    assert len(bench.ran) == 5


def test_an_interrupted_bench_goes_on_where_it_stopped(options, monkeypatch):
    bench = FakeBench()
    run_cell = bench.run_cell

    def interrupted(cell, opts):
        if len(bench.ran) == 2:
            raise KeyboardInterrupt
        return run_cell(cell, opts)

    monkeypatch.setattr(bench, 'run_cell', interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_bench(bench, options)
    monkeypatch.setattr(bench, 'run_cell', run_cell)
    run_bench(bench, options)
    assert bench.ran == ['a/x/0', 'a/y/0', 'b/x/0', 'b/y/0']


def test_results_say_where_they_come_from(options):
    run_bench(FakeBench(), options)
    results = json.loads((options.work / 'results.json').read_text())
    assert results['summary'] == {'total': 10.0}
    assert results['protocol'] == 'Counts its calls.'
    assert results['provenance']['machine']['cores'] >= 1
    assert len(results['commits']) == 1
    assert results['rows'][0]['none'] is None
    page = (options.work / 'results.md').read_text()
    assert '| a | x | 0 | 1 | - |' in page
    assert '| total | 10 |' in page


def test_slam_summary_picks_and_pools():
    from bdgs_ros.bench import slam

    rows = [
        {'sequence': 'bonn_crowd_part', 'configuration': 'w', 'ate_rmse_cm': 3.0,
         'coverage_percent': 100.0},
        {'sequence': 'synth_a', 'configuration': 'w', 'ate_rmse_cm': 1.0, 'psnr_db': 20.0,
         'coverage_percent': 90.0},
        {'sequence': 'synth_b', 'configuration': 'w', 'ate_rmse_cm': 2.0, 'psnr_db': None},
    ]  # fmt: skip
    assert slam.summarise(rows) == {
        'bonn_crowd_part_ate_cm_w': 3.0,
        'synth_ate_rmse_cm_median_w': 1.5,
        'synth_psnr_db_median_w': 20.0,
        'synth_ate_rmse_cm_worst_w': 2.0,
        'coverage_percent_min': 90.0,
    }


def test_missing_recordings_and_weights_are_named(tmp_path):
    from bdgs_ros.bench import sequences
    from bdgs_ros.core.errors import ModelError

    with pytest.raises(DatasetError, match='BDGS_SHARED'):
        sequences.real_path('fr1_rpy_part', tmp_path)
    cell = SimpleNamespace(configuration='weights')
    with pytest.raises(ModelError, match=r'yolov5n-320\.onnx.*--weights'):
        sequences.cell_config(cell, Options(tmp_path, tmp_path))


def test_rasterizer_scene_fills_the_view():
    from bdgs_ros.bench import rasterizer
    from bdgs_ros.mapping.rasterize import render

    camera = rasterizer.make_camera(64, 48)
    scene = rasterizer.make_scene(1500, camera, np.random.default_rng(0))
    z = scene.means[:, 2]
    assert 0.5 < z.min() < 2.5
    assert z.max() <= 3.0 + 1e-5
    assert render(scene, np.eye(4), camera).silhouette.mean() > 0.7


def test_rasterizer_rows_have_every_column(tmp_path):
    from bdgs_ros.bench import rasterizer

    settings = {'gaussians': 300, 'width': 32, 'height': 24, 'backend': 'auto', 'threads': 1}
    cell = Cell('small', 'auto_1', 0, settings)
    row = rasterizer.run_cell(cell, Options(tmp_path, tmp_path))
    times = ['forward_ms', 'backward_ms', 'fused_ms', 'step_ms']
    assert list(row) == [
        'gaussians', 'width', 'height', 'threads', 'backend', *times, 'gradient_error',
    ]  # fmt: skip
    assert all(row[name] > 0 for name in times)
    assert row['gradient_error'] < 1e-3
