"""Bench `tracking`: parts are timed from outside, and the columns of live runs."""

from __future__ import annotations

import time

import numpy as np
import pytest

from bdgs_ros.bench import tracking
from bdgs_ros.bench.tracking_parts import PARTS, PartTimes
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.types import RgbdFrame
from bdgs_ros.tracking.align import Aligner
from bdgs_ros.tracking.camera_tracker import CameraTracker

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)


def frame(i: int) -> RgbdFrame:
    color = np.random.default_rng(0).integers(0, 255, (*CAMERA.shape, 3), np.uint8)
    return RgbdFrame(i * 33_000_000, color, np.full(CAMERA.shape, 2.0, np.float32), CAMERA)


def test_parts_sum_up_to_no_more_than_the_whole() -> None:
    tracker = CameraTracker(BdgsConfig().tracking)
    original = Aligner.align
    with PartTimes() as times:
        tracker.process(frame(0))
        times.take()
        start = time.perf_counter()
        tracker.process(frame(1))
        wall_ms = 1e3 * (time.perf_counter() - start)
        taken = times.take()
        assert times.take() == {}
    assert Aligner.align is original
    assert {'pyramid', 'coarse', 'predict'} <= set(taken)
    assert 0 < sum(taken.get(part, 0.0) for part in PARTS) <= taken['all'] <= wall_ms


def test_what_others_do_with_an_aligner_is_not_tracking() -> None:
    aligner = Aligner(BdgsConfig().tracking.align)
    with PartTimes() as times:
        aligner.pyramid(frame(0).color, frame(0).depth_m, None, CAMERA)
        assert times.take() == {}


def test_rest_is_what_no_part_has() -> None:
    rows = [{'all': 10.0, 'coarse': 4.0, 'refine': 3.0, 'load': 5.0}] * 3
    columns = tracking.part_columns(rows)
    assert columns['alone_ms'] == 10.0
    assert columns['rest_ms'] == 3.0
    assert columns['load_ms'] == 5.0


def test_live_columns_come_from_the_metrics() -> None:
    metrics = {
        'metrics': {
            name: {'value': value}
            for name, value in (('frames', 90), ('frames_sent', 120), ('ate_rmse', 2.5))
        },
        'nodes': {'mapping': {'keyframes': '7'}, 'tracking': {'labels_age_ms_median': '33.5'}},
    }
    row = tracking.live_columns(metrics)
    assert row['tracked_percent'] == pytest.approx(75.0)
    assert (row['keyframes_mapped'], row['labels_age_ms'], row['ate_rmse_cm']) == (7.0, 33.5, 2.5)
