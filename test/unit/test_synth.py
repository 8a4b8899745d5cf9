from __future__ import annotations

import argparse
import itertools
import json
from pathlib import Path

import cv2
import numpy as np
import pytest

from bdgs_ros.cli import synth
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.camera_file import read_camera_file
from bdgs_ros.data.layouts import open_sequence
from bdgs_ros.data.synth import SynthTruth, room, scenarios, write_recording, writer
from bdgs_ros.data.synth.raster import SampleGrid
from bdgs_ros.data.synth.render import FrameRenderer, draw
from bdgs_ros.data.synth.scenarios import make_world
from bdgs_ros.data.synth.sensor import (
    ColorSensor,
    DepthSensor,
    auto_exposure,
    sense_color,
    sense_depth,
)
from bdgs_ros.data.synth.truth import parse_stamp, stamp_text

SIZE = (160, 120)
CAMERA = PinholeCamera(160, 120, 133.85, 134.8, 79.65, 61.525)


@pytest.fixture(autouse=True)
def coarse_textures(monkeypatch):
    """Make worlds faster by painting with few texels."""
    monkeypatch.setattr(room, 'WALL_DENSITY', 60.0)
    monkeypatch.setattr(room, 'FURNITURE_DENSITY', 100.0)
    monkeypatch.setattr(room, 'PRINT_DENSITY', 120.0)


@pytest.fixture(scope='module')
def box_recording(tmp_path_factory) -> Path:
    """Five seconds of the carried box at 2 Hz, which tell its whole story."""
    folder = tmp_path_factory.mktemp('synth') / 'box'
    write_recording(folder, 'unknown_box', 2, 10, size=SIZE, rate_hz=2.0, jobs=1)
    return folder


def read(path: Path):
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    assert image is not None, path
    return image


def files_of(folder: Path) -> dict[str, bytes]:
    return {str(p.relative_to(folder)): p.read_bytes() for p in folder.rglob('*') if p.is_file()}


def coverage(name: str, seed: int, times, duration_s: float = 10.0):
    world = make_world(name, seed, duration_s)
    renderer = FrameRenderer(world, CAMERA, 0.0)
    grid, shares = SampleGrid.of(CAMERA), []
    for t in times:
        surfaces = world.scene.surfaces(t)
        seen = draw(renderer._view(surfaces, t), grid)
        ids = np.concatenate([surfaces.quads.object_id, surfaces.quadrics.object_id])
        assert (seen.surface >= 0).all(), 'the room is closed'
        shares.append(np.isin(ids[seen.surface], world.scene.moving_ids(t)).mean())
    return np.array(shares)


def test_layout_is_tum_with_camera_and_truth(box_recording):
    rows = [r.split() for r in (box_recording / 'rgb.txt').read_text().splitlines()]
    rows = [r for r in rows if r[0] != '#']
    assert len(rows) == 10
    stamps = [parse_stamp(r[0]) for r in rows]
    assert np.all(np.diff(stamps) == 500_000_000)
    for _, name in rows:
        color, depth = (
            read(box_recording / name),
            read(box_recording / name.replace('rgb', 'depth')),
        )
        assert color.shape == (120, 160, 3) and color.dtype == np.uint8
        assert depth.shape == (120, 160) and depth.dtype == np.uint16
    recorded = read_camera_file(box_recording / 'camera.yaml')
    assert recorded.camera.shape == (120, 160) and recorded.camera.is_rectified
    assert recorded.camera.fx == pytest.approx(535.4 / 4) and recorded.depth_scale == 5000
    ground_truth = np.loadtxt(box_recording / 'groundtruth.txt')
    assert ground_truth.shape == (10, 8)
    np.testing.assert_allclose(ground_truth[:, 0] * 1e9, stamps, atol=1e3)


def test_truth_reads_what_was_written(box_recording):
    truth = SynthTruth(box_recording)
    stamp = int(truth.stamps_ns[3])
    assert truth.dynamic(stamp).dtype == bool and truth.dynamic(stamp).shape == (120, 160)
    assert truth.static_color(stamp).shape == (120, 160, 3)
    depth = truth.static_depth(stamp)
    assert depth.dtype == np.float32 and 0.5 < depth.min() < depth.max() < 9.0
    assert truth.exposure(int(truth.stamps_ns[0])) == 1.0
    assert len(truth.trajectory()) == 10
    assert truth.exposure(stamp + 400) == truth.exposure(stamp), 'stamps through floats are found'
    with pytest.raises(DatasetError, match='nearest frame'):
        truth.dynamic(stamp + 10**8)
    with pytest.raises(DatasetError, match='bdgs synth'):
        SynthTruth(box_recording / 'rgb')


def test_recorded_colour_is_static_colour_times_exposure_where_nothing_moves(box_recording):
    truth = SynthTruth(box_recording)
    for stamp in truth.stamps_ns[[0, 4, 6]]:
        recorded = read(box_recording / f'rgb/{stamp_text(int(stamp))}.png')[..., ::-1]
        expected = truth.static_color(int(stamp)) * truth.exposure(int(stamp))
        still = ~cv2.dilate(truth.dynamic(int(stamp)).astype(np.uint8), np.ones((5, 5))).astype(
            bool
        )
        still &= (expected < 235).all(axis=-1)
        error = recorded[still].astype(float) - expected[still]
        assert abs(np.median(error)) < 1.0
        assert 1.48 * np.median(np.abs(error)) < 5.0


def test_static_depth_of_one_frame_reprojects_onto_another(tmp_path):
    world = make_world('static', 5, 10.0)
    renderer = FrameRenderer(world, CAMERA, 0.0)
    times = (0.0, 3.4)
    views = [renderer.render(t) for t in times]
    poses = [world.camera_path.pose(t) for t in times]
    assert np.linalg.norm(poses[1][:3, 3] - poses[0][:3, 3]) > 0.05
    points = CAMERA.unproject(views[0].static_depth_m).reshape(-1, 3)
    T = se3.inverse(poses[1]) @ poses[0]
    moved = points @ T[:3, :3].T + T[:3, 3]
    uv = np.rint(CAMERA.project(moved)).astype(int)
    inside = ((uv >= 0) & (uv < SIZE)).all(axis=1)
    seen = views[1].static_depth_m[uv[inside, 1], uv[inside, 0]]
    error = np.abs(seen - moved[inside, 2])
    assert np.mean(error < 0.03) > 0.85, 'all but edges and what came to be hidden'
    color = [v.static_color.reshape(-1, 3) for v in views]
    landed = color[1].reshape(120, 160, 3)[uv[inside, 1], uv[inside, 0]]
    same = error < 0.03
    difference = np.abs(landed - color[0][inside])[same].mean(axis=1)
    assert np.median(difference) < 6.0, 'appearance does not change with the view'


def test_depth_of_planes_is_exact():
    world = make_world('static', 0, 10.0)
    renderer = FrameRenderer(world, CAMERA, 0.0)
    depth, pose = renderer.render(0.0).depth_m, world.camera_path.pose(0.0)
    points = CAMERA.unproject(depth).reshape(-1, 3) @ pose[:3, :3].T + pose[:3, 3]
    room = next(o for o in world.scene.objects if o.kind == 'room')
    end = np.max([q.origin for q in room.quads], axis=0)
    on_floor = np.abs(points[:, 2]) < 2e-4
    on_back = np.abs(points[:, 0] - end[0]) < 2e-4
    assert on_floor.sum() > 500 and on_back.sum() > 500
    assert points.min() > -1e-3 and (points < end + 1e-3).all()


def test_pixels_that_see_nothing_dynamic_see_the_static_world():
    world = make_world('walking_xyz', 1, 10.0)
    images = FrameRenderer(world, CAMERA, 0.0).render(2.0)
    dynamic = np.isin(images.object_id, world.scene.moving_ids(2.0))
    assert 0.02 < dynamic.mean() < 0.9
    np.testing.assert_array_equal(images.depth_m[~dynamic], images.static_depth_m[~dynamic])
    assert (images.depth_m[dynamic] < images.static_depth_m[dynamic]).all()
    inner = cv2.erode(dynamic.astype(np.uint8), np.ones((3, 3))).astype(bool)
    outer = ~cv2.dilate(dynamic.astype(np.uint8), np.ones((3, 3))).astype(bool)
    difference = np.abs(images.color - images.static_color).max(axis=-1)
    assert np.mean(difference[outer] > 0) < 1e-3, 'all but slivers between pixel centres'
    assert np.mean(difference[inner] > 8) > 0.8


def test_box_is_static_at_rest_dynamic_in_hands_and_labelled(box_recording):
    truth = SynthTruth(box_recording)
    box = next(o for o in truth.objects if o.kind == 'box')
    assert box.is_mover and len(box.moving_s) == 2 and box.poses.shape == (10, 4, 4)
    resting = [
        k
        for k, s in enumerate(truth.stamps_ns)
        if not any(a <= s * 1e-9 < b for a, b in box.moving_s)
    ]
    assert 3 <= len(resting) <= 7
    assert np.ptp(box.poses[resting], axis=0).max() < 1e-9
    seen = 0
    for k, stamp in enumerate(truth.stamps_ns):
        where = truth.object_id(int(stamp)) == box.object_id
        assert (truth.dynamic(int(stamp))[where] == (k not in resting)).all()
        assert truth.movers(int(stamp))[where].all()
        seen += int(where.sum() > 20)
    assert seen >= 4


def test_chair_rests_moves_and_rests_elsewhere():
    world = make_world('chair_moved', 3, 10.0)
    chair = next(o for o in world.scene.objects if o.name == 'moved_chair')
    assert [chair.is_moving(t) for t in (0.0, 4.0, 5.0, 6.5)] == [False, False, True, False]
    before, after = chair.T_world_object(0.0), chair.T_world_object(9.0)
    np.testing.assert_array_equal(before, chair.T_world_object(4.2))
    np.testing.assert_allclose(after, chair.T_world_object(6.1))
    assert 0.8 < np.linalg.norm(after[:3, 3] - before[:3, 3]) < 1.1
    way = [chair.T_world_object(t)[:2, 3] for t in np.arange(4.2, 6.2, 1 / 30)]
    assert np.linalg.norm(np.diff(way, axis=0), axis=1).max() < 0.05, 'no jump'


@pytest.mark.parametrize('name', [n for n in scenarios() if n.startswith('walking')])
def test_walking_scenarios_have_walkers_and_a_ball(name):
    kinds = [o.kind for o in make_world(name, 0, 10.0).scene.objects if o.is_mover]
    assert kinds.count('person') == 2 and kinds.count('ball') == 1
    shares = coverage(name, 0, np.arange(0, 10, 1.0))
    assert shares.max() > 0.05 and shares.mean() > 0.01


def test_static_has_no_movers():
    assert not any(o.is_mover for o in make_world('static', 0, 10.0).scene.objects)
    assert coverage('static', 0, [0.0, 5.0]).max() == 0.0


@pytest.mark.parametrize('seed', [0, 1])
def test_crowd_is_thin_first_and_then_covers_nearly_everything(seed):
    shares = coverage('crowd', seed, np.arange(0, 10, 0.2))
    assert shares[:15].max() < 0.5
    assert 0.7 < shares.max() < 0.97


@pytest.mark.parametrize('name', scenarios())
def test_camera_rests_then_moves_at_the_speed_of_a_hand(name):
    path = make_world(name, 1, 10.0).camera_path
    np.testing.assert_allclose(path.pose(0.0), path.pose(0.25), atol=1e-12)
    poses = [path.pose(t) for t in np.arange(0, 10, 1 / 30)]
    steps = [se3.log(se3.inverse(a) @ b) * 30 for a, b in itertools.pairwise(poses)]
    speed = np.linalg.norm(np.array(steps)[:, :3], axis=1)
    turn = np.degrees(np.linalg.norm(np.array(steps)[:, 3:], axis=1))
    assert speed.max() < 0.7 and turn.max() < 45
    assert speed.max() > 0.02 or turn.max() > 1
    jerks = np.linalg.norm(np.diff(steps, axis=0), axis=1)
    assert jerks.max() < 0.15, 'smooth'


def test_same_plan_same_files_whatever_the_number_of_processes(tmp_path, monkeypatch):
    monkeypatch.undo()  # textures of other processes are not coarse
    made = {}
    for name, seed, jobs in (('a', 4, 1), ('b', 4, 2), ('c', 5, 1)):
        write_recording(
            tmp_path / name, 'walking_rpy', seed, 5, size=(64, 48), rate_hz=3.0, jobs=jobs
        )
        made[name] = files_of(tmp_path / name)
    assert made['a'] == made['b']
    assert made['a'].keys() == made['c'].keys()
    assert made['a']['rgb/1000.000000.png'] != made['c']['rgb/1000.000000.png']


def test_folder_appears_only_when_complete(tmp_path, monkeypatch):
    def fail(self, frame, gain):
        if frame == 1:
            raise KeyboardInterrupt
        return original(self, frame, gain)

    original = writer.FrameWorker.write
    monkeypatch.setattr(writer.FrameWorker, 'write', fail)
    with pytest.raises(KeyboardInterrupt):
        write_recording(tmp_path / 'new', 'static', 0, 3, size=(64, 48), jobs=1)
    assert list(tmp_path.iterdir()) == []


def test_only_recordings_are_replaced_and_only_when_told(tmp_path):
    small = {'size': (64, 48), 'jobs': 1}
    folder = tmp_path / 'rec'
    write_recording(folder, 'static', 0, 1, **small)
    with pytest.raises(DatasetError, match='--force'):
        write_recording(folder, 'static', 1, 1, **small)
    write_recording(folder, 'static', 1, 2, force=True, **small)
    assert SynthTruth(folder).description['seed'] == 1
    other = tmp_path / 'other'
    other.mkdir()
    (other / 'thesis.tex').write_text('years of work')
    with pytest.raises(DatasetError, match='not replaced'):
        write_recording(other, 'static', 0, 1, force=True, **small)
    assert sorted(p.name for p in tmp_path.iterdir()) == ['other', 'rec']


@pytest.mark.parametrize(
    ('change', 'message'),
    [
        ({'scenario': 'dance'}, 'walking_xyz'),
        ({'frames': 0}, 'at least 1 frame'),
        ({'size': (8, 8)}, '32 to 4096'),
        ({'rate_hz': 0.0}, 'rate'),
    ],
)
def test_impossible_plans_are_refused(tmp_path, change, message):
    plan = {'scenario': 'static', 'seed': 0, 'frames': 1, **change}
    with pytest.raises(DatasetError, match=message):
        write_recording(tmp_path / 'x', **plan)
    assert not (tmp_path / 'x').exists()


def test_depth_noise_grows_as_the_model_says_and_near_things_throw_shadows():
    camera = PinholeCamera(640, 480, 535.4, 539.2, 320.1, 247.6)
    rng = np.random.default_rng(0)
    for z in (1.0, 2.5):
        measured = sense_depth(np.full((480, 640), z, np.float32), camera, DepthSensor(), rng)
        good = measured[measured > 0] / 5000
        sigma = 0.0012 + 0.0019 * (z - 0.4) ** 2
        quantised = z * z / (0.075 * 535.4 * 8) / np.sqrt(12)
        assert 0.97 < len(good) / measured.size < 1.0
        assert np.std(good) == pytest.approx(np.hypot(sigma, quantised), rel=0.15)
        assert abs(np.mean(good) - z) < 0.005
    scene = np.full((480, 640), 3.0, np.float32)
    scene[:, 300:340] = 1.0
    holes = sense_depth(scene, camera, DepthSensor(), rng) == 0
    width = 535.4 * 0.075 * (1 - 1 / 3)
    assert holes[:, 300 - int(width) + 3 : 297].mean() > 0.95
    assert holes[:, 345:400].mean() < 0.05
    for lost in (0.3, 9.0):
        empty = sense_depth(np.full((480, 640), lost, np.float32), camera, DepthSensor(), rng)
        assert not empty.any()


def test_exposure_answers_slowly_and_within_its_limits():
    brightness = np.array([100.0] * 10 + [20.0] * 90)
    gains = auto_exposure(brightness, 1 / 30, ColorSensor())
    assert (gains[:11] == 1.0).all()
    assert np.abs(np.diff(gains)).max() < 0.03
    assert gains[-1] == pytest.approx(ColorSensor().gain_limits[1], abs=0.02)
    light = np.full((40, 40, 3), 100.0, np.float32)
    recorded = sense_color(light, 1.2, ColorSensor(), np.random.default_rng(0))
    assert recorded.mean() == pytest.approx(120, abs=0.5) and 1.0 < recorded.std() < 3.0


def test_motion_blurs_the_record_and_not_the_truth():
    world = make_world('walking_rpy', 1, 10.0)
    camera = PinholeCamera(320, 240, 267.7, 269.6, 159.8, 123.55)
    sharp = FrameRenderer(world, camera, 0.0).render(3.0)
    blurred = FrameRenderer(world, camera, 0.03).render(3.0)
    np.testing.assert_array_equal(sharp.static_color, blurred.static_color)

    def detail(image):
        return float(np.abs(cv2.Laplacian(image, cv2.CV_32F)).mean())

    assert detail(blurred.color) < 0.93 * detail(sharp.color)


def test_command_prints_one_line_or_json(tmp_path, capsys):
    parser = argparse.ArgumentParser()
    synth.add_arguments(parser)
    common = ['--scenario', 'static', '--frames', '2', '--size', '64x48', '--jobs', '1']
    assert synth.run(parser.parse_args([str(tmp_path / 'a'), *common])) == 0
    assert 'static, seed 0, 2 frames' in capsys.readouterr().out
    assert synth.run(parser.parse_args([str(tmp_path / 'b'), *common, '--json'])) == 0
    summary = json.loads(capsys.readouterr().out)
    assert summary['frames'] == 2 and summary['max_coverage'] == 0.0
    with pytest.raises(SystemExit):
        parser.parse_args([str(tmp_path / 'c'), '--scenario', 'static', '--size', 'big'])


def test_a_hall_is_the_room_at_four_times_its_size(tmp_path):
    """Images are those of the room; what counts metres says four times as many."""
    made = {}
    for name in ('hall', 'static'):
        write_recording(tmp_path / name, name, 1, 8, size=(64, 48), rate_hz=4.0, jobs=1)
        sequence = open_sequence(tmp_path / name)
        truth = SynthTruth(tmp_path / name)
        made[name] = (
            np.median(sequence[0].depth_m),
            np.median(truth.static_depth(truth.stamps_ns[0])),
            np.linalg.norm(np.ptp(sequence.ground_truth.positions, axis=0)),
        )
    depth, static, _ = np.array(made['hall']) / made['static']
    assert depth == pytest.approx(4.0, rel=0.1) and static == pytest.approx(4.0, rel=0.1)
    assert made['hall'][2] > 2 * made['static'][2]


def test_field_scenarios_tell_their_stories(tmp_path):
    before, after = coverage('crowded_start', 0, [1.0, 8.0])
    assert before > 0.7 and after < 0.05
    resting, swinging = coverage('door', 0, [2.0, 5.7])
    assert resting == 0 and swinging > 0.15
    summary = write_recording(tmp_path / 'slow', 'low_rate', 0, 3, size=(64, 48), jobs=1)
    assert summary.duration_s == pytest.approx(0.6)
    board = write_recording(tmp_path / 'board', 'blank_start', 0, 2, size=(64, 48), jobs=1)
    grey = open_sequence(tmp_path / 'board')[0].color.mean(axis=2)
    assert board.mean_coverage == 0 and np.std(grey) < 12
