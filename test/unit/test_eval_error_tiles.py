"""Error pictures and the peak of memory."""

from __future__ import annotations

import cv2
import numpy as np
import pytest
from run_fakes import CAMERA, FakeMapper, FakeSequence, FakeTruth

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.eval import memory
from bdgs_ros.eval.error_tiles import write_error_tiles
from bdgs_ros.eval.recorder import Sample
from bdgs_ros.eval.scores import render_view


@pytest.fixture
def views():
    sequence = FakeSequence(2)
    called = np.zeros(CAMERA.shape, np.uint8)
    called[:4, :4] = 255
    return [
        render_view(Sample(sequence[i], np.eye(4), called, False), FakeMapper()) for i in range(2)
    ]


def test_a_row_has_input_render_error_depth(tmp_path, views):
    write_error_tiles(tmp_path / 'a.png', views, width=32)
    image = cv2.imread(str(tmp_path / 'a.png'))
    assert image.shape == (2 * 24 + 4, 4 * 32 + 3 * 4, 3)
    assert np.array_equal(image[:24, :32, ::-1], views[0].sample.frame.color)
    error = image[:24, 72:104]
    assert np.all(error[:4, :4] == 90)  # called dynamic: not scored
    mover = np.zeros(CAMERA.shape, bool)
    mover[5:15, :8] = True
    assert error[mover].mean() > error[~mover].mean() + 20


def test_with_truth_the_mover_is_no_error(tmp_path, views):
    write_error_tiles(tmp_path / 'a.png', views, FakeTruth(), width=32)
    error = cv2.imread(str(tmp_path / 'a.png'))[:24, 72:104]
    assert error.std(axis=(0, 1)).max() < 3  # one error everywhere


def test_nothing_to_picture_is_said(tmp_path):
    with pytest.raises(EvaluationError, match='no view'):
        write_error_tiles(tmp_path / 'a.png', [])


def test_peak_of_memory_sees_an_allocation():
    if not memory.restart_peak():
        pytest.skip('this system cannot forget the peak of earlier tests')
    before = memory.peak_mb()
    block = np.ones(30_000_000)
    during = memory.peak_mb()
    assert during > before + 200
    del block
    assert memory.restart_peak()
    assert memory.peak_mb() < during - 100
