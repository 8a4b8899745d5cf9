"""Detectors that answer at once, when they are done, or in trouble."""

from __future__ import annotations

import threading
import time

import numpy as np
import pytest

from bdgs_ros.core.errors import ModelError
from bdgs_ros.core.types import ColorImage, Detection
from bdgs_ros.detection.detector import Answer, LateDetector
from bdgs_ros.detection.late import AtOnce, InBackground
from bdgs_ros.detection.trouble import TroubledDetector

PERSON = Detection((100, 40, 160, 200), 0.8, 0, 'person', 0.91)
MS = 1_000_000


def image(value: int = 0) -> ColorImage:
    return np.full((240, 320, 3), value, np.uint8)


class Gated:
    """A detector that waits until it may answer, and reports the value of the image as score."""

    name = 'gated'

    def __init__(self) -> None:
        self.may = threading.Event()
        self.begun = threading.Event()
        self.error: Exception | None = None

    def detect(self, color: ColorImage) -> list[Detection]:
        """Wait, then answer or fail."""
        self.begun.set()
        assert self.may.wait(5.0)
        if self.error is not None:
            raise self.error
        return [Detection((0, 0, 1, 1), color[0, 0, 0] / 100, 0, 'person', 0.5)]


class Steady:
    """Sees four people in every image."""

    name = 'steady'

    def detect(self, color: ColorImage) -> list[Detection]:
        """Find them."""
        return [PERSON] * 4


def answers(detector: LateDetector, count: int) -> list[Answer]:
    """Wait for answers."""
    got: list[Answer] = []
    deadline = time.monotonic() + 5.0
    while len(got) < count and time.monotonic() < deadline:
        got += detector.poll()
        time.sleep(0.002)
    return got


def test_at_once_answers_every_image_once() -> None:
    """With its own stamp."""
    detector = AtOnce(Steady())
    detector.submit(5, image())
    (answer,) = detector.poll()
    assert answer.stamp_ns == 5 and answer.detections == [PERSON] * 4
    assert detector.poll() == []


def test_background_works_on_the_newest_image_and_never_blocks() -> None:
    """Images that came while it was busy are passed over but for the last."""
    inner = Gated()
    detector = InBackground(inner)
    detector.submit(1, image(1))
    assert inner.begun.wait(5.0)
    started = time.monotonic()
    for k in range(2, 6):
        detector.submit(k, image(k))
        assert detector.poll() == []
    assert time.monotonic() - started < 1.0
    inner.may.set()
    got = answers(detector, 2)
    assert [a.stamp_ns for a in got] == [1, 5]
    assert [a.detections[0].score for a in got] == [0.01, 0.05]
    detector.close()


def test_background_forgets_the_image_at_hand_on_reset() -> None:
    """Its answer belongs to another time."""
    inner = Gated()
    detector = InBackground(inner)
    detector.submit(900, image(1))
    assert inner.begun.wait(5.0)
    detector.reset()
    inner.may.set()
    detector.submit(3, image(3))
    assert [a.stamp_ns for a in answers(detector, 1)] == [3]
    detector.close()


@pytest.mark.parametrize('error', [ModelError('gone'), RuntimeError('gone')])
def test_background_tells_whoever_polls_of_an_error(error: Exception) -> None:
    """As a ModelError, which the stage knows to handle."""
    inner = Gated()
    inner.error = error
    inner.may.set()
    detector = InBackground(inner)
    detector.submit(1, image())
    with pytest.raises(ModelError, match='gone'):
        answers(detector, 1)
    detector.close()


def test_trouble_is_late_by_its_delay() -> None:
    """In the time of stamps."""
    detector = TroubledDetector(Steady(), drop=0.0, false=0.0, delay_s=0.1)
    arrived = {}
    for k in range(10):
        detector.submit(k * 30 * MS, image())
        arrived.update({a.stamp_ns // (30 * MS): k for a in detector.poll()})
    assert arrived == {k: k + 4 for k in range(6)}


def test_trouble_passes_images_over_while_it_works() -> None:
    """A slow network is late and rare."""
    detector = TroubledDetector(Steady(), drop=0.0, false=0.0, delay_s=0.0, period_s=0.1)
    stamps = []
    for k in range(12):
        detector.submit(k * 30 * MS, image())
        stamps += [a.stamp_ns for a in detector.poll()]
    assert stamps == [0, 120 * MS, 240 * MS]


def test_trouble_drops_and_invents_at_its_rates_and_repeatably() -> None:
    """The same in every run."""

    def run() -> list[list[Detection]]:
        detector = TroubledDetector(Steady(), drop=0.3, false=0.1, delay_s=0.0, seed=3)
        found = []
        for k in range(1000):
            detector.submit(k * 33 * MS, image())
            found += [a.detections for a in detector.poll()]
        return found

    found = run()
    assert found == run()
    real = sum(d is PERSON for ds in found for d in ds)
    ghosts = [d for ds in found for d in ds if d is not PERSON]
    assert real == pytest.approx(2800, abs=120) and len(ghosts) == pytest.approx(100, abs=35)
    for ghost in ghosts:
        x0, y0, x1, y1 = ghost.box_xyxy
        assert 0 <= x0 < x1 <= 320 and 0 <= y0 < y1 <= 240 and ghost.class_name == 'person'
