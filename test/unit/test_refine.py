"""Refinement improves a map within its limits, and is tested on frames it never saw."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_map_files import CAMERA, CONFIG, SECOND, a_frame, a_keyframe, mapped

from bdgs_ros import job as job_module
from bdgs_ros.cli import main
from bdgs_ros.core import se3
from bdgs_ros.core.errors import ConfigError, EvaluationError, MapError
from bdgs_ros.core.types import StampedPose, Trajectory
from bdgs_ros.data import layouts
from bdgs_ros.data.trajectory_io import write_trajectory
from bdgs_ros.mapping.keyframes import MapKeyframe
from bdgs_ros.mapping.map_files import keyframe_folder
from bdgs_ros.mapping.mapper import Mapper
from bdgs_ros.mapping.refiner import Refiner, rate_scale
from bdgs_ros.refine import RefineJob, refine_job, refine_map


class Recording:
    """The keyframes of `mapped`, and as many frames between them."""

    name = 'wall'
    ground_truth = None

    def __iter__(self):
        for i in range(6):
            keyframe = a_keyframe(i // 2)
            if i % 2 == 0:
                yield keyframe.frame
            else:
                T = self.pose(i)
                yield a_frame(keyframe.frame.stamp_ns + SECOND // 2, T)

    @staticmethod
    def pose(i: int) -> np.ndarray:
        step = np.array([0.02, 0.005, 0, 0, 0.01, 0.005]) * (i % 2)
        return a_keyframe(i // 2).T_world_camera @ se3.exp(step)

    def trajectory(self) -> Trajectory:
        stamps = [frame.stamp_ns for frame in self]
        return Trajectory(tuple(StampedPose(s, self.pose(i)) for i, s in enumerate(stamps)))


@pytest.fixture
def finished(tmp_path, monkeypatch) -> Path:
    """Return the folder of a run over `Recording`."""
    mapped().save(tmp_path / 'map.ply')
    write_trajectory(tmp_path / 'trajectory.txt', Recording().trajectory())
    monkeypatch.setattr(layouts, 'open_sequence', lambda *_, **__: Recording())
    monkeypatch.setattr(job_module, 'open_truth', lambda path: None)
    return tmp_path


def a_job(folder: Path, **options) -> RefineJob:
    settings = {'seconds': None, 'iterations': 60, 'config': CONFIG, 'progress': False}
    return RefineJob(folder, folder / 'refined', **{**settings, **options})


def test_the_loss_falls_on_every_keyframe():
    mapper = mapped()
    report = refine_map(mapper, CONFIG.mapping, seconds=None, iterations=60)
    assert report.iterations == 60
    assert report.loss_after < 0.8 * report.loss_before


def test_all_keyframes_get_their_turn(monkeypatch):
    mapper = mapped(4)
    refiner = Refiner(mapper.map, mapper.keyframes, CONFIG.mapping)
    turns: list[int] = []

    def note(gaussians, keyframe: MapKeyframe, level: int, scale: float) -> float:
        turns.append(keyframe.index)
        return 0.0

    monkeypatch.setattr(refiner._optimiser, 'step', note)
    for _ in range(12):
        refiner.step(0.0)
    assert [sorted(turns[i : i + 4]) for i in (0, 4, 8)] == [[0, 1, 2, 3]] * 3


def test_the_oldest_keyframe_holds_the_exposure():
    mapper = mapped()
    mapper.keyframes = mapper.keyframes[1:]  # the first, which never adapts, was dropped
    for keyframe in mapper.keyframes:
        keyframe.exposure[:] = [0.1, 0.02]
    refine_map(mapper, CONFIG.mapping, seconds=None, iterations=20)
    np.testing.assert_array_equal(mapper.keyframes[0].exposure, np.float32([0.1, 0.02]))
    assert (mapper.keyframes[1].exposure != np.float32([0.1, 0.02])).any()


def test_rates_fall_to_a_tenth():
    scales = [rate_scale(p) for p in (-1.0, 0.0, 0.5, 1.0, 2.0)]
    assert scales[:2] == [1.0, 1.0]
    assert scales[2] == pytest.approx(10**-0.5)
    assert scales[3:] == pytest.approx([0.1, 0.1])


def test_the_limit_that_comes_first_ends_it():
    mapper = mapped(1)
    assert refine_map(mapper, CONFIG.mapping, seconds=1000, iterations=3).iterations == 3
    report = refine_map(mapper, CONFIG.mapping, seconds=0.2, iterations=10**6)
    assert 0.2 <= report.seconds < 5
    assert 0 < report.iterations < 10**6


@pytest.mark.parametrize('limits', [(None, None), (0, None), (None, 0), (float('nan'), 5)])
def test_a_limit_is_needed_and_positive(limits):
    with pytest.raises(ConfigError):
        refine_map(mapped(1), CONFIG.mapping, *limits)


def test_an_interrupt_keeps_what_was_gained():
    def interrupt(elapsed_s: float, loss: float) -> None:
        raise KeyboardInterrupt

    report = refine_map(mapped(1), CONFIG.mapping, 60, None, interrupt)
    assert report.interrupted
    assert report.iterations == 1


def test_a_map_without_keyframes_cannot_be_refined(finished):
    mapper = mapped(1)
    mapper.save(finished / 'map.ply', keyframes=False)
    with pytest.raises(MapError, match=r"map_keyframes' is missing.*without --no-keyframes"):
        refine_job(a_job(finished))
    with pytest.raises(MapError, match='no keyframes to be refined with'):
        Refiner(mapper.map, [], CONFIG.mapping)


def test_the_result_is_a_complete_folder_that_can_be_refined_again(finished):
    metrics = refine_job(a_job(finished))
    out = finished / 'refined'
    assert json.loads((out / 'metrics.json').read_text()) == metrics
    assert (out / 'trajectory.txt').read_text() == (finished / 'trajectory.txt').read_text()
    assert metrics['metrics']['refine_iterations']['value'] == 60
    assert metrics['metrics_before'] == {}
    assert keyframe_folder(out / 'map.ply').is_dir()
    again = refine_job(a_job(out, iterations=1))
    first, second = metrics['metrics'], again['metrics']
    assert second['refine_loss_before']['value'] < 0.8 * first['refine_loss_before']['value']


def test_scores_are_of_frames_that_were_no_keyframes(finished):
    metrics = refine_job(a_job(finished, recording=finished, iterations=100))
    before, after = metrics['metrics_before'], metrics['metrics']
    assert before['views_scored']['value'] == after['views_scored']['value'] == 3
    assert after['psnr']['value'] > before['psnr']['value'] + 0.5
    assert metrics['sequence'] == 'wall'
    assert (finished / 'refined' / 'tiles.png').is_file()


def test_nothing_left_to_test_with_is_said(finished, monkeypatch):
    only = [a_keyframe(i).frame for i in range(3)]
    sequence = Recording()
    monkeypatch.setattr(Recording, '__iter__', lambda self: iter(only))
    write_trajectory(
        finished / 'trajectory.txt',
        Trajectory(tuple(StampedPose(f.stamp_ns, np.eye(4)) for f in only)),
    )
    monkeypatch.setattr(layouts, 'open_sequence', lambda *_, **__: sequence)
    with pytest.raises(EvaluationError, match=r'all 3 frames .* were keyframes'):
        refine_job(a_job(finished, recording=finished))


def test_the_same_seed_gives_the_same_map():
    maps = []
    for _ in range(2):
        mapper = mapped()
        refine_map(mapper, CONFIG.mapping, None, 10)
        maps.append(mapper.map)
    np.testing.assert_array_equal(maps[0].means, maps[1].means)


def test_the_commands(finished, capsys):
    setting = ['--set', 'mapping.threads=1']
    assert main.main(['refine', str(finished), '--iterations', '5', *setting]) == 0
    assert 'refine_loss_after' in capsys.readouterr().out
    refined = str(finished / 'refined' / 'map.ply')
    assert main.main(['export', refined, str(finished / 'view.ply'), '--plain']) == 0
    assert 'Gaussians in' in capsys.readouterr().out
    assert b'p_dynamic' not in (finished / 'view.ply').read_bytes()
    assert main.main(['refine', str(finished / 'nowhere')]) == 2
    assert 'cannot be read: No such file' in capsys.readouterr().err


@pytest.mark.parametrize('extra', [['--localise'], ['--start-pose', '0 0 0 0 0 0 1']])
def test_options_of_a_map_need_a_map(tmp_path, capsys, extra):
    assert main.main(['run', str(tmp_path), '--output', str(tmp_path), *extra]) == 2
    assert 'need a map: add --map FILE' in capsys.readouterr().err


@pytest.mark.parametrize(
    'text', ['', '1 2 3', 'a b c d e f g', '0 0 0 0 0 0 0', '0 0 nan 0 0 0 1']
)
def test_a_start_pose_is_seven_numbers(tmp_path, capsys, text):
    command = ['run', str(tmp_path), '--output', str(tmp_path), '--map', 'x.ply']
    assert main.main([*command, '--start-pose', text]) == 2
    assert "expects 'x y z qx qy qz qw'" in capsys.readouterr().err


def twice(frame):
    """A pose far from where the camera was seen is believed once a second frame says the same."""
    return frame, replace(frame, stamp_ns=frame.stamp_ns + 33_000_000)


def test_a_loaded_map_is_the_start_of_a_run(finished):
    from bdgs_ros.core.types import TrackingStatus
    from bdgs_ros.pipeline import BdgsSlam

    slam = BdgsSlam(CONFIG)
    slam.start_from(finished / 'map.ply', CAMERA, se3.exp(np.array([0.02, 0, 0, 0, 0.01, 0])))
    unsure, result = (slam.process(frame) for frame in twice(a_keyframe(1).frame))
    assert unsure.tracking.status is TrackingStatus.LOST
    assert result.tracking.status is TrackingStatus.OK
    assert result.tracking.is_keyframe
    T_error = se3.inverse(a_keyframe(1).T_world_camera) @ result.tracking.T_world_camera
    assert np.linalg.norm(T_error[:3, 3]) < 0.02
    assert len(slam.mapper.keyframes) == 4
    away = se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))
    with pytest.raises(MapError, match=r'covers \d % of the view.*another start pose'):
        slam.start_from(finished / 'map.ply', CAMERA, away)


def test_a_view_that_fits_nowhere_is_lost(finished):
    from bdgs_ros.core.types import RgbdFrame, TrackingStatus
    from bdgs_ros.pipeline import BdgsSlam

    slam = BdgsSlam(CONFIG)
    slam.start_from(finished / 'map.ply', CAMERA, localise=True)
    noise = np.random.default_rng(0).integers(0, 255, (*CAMERA.shape, 3), np.uint8)
    depth = np.full(CAMERA.shape, 0.5, np.float32)
    covered = RgbdFrame(5, noise, depth, CAMERA)
    assert slam.process(covered).tracking.status is TrackingStatus.LOST
    _, found = (slam.process(frame) for frame in twice(a_keyframe(0).frame))
    assert found.tracking.status is TrackingStatus.OK
    assert len(slam.mapper.keyframes) == 3
    assert isinstance(slam.mapper, Mapper)
