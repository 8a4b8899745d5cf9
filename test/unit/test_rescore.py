"""Scoring a finished run from its files, and the steps of the demo."""

from __future__ import annotations

import json
import sys
from types import ModuleType

import pytest
from run_fakes import FakeMapper, FakeSequence, FakeSlam, FakeTruth, true_pose

from bdgs_ros import rescore as module
from bdgs_ros.cli import demo, main
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.errors import BdgsError, EvaluationError
from bdgs_ros.core.types import Labels, StampedPose, Trajectory
from bdgs_ros.data import layouts
from bdgs_ros.data.trajectory_io import write_trajectory
from bdgs_ros.runner import run_sequence, write_results


class FakeDetection:
    def __init__(self, config):
        pass

    def process(self, frame):
        mask = FakeTruth().dynamic(frame.stamp_ns)
        return Labels(frame.stamp_ns, (mask * 255).astype('uint8'))


class LoadedMapper(FakeMapper):
    def __init__(self, mapping, belief):
        super().__init__()

    def load(self, path):
        assert path.is_file()


@pytest.fixture
def finished(tmp_path, monkeypatch):
    """Return the folder of a run that lost two of twelve frames and drew nothing."""
    for name, attribute, fake in (
        ('bdgs_ros.detection.stage', 'DetectionStage', FakeDetection),
        ('bdgs_ros.mapping.mapper', 'Mapper', LoadedMapper),
    ):
        stub = ModuleType(name)
        setattr(stub, attribute, fake)
        monkeypatch.setitem(sys.modules, name, stub)
    monkeypatch.setattr(layouts, 'open_sequence', lambda *_, **__: FakeSequence(12))
    monkeypatch.setattr(module, 'open_truth', lambda path: FakeTruth())
    slam = FakeSlam(lost=(3, 4))
    result = run_sequence(FakeSequence(12), slam)
    write_results(tmp_path, result, slam.mapper, extra={'mode': 'lockstep'}, with_pictures=False)
    return tmp_path


def test_rescoring_adds_figures_and_pictures_and_keeps_the_rest(finished):
    before = json.loads((finished / 'metrics.json').read_text())
    metrics = module.rescore(finished, finished, BdgsConfig())
    values = {name: entry['value'] for name, entry in metrics['metrics'].items()}
    assert values['tracking_median'] == before['metrics']['tracking_median']['value']
    assert values['keyframes'] == 3
    assert values['coverage'] == pytest.approx(100 * 10 / 12)
    assert values['ate_rmse'] == pytest.approx(0.0, abs=1e-5)
    assert values['prior_recall'] == 1.0
    assert values['psnr_hidden'] == pytest.approx(40.0, abs=0.1)
    assert metrics['mode'] == 'lockstep'
    assert json.loads((finished / 'metrics.json').read_text())['mode'] == 'lockstep'
    for name in ('tiles.png', 'animation.gif', 'trajectory.png'):
        assert (finished / name).is_file()


def test_a_trajectory_of_another_recording_is_refused(finished):
    write_trajectory(finished / 'trajectory.txt', Trajectory((StampedPose(5, true_pose(0)),)))
    with pytest.raises(EvaluationError, match='none of 1 poses'):
        module.rescore(finished, finished, BdgsConfig())


def test_report_command_writes_a_page(finished, capsys):
    assert main.main(['report', str(finished), '--recording', str(finished)]) == 0
    assert 'report.html' in capsys.readouterr().out
    page = (finished / 'report.html').read_text()
    assert 'ATE RMSE' in page
    assert page.count('<img') == 3


def test_demo_goes_step_by_step_and_shows_its_commands(finished, monkeypatch, capsys):
    steps = []
    monkeypatch.setattr(demo, '_step', lambda title, command: steps.append(command) or 1.0)
    (finished / 'bag').mkdir()
    (finished / 'bag' / 'old').write_text('')
    assert main.main(['demo', str(finished), '--frames', '20']) == 0
    assert not (finished / 'bag').exists()
    assert [c[2:4] for c in steps] == [
        ['bdgs_ros.cli.main', 'synth'],
        ['bdgs_ros.cli.main', 'convert'],
        ['bdgs_ros.nodes.slam_node', '--ros-args'],
    ]
    assert 'exit_at_end:=true' in steps[2]
    page = (finished / 'report.html').read_text()
    assert 'bdgs synth' in page
    assert 'slam_node --ros-args' in page
    assert 'ate_rmse' in capsys.readouterr().out


def test_a_failed_step_is_named():
    with pytest.raises(BdgsError, match='bag: exit code 3'):
        demo._step('bag', [sys.executable, '-c', 'raise SystemExit(3)'])
