"""The command line: help, errors, figures and parameters."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from types import ModuleType

import numpy as np
import pytest
import yaml
from run_fakes import FakeSequence, FakeSlam

from bdgs_ros.cli import config as config_command
from bdgs_ros.cli import main
from bdgs_ros.core import se3
from bdgs_ros.core.config import BdgsConfig, specs
from bdgs_ros.core.errors import ConfigError
from bdgs_ros.core.types import StampedPose, Trajectory
from bdgs_ros.data import layouts
from bdgs_ros.data.trajectory_io import write_trajectory

REPOSITORY = Path(__file__).resolve().parents[2]
COMMANDS = ('synth', 'convert', 'info', 'run', 'eval', 'report', 'bench', 'config', 'demo')


@pytest.fixture
def trajectories(tmp_path):
    gt = FakeSequence(60).ground_truth
    rng = np.random.default_rng(0)
    est = Trajectory(
        tuple(
            StampedPose(p.stamp_ns, p.T_world_camera @ se3.exp(rng.normal(0, 0.01, 6)))
            for p in gt.poses
        )
    )
    write_trajectory(tmp_path / 'gt.txt', gt)
    write_trajectory(tmp_path / 'est.txt', est)
    return tmp_path / 'gt.txt', tmp_path / 'est.txt'


@pytest.mark.parametrize('command', COMMANDS)
def test_every_command_explains_itself(command, capsys):
    with pytest.raises(SystemExit) as stop:
        main.main([command, '--help'])
    assert stop.value.code == 0
    text = capsys.readouterr().out
    assert '--json' in text
    assert len(text.splitlines()) > 5


def test_eval_prints_a_table_json_and_a_plot(trajectories, tmp_path, capsys):
    gt, est = map(str, trajectories)
    assert main.main(['eval', gt, est, '--plot', str(tmp_path / 'plot.png')]) == 0
    table = capsys.readouterr().out
    assert '| ate_rmse |' in table
    assert 'cm per s' in table
    assert (tmp_path / 'plot.png').stat().st_size > 5000
    assert main.main(['eval', gt, est, '--json', '--frames', '120']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['metrics']['coverage'] == {'value': 50.0, 'unit': '%'}
    assert 0.5 < found['metrics']['ate_rmse']['value'] < 3.0
    assert found['protocol']['max_difference_s'] == 0.02


def test_a_foreseen_error_is_one_line_and_code_two(trajectories, tmp_path, capsys):
    gt, _ = map(str, trajectories)
    assert main.main(['eval', gt, str(tmp_path / 'absent.txt')]) == 2
    message = capsys.readouterr().err
    assert message.startswith('bdgs eval: ')
    assert 'absent.txt' in message
    assert message.count('\n') == 1


def test_an_interrupt_is_code_130(monkeypatch, capsys):
    def interrupt(_):
        raise KeyboardInterrupt

    monkeypatch.setattr(main.config, 'run', interrupt)
    assert main.main(['config']) == 130
    assert 'interrupted' in capsys.readouterr().err


def test_reference_yaml_is_in_step():
    wanted = config_command.to_yaml([*config_command.node_specs(), *specs(BdgsConfig())])
    path = REPOSITORY / 'config' / 'bdgs.yaml'
    assert path.read_text(encoding='utf-8') == wanted, 'run: bdgs config --yaml > config/bdgs.yaml'


def test_yaml_reads_back_with_types(capsys, tmp_path):
    assert main.main(['config', '--yaml', '--set', 'tracking.align.fine_width=160']) == 0
    path = tmp_path / 'p.yaml'
    path.write_text(capsys.readouterr().out)
    values = config_command.read_yaml(path)
    every = {s.name: s.value for s in [*config_command.node_specs(), *specs(BdgsConfig())]}
    every['tracking.align.fine_width'] = 160
    assert values == every
    assert {k: type(v) for k, v in values.items()} == {k: type(v) for k, v in every.items()}
    assert set(yaml.safe_load(path.read_text())) == {'/**'}


def config_from(*words):
    parser = main.build_parser()
    return config_command.load_config(parser.parse_args(['config', *words]))


def test_file_and_overrides_change_parameters(tmp_path):
    path = tmp_path / 'p.yaml'
    path.write_text(
        '/**:\n  ros__parameters:\n    use_sim_time: true\n    bag: x\n'
        'mapping_node:\n  ros__parameters:\n    mapping: {iterations: 7, width: 160}\n'
    )
    config = config_from('--config', str(path), '--set', 'mapping.width=200')
    assert (config.mapping.iterations, config.mapping.width) == (7, 200)
    path.write_text('mapping.iterations: 9\n')
    assert config_from('--config', str(path)).mapping.iterations == 9


@pytest.mark.parametrize(
    ('text', 'message'),
    [
        ('/**:\n  ros__parameters:\n    mapping: {iteratoins: 7}\n', 'mapping.iterations'),
        ('mapping: {iterations: -1}\n', '0 to 1000'),
        ('- 1\n', 'is not a parameter file'),
        ('a: [\n', 'cannot read parameters'),
    ],
)
def test_bad_files_are_refused(tmp_path, text, message):
    path = tmp_path / 'p.yaml'
    path.write_text(text)
    with pytest.raises(ConfigError, match=message):
        config_from('--config', str(path))


def test_bad_overrides_are_refused(capsys):
    assert main.main(['config', '--set', 'nonsense']) == 2
    assert 'NAME=VALUE' in capsys.readouterr().err
    assert main.main(['run', 'x', '--output', 'y', '--set', 'mapping.widht=1']) == 2
    assert "did you mean 'mapping.width'" in capsys.readouterr().err


def test_config_lists_every_parameter_with_its_range(capsys):
    assert main.main(['config']) == 0
    text = capsys.readouterr().out
    assert 'mapping.iterations = 40' in text
    assert '(0 to 1000)' in text
    assert main.main(['config', '--json']) == 0
    entries = {entry['name']: entry for entry in json.loads(capsys.readouterr().out)}
    assert entries['mapping.iterations']['low'] == 0


def test_run_writes_results_and_prints_them(monkeypatch, tmp_path, capsys):
    pipeline = ModuleType('bdgs_ros.pipeline')
    pipeline.BdgsSlam = lambda config: FakeSlam()
    monkeypatch.setitem(sys.modules, 'bdgs_ros.pipeline', pipeline)
    monkeypatch.setattr(layouts, 'open_sequence', lambda *_, **__: FakeSequence(20))
    words = ['run', str(tmp_path / 'seq'), '--output', str(tmp_path / 'out')]
    assert main.main([*words, '--start', '4', '--frames', '10', '--no-pictures', '--json']) == 0
    found = json.loads(capsys.readouterr().out)
    assert found['frames'] == [4, 14]
    assert found['metrics']['frames_in']['value'] == 10
    assert {p.name for p in (tmp_path / 'out').iterdir()} == {
        'map.ply',
        'metrics.json',
        'trajectory.txt',
        'trajectory_final.txt',
    }
    assert main.main([*words, '--frames', '30']) == 2
    assert 'frames 0 to 30' in capsys.readouterr().err
