"""Bench `mapping`: which frames are scored, on which pixels, and what a long run amounts to."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace

import numpy as np
import pytest
from run_fakes import FakeMapper, FakeSequence, FakeSlam, FakeTruth

from bdgs_ros.bench import long_run, map_quality, mapping, sequences
from bdgs_ros.bench.harness import Cell, Options, to_markdown
from bdgs_ros.core import se3
from bdgs_ros.core.types import Detection, Labels, StampedPose, TrackingStatus, Trajectory
from bdgs_ros.data.synth import write_recording
from bdgs_ros.eval.recorder import FrameRow, Recorder
from bdgs_ros.runner import run_sequence


class Labelling:
    """Labels nothing, and finds a person in the left of the image."""

    def process(self, frame):
        person = Detection((2.0, 3.0, 9.0, 20.0), 0.9, 0, 'person', 0.9)
        chair = Detection((20.0, 3.0, 30.0, 20.0), 0.9, 56, 'chair', 0.2)
        return Labels(frame.stamp_ns, np.zeros(frame.camera.shape, np.uint8), (person, chair))


@pytest.fixture
def watched():
    sequence, slam = FakeSequence(60), FakeSlam(lost=(6, 7))
    slam.detection = map_quality.LastLabels(Labelling())
    watch = map_quality.LiveScores(slam.mapper, slam.detection, map_quality.Scorer())
    result = run_sequence(sequence, slam, [watch], Recorder(max_samples=0))
    return sequence, watch, result


def test_every_fifth_frame_between_keyframes_is_scored_every_tenth_live(watched):
    _, watch, result = watched
    between = [
        i
        for i, row in enumerate(result.rows)
        if not row.is_keyframe and row.status is TrackingStatus.OK
    ]
    assert [frame.index for frame in watch.frames] == between[::5]
    assert len(watch.live) == len(between[::10])
    assert result.samples == ()


def test_frames_are_read_and_scored_again_with_the_masks_of_the_run(watched):
    sequence, watch, _ = watched
    after = map_quality.score_after(watch.frames, sequence, FakeMapper(), watch.scorer)
    assert after.per_frame[::2] == watch.live  # the same map, the same frames
    assert len(after.pictured) == 4
    row = map_quality.columns('after', after.per_frame)
    assert row['after_views'] == len(watch.frames)
    # the mover, 8 x 10 pixels of 32 x 24, is called dynamic and left out
    assert row['after_psnr_db'] == pytest.approx(40.0, abs=0.1)
    assert row['after_counted_percent'] == pytest.approx(100 * (1 - 80 / 768), abs=0.1)
    # the boxes do not know of it: the map has no say in that mask
    assert row['after_psnr_boxes_db'] < 25
    assert 'after_psnr_hidden_db' not in row


def test_with_truth_every_pixel_counts(watched):
    sequence, watch, _ = watched
    scorer = map_quality.Scorer(FakeTruth(), lambda image, truth, valid: 0.25)
    after = map_quality.score_after(watch.frames, sequence, FakeMapper(), scorer)
    row = map_quality.columns('after', after.per_frame)
    assert row['after_psnr_hidden_db'] == pytest.approx(40.0, abs=0.1)
    assert row['after_lpips'] == 0.25
    assert 'after_psnr_boxes_db' not in row


def test_whole_boxes_of_movers_and_a_margin_of_labels_are_left_out():
    labels = Labelling().process(FakeSequence(1)[0])
    mask = map_quality.near_detections(labels)
    expected = np.zeros_like(mask)
    expected[3:21, 2:10] = True
    assert np.array_equal(mask, expected)
    spot = np.zeros(mask.shape, np.uint8)
    spot[12, 20] = 200
    grown = map_quality.near_detections(replace(labels, p_dynamic=spot, detections=()))
    assert grown.sum() == 15 * 15


def rows_of(times):
    return [
        FrameRow(i, TrackingStatus.OK, np.eye(4), t is not None, 1.0, 1.0,
                 {'tracking': 10.0, **({} if t is None else {'mapping': t})})
        for i, t in enumerate(times)
    ]  # fmt: skip


def test_the_timed_mapper_learns_what_the_back_end_says():
    mapper = SimpleNamespace(readout_s=0.0)
    long_run.CpuTimed(mapper).readout_s = 0.027
    assert mapper.readout_s == 0.027


def test_growth_is_over_the_second_block():
    times = [100.0, None, 200.0, None, 210.0, 190.0, 220.0, None, 240.0]
    mapper = long_run.CpuTimed(SimpleNamespace(map=[0] * 7, process=lambda keyframe: keyframe))
    watch = long_run.BlockWatch(mapper, 2)
    for time_ms in times:
        if time_ms is not None:
            assert mapper.process(time_ms) == time_ms
        watch(None, SimpleNamespace(is_keyframe=time_ms is not None))
    watch.finish()
    mapper.cpu_ms = [1.0, 2.0, 2.0, 2.0, 3.0, 2.0]
    scored = [{'psnr': 20.0, 'seen': 90.0}, {'psnr': 22.0, 'seen': 94.0}]
    quality = SimpleNamespace(live=scored, live_at=[2, 3])
    found = long_run.columns(rows_of(times), watch, quality)
    assert found['block_live_psnr_db'] == [None, 21.0, None, None, None]
    assert found['block_mapping_cpu_ms'] == [1.0, 2.0, 2.0, 3.0, 2.0]
    assert found['cpu_growth'] == pytest.approx(1.5)
    assert found['block_mapping_ms'] == [100.0, 200.0, 200.0, 220.0, 240.0]
    assert found['block_keyframes'] == [1, 1, 2, 1, 1]
    assert found['block_gaussians'] == [7] * 5
    assert len(found['block_peak_mb']) == 5
    assert found['last_over_second'] == found['growth'] == pytest.approx(1.2)


def test_all_adds_scenarios_and_a_loop(tmp_path):
    options = Options(tmp_path, tmp_path)
    names = [cell.sequence for cell in mapping.cells(options)]
    assert names == [
        'bonn_crowd_part', 'fr1_rpy_part', 'synth_static', 'synth_walking_xyz',
        'loop_bonn_crowd_part',
    ]  # fmt: skip
    everything = [c.sequence for c in mapping.cells(replace(options, all_cells=True))]
    assert set(names) < set(everything)
    assert everything[-1].startswith('loop_synth_')
    # another time of refinement is another measurement
    keys = {c.key for c in mapping.cells(replace(options, refine_s=5.0))}
    assert keys.isdisjoint(c.key for c in mapping.cells(options)[:4])


@pytest.fixture(scope='module')
def recording(tmp_path_factory):
    folder = tmp_path_factory.mktemp('synth') / 'walking_xyz'
    write_recording(folder, 'walking_xyz', 3, 16, size=(160, 120), jobs=1)
    return folder


def test_rows_of_a_short_run(recording, tmp_path, monkeypatch):
    monkeypatch.setattr(sequences, 'cell_recording', lambda cell, options: recording)
    values = {'mapping.iterations': 4, 'mapping.width': 80, 'mapping.threads': 1}
    values['tracking.keyframe.max_interval'] = 4
    options = Options(tmp_path, tmp_path, values=values)
    settings = {'kind': 'synth', 'frames': 16, 'refine_s': 0.3}
    cell = Cell('synth_walking_xyz', 'geometric', 0, settings)
    quality = mapping.run_cell(cell, options)
    assert quality['frames'] == 16
    assert quality['live_views'] == 2
    assert quality['after_views'] == 3
    assert 5 < quality['after_psnr_db'] < 60
    assert quality['refined_views'] == 3
    assert quality['refine_iterations'] > 3
    assert quality['refined_psnr_db'] > quality['after_psnr_db']
    for name in ('after.png', 'refined.png', 'map.ply', 'refined/map.ply', 'trajectory.txt'):
        assert (tmp_path / 'runs' / cell.key / name).is_file()
    looped = Cell('loop_synth_walking_xyz', 'geometric', 0, {**settings, 'frames_run': 24})
    row = mapping.run_cell(looped, options)
    assert row['frames'] == 24
    assert len(row['block_mapping_ms']) == 6
    assert row['ate_rmse_cm'] < 5
    assert row['block_live_seen_percent'][0] > 50
    summary = mapping.summarise(
        [
            {'sequence': 'x', 'seed': 0, **quality},
            {'sequence': 'loop_x', 'seed': 0, **row},
        ]
    )
    assert summary['x_after_psnr_db'] == quality['after_psnr_db']
    assert summary['long_run_growth_max'] == row['growth']


def test_tables_have_the_rows_that_have_their_columns():
    row = {'configuration': 'w', 'seed': 0}
    results = {
        'bench': 'mapping', 'protocol': '', 'quick': False, 'commits': [], 'summary': {},
        'provenance': {'machine': {'processor': 'p', 'cores': 1, 'python': '3'}},
        'rows': [
            {'sequence': 'a', **row, 'psnr': 20.0},
            {'sequence': 'b', **row, 'blocks': [1.0, 2.5]},
            {'sequence': 'c', **row, 'error': 'no such recording'},
        ],
        'tables': {'Quality': ['psnr', 'absent'], 'Long': ['blocks']},
    }  # fmt: skip
    quality, long = to_markdown(results).split('## Long')
    assert '| a | w | 0 | 20 | - |' in quality
    assert '| b |' not in quality
    assert 'absent' not in quality
    assert '| b | w | 0 | 1 / 2.5 | - |' in long
    assert quality.count('no such recording') == long.count('no such recording') == 1


def test_drift_is_what_the_first_block_does_not_explain():
    true = [
        StampedPose(i * 33_000_000, se3.exp(np.array([np.sin(i), np.cos(i), 0.1 * i, 0, 0, 0])))
        for i in range(12)
    ]
    moved = se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))
    aside = se3.exp(np.array([0.03, 0.0, 0.0, 0.0, 0.0, 0.0]))
    drifted = [
        StampedPose(p.stamp_ns, moved @ (aside if i >= 6 else np.eye(4)) @ p.T_world_camera)
        for i, p in enumerate(true)
    ]
    found = long_run.drift_cm(Trajectory(tuple(true)), Trajectory(tuple(drifted)), 6)
    assert found == pytest.approx([0.0, 3.0], abs=0.02)
