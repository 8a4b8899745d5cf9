"""The posterior of each second, kept while the run goes on."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
import pytest
from run_fakes import CAMERA, FakeMapper, static_color

from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.types import RgbdFrame, TrackingResult, TrackingStatus
from bdgs_ros.eval.pictures import write_posterior
from bdgs_ros.eval.posterior import PosteriorWatch


@dataclass
class EverythingRender:
    p_dynamic: np.ndarray
    silhouette: np.ndarray


class BelievingMapper(FakeMapper):
    """Believes in a mover at the left of the image, more with every render."""

    count = 0

    def render_everything(self, T_world_camera, camera):
        self.count += 1
        belief = np.zeros(camera.shape, np.float32)
        belief[:, :8] = self.count / 100
        return EverythingRender(belief, np.ones(camera.shape, np.float32))


def watch_run(times_s, is_keyframe=True):
    watch = PosteriorWatch(BelievingMapper())
    for time_s in times_s:
        stamp_ns = round((100 + time_s) * 1e9)
        depth = np.ones(CAMERA.shape, np.float32)
        frame = RgbdFrame(stamp_ns, static_color(), depth, CAMERA)
        labels = np.zeros(CAMERA.shape, np.uint8)
        pose, ok = np.eye(4), TrackingStatus.OK
        watch(frame, TrackingResult(stamp_ns, ok, pose, np.eye(6), is_keyframe, labels))
    return watch


def test_the_keyframe_nearest_to_each_second_is_kept():
    watch = watch_run([0.0, 0.4, 0.8, 1.1, 1.6, 1.9, 2.2])
    assert [sample.time_s for sample in watch.samples] == pytest.approx([0.0, 1.1, 1.9])
    # the posterior is that of then: 0.0, 0.8, 1.1, 1.6, 1.9 were rendered in turn
    assert [int(s.posterior[0, 0]) for s in watch.samples] == [3, 8, 13]
    assert watch.samples[0].posterior[0, -1] == 0


def test_frames_that_are_no_keyframes_do_not_change_the_map():
    assert watch_run([0.0, 1.0], is_keyframe=False).samples == []


def test_long_recordings_have_no_more_rows():
    samples = watch_run(np.arange(0, 90.0)).samples
    steps = np.diff([sample.time_s for sample in samples])
    assert 10 <= len(samples) <= 20
    assert set(steps.round()) == {8.0}


def test_a_row_for_each_sample(tmp_path):
    path = tmp_path / 'posterior.png'
    write_posterior(path, watch_run([0.0, 1.0, 2.0]).samples)
    page = cv2.imread(str(path))
    width, height = CAMERA.width, CAMERA.height
    assert page.shape[:2] == (26 + 3 * height + 2 * 4, 4 * width + 3 * 4)
    with pytest.raises(EvaluationError, match='no keyframe'):
        write_posterior(path, [])
