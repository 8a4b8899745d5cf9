"""The one-page report and the pictures in it."""

from __future__ import annotations

import base64

import cv2
import numpy as np
import pytest
from run_fakes import FakeSequence, FakeSlam

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.eval import pictures, plots, scores
from bdgs_ros.eval.metric import Metric
from bdgs_ros.eval.report import Picture, Report, Row, write_report
from bdgs_ros.eval.trajectory import ate
from bdgs_ros.runner import run_sequence


@pytest.fixture
def views():
    slam = FakeSlam()
    result = run_sequence(FakeSequence(10), slam)
    return scores.render_samples(result.samples, slam.mapper)


def test_report_is_self_contained_and_escaped(tmp_path):
    picture = tmp_path / 'a.png'
    cv2.imwrite(str(picture), np.zeros((2, 2, 3), np.uint8))
    report = Report(
        'a <title>',
        'lead',
        [Row('error & more', Metric('ate', float('nan'), 'cm')), Row('n', Metric('n', 1.23456))],
        [Picture(picture, 'black'), Picture(tmp_path / 'absent.png', 'not made')],
        {'command': 'a < b'},
    )
    write_report(tmp_path / 'report.html', report)
    text = (tmp_path / 'report.html').read_text()
    assert base64.b64encode(picture.read_bytes()).decode() in text
    assert '<h1>a &lt;title&gt;</h1>' in text
    assert 'error &amp; more' in text
    assert '>-</td><td>cm' in text
    assert '1.235' in text
    assert 'a &lt; b' in text
    assert 'not made' not in text


def test_tiles_show_input_overlay_and_render(tmp_path, views):
    path = tmp_path / 'tiles.png'
    pictures.write_tiles(path, views, rows=3, width=32)
    image = cv2.cvtColor(cv2.imread(str(path)), cv2.COLOR_BGR2RGB).astype(int)
    assert image.shape == (26 + 3 * 24 + 2 * 4, 3 * 32 + 2 * 4, 3)
    first = views[0]
    row = image[26 : 26 + 24]
    assert np.array_equal(row[:, :32], first.sample.frame.color)
    red = row[:, 36:68, 0] - row[:, 36:68, 2]
    moving = first.sample.p_dynamic > 0
    assert red[moving].min() > 50 > np.abs(red[~moving]).max()
    assert np.abs(row[:, 72:] - np.clip(first.color * 255, 0, 255)).max() <= 1


def test_animation_has_a_frame_per_view(tmp_path, views):
    from PIL import Image

    path = tmp_path / 'a.gif'
    pictures.write_animation(path, views, width=32)
    with Image.open(path) as image:
        assert image.n_frames == len(views) == 10


def test_no_views_is_an_error(tmp_path):
    with pytest.raises(EvaluationError, match='no frame with a pose'):
        pictures.write_tiles(tmp_path / 'a.png', [])
    assert not list(tmp_path.iterdir())


def test_plot_is_drawn_with_and_without_truth(tmp_path):
    sequence = FakeSequence(30)
    gt = sequence.ground_truth
    est = run_sequence(sequence, FakeSlam()).trajectory
    plots.plot_trajectory(tmp_path / 'a.png', est)
    plots.plot_trajectory(tmp_path / 'b.png', est, gt, ate(gt, est), 'with truth')
    narrow, wide = (cv2.imread(str(tmp_path / n)).shape[1] for n in ('a.png', 'b.png'))
    assert wide > 1.5 * narrow
