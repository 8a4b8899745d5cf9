"""The detection stage: priors joined, and what happens when the detector is not there."""

from __future__ import annotations

import logging
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import with_values
from bdgs_ros.core.config.detection import DetectionConfig
from bdgs_ros.core.errors import ModelError
from bdgs_ros.core.types import ColorImage, Detection, RgbdFrame
from bdgs_ros.detection.stage import DetectionStage, combine
from bdgs_ros.detection.trouble import TroubledDetector

CAMERA = PinholeCamera(320, 240, 262.0, 262.0, 159.5, 119.5)
PERSON = Detection((100, 40, 160, 200), 0.8, 0, 'person', 0.91)


class Scripted:
    """A detector that sees one person until it is told to fail."""

    name = 'scripted'

    def __init__(self) -> None:
        self.calls = 0
        self.broken = False

    def detect(self, color: ColorImage) -> list[Detection]:
        """Find the person, or fail."""
        self.calls += 1
        if self.broken:
            raise ModelError('the network is gone')
        return [PERSON]


def frame(k: int, person: bool = True) -> RgbdFrame:
    """Return a textured wall, with a person before it."""
    texture = np.random.default_rng(0).integers(0, 256, (30, 40), dtype=np.uint8)
    color = np.repeat(np.kron(texture, np.ones((8, 8), np.uint8))[..., None], 3, axis=2)
    depth = np.full(CAMERA.shape, 3.0, np.float32)
    if person:
        depth[45:198, 105:155] = 1.5
    return RgbdFrame(k * 33_333_333, color, depth, CAMERA)


def test_labels_carry_stamp_mask_and_detections() -> None:
    """The person's pixels and no others."""
    stage = DetectionStage(DetectionConfig(geometric=False), Scripted())
    labels = stage.process(frame(7))
    assert labels.stamp_ns == 7 * 33_333_333
    (found,) = labels.detections
    assert found.box_xyxy == PERSON.box_xyxy and found.score == PERSON.score
    assert labels.p_dynamic.shape == CAMERA.shape and labels.p_dynamic.dtype == np.uint8
    assert labels.p_dynamic[120, 130] == round(255 * found.p_dynamic) > 128
    assert labels.p_dynamic[120, 200] == 0
    assert stage.status == 'scripted' and not stage.degraded


def test_detector_that_dies_is_reported_once(caplog: pytest.LogCaptureFixture) -> None:
    """The stage goes on without it."""
    detector = Scripted()
    stage = DetectionStage(DetectionConfig(weights='some.onnx'), detector)
    stage.process(frame(0))
    detector.broken = True
    with caplog.at_level(logging.WARNING):
        for k in range(1, 6):
            assert stage.process(frame(k)).detections == ()
    assert detector.calls == 2
    assert len(caplog.records) == 1 and 'the network is gone' in caplog.text
    assert stage.status == 'geometric prior alone: detector failed: the network is gone'
    assert stage.degraded


def test_unreadable_weights_leave_the_geometric_prior(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """At start as well."""
    path = tmp_path / 'broken.onnx'
    path.write_bytes(b'not a network')
    stage = DetectionStage(DetectionConfig(weights=str(path)))
    assert stage.degraded and 'broken.onnx' in stage.status
    assert len(caplog.records) == 1
    assert not stage.process(frame(0)).p_dynamic.any()


def test_no_weights_is_no_fault() -> None:
    """The status says what works."""
    stage = DetectionStage(DetectionConfig())
    assert stage.status == 'geometric prior alone: no weights file'
    assert not stage.degraded


def test_network_runs_on_every_nth_frame_only() -> None:
    """Between runs the objects are carried on."""
    detector = Scripted()
    config = with_values(DetectionConfig(geometric=False), {'tracks.interval': 3})
    stage = DetectionStage(config, detector)
    for k in range(7):
        assert stage.process(frame(k)).p_dynamic[120, 130] > 128
    assert detector.calls == 3


def moved(k: int) -> RgbdFrame:
    """Return the frame with the person three pixels further to the right per frame."""
    still = frame(k)
    depth = np.full(CAMERA.shape, 3.0, np.float32)
    depth[45:198, 105 + 3 * k : 155 + 3 * k] = 1.5
    return replace(still, depth_m=depth)


class Following:
    """A detector that knows where the person of `moved` is, but not the scene."""

    name = 'following'

    def __init__(self) -> None:
        self.k = 0

    def detect(self, color: ColorImage) -> list[Detection]:
        """Find the person."""
        x = 3.0 * self.k
        self.k += 1
        return [Detection((100 + x, 40, 160 + x, 200), 0.8, 0, 'person', 0.91)]


@pytest.mark.parametrize('period_s', [0.0, 0.2])
def test_late_answers_make_masks_of_now(period_s: float) -> None:
    """The mask lies where the person is and not where the detector saw one 0.2 s ago."""
    detector = TroubledDetector(Following(), 0.0, 0.0, delay_s=0.2, period_s=period_s)
    if period_s:  # it works on every seventh image: the person moves on meanwhile
        detector._inner = Skipping(7)
    stage = DetectionStage(DetectionConfig(geometric=False), detector)
    for k in range(40):
        called = stage.process(moved(k)).p_dynamic >= 128
        if k >= 20:
            truth = moved(k).depth_m < 2.0
            assert called[truth].mean() > 0.9
            assert (called & truth).sum() / called.sum() > 0.7
    assert stage.answer_ages_s == [] or stage.answer_ages_s[0] == pytest.approx(0.2, abs=0.04)


class Skipping(Following):
    """The same, asked on every n-th image only."""

    def __init__(self, step: int) -> None:
        super().__init__()
        self._step = step

    def detect(self, color: ColorImage) -> list[Detection]:
        """Find the person."""
        found = super().detect(color)
        self.k += self._step - 1
        return found


def test_dropped_detections_leave_no_gap() -> None:
    """The person's pixels are there in every frame."""
    stage = DetectionStage(
        DetectionConfig(geometric=False), TroubledDetector(Scripted(), 0.3, 0, 0)
    )
    for k in range(60):
        labels = stage.process(frame(k))
        assert k < 3 or labels.p_dynamic[120, 130] > 128


def test_detections_of_a_place_that_is_empty_now_paint_nothing() -> None:
    """A held object that stepped out of its box leaves the wall behind it alone."""
    stage = DetectionStage(DetectionConfig(geometric=False), OnceIn(30))
    for k in range(30):
        assert stage.process(frame(k)).p_dynamic.any()
    assert not stage.process(frame(30, person=False)).p_dynamic.any()


class OnceIn(Scripted):
    """Sees the person in the first n images."""

    def __init__(self, count: int) -> None:
        super().__init__()
        self._count = count

    def detect(self, color: ColorImage) -> list[Detection]:
        """Find the person, or nothing."""
        return super().detect(color) if self.calls < self._count else []


def test_geometric_prior_alone_sees_who_steps_in() -> None:
    """Someone in front of a wall that was free, with the camera's own motion estimated."""
    stage = DetectionStage(DetectionConfig())
    for k in range(15):
        assert not stage.process(frame(k, person=False)).p_dynamic.any()
    for k in range(15, 18):
        labels = stage.process(frame(k))
    assert labels.p_dynamic[120, 130] > 128
    assert labels.p_dynamic[120, 250] == 0
    stage.reset()
    assert not stage.process(frame(18)).p_dynamic.any()


def test_same_frames_same_labels() -> None:
    """Lockstep replays are repeatable."""
    one, two = DetectionStage(DetectionConfig()), DetectionStage(DetectionConfig())
    for k in range(20):
        a, b = one.process(frame(k, k > 12)), two.process(frame(k, k > 12))
        assert np.array_equal(a.p_dynamic, b.p_dynamic)


def test_combine_is_independent_evidence() -> None:
    """Neither prior weakens the other."""
    a = np.array([[0, 128, 200, 255]], np.uint8)
    b = np.array([[191, 128, 0, 10]], np.uint8)
    assert combine(a, b).tolist() == [[191, 192, 200, 255]]
    assert np.array_equal(combine(a, np.zeros_like(a)), a)
