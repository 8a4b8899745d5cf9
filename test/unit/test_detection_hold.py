"""Missed detections held by constant velocity."""

from __future__ import annotations

import pytest

from bdgs_ros.core.config.detection import HoldConfig
from bdgs_ros.core.types import Detection
from bdgs_ros.detection.hold import BoxHold

SHAPE = (480, 640)
CONFIG = HoldConfig(frames=3)


def walker(x: float, score: float = 0.8) -> Detection:
    """Return a person whose box begins at column x."""
    return Detection((x, 100, x + 80, 400), score, 0, 'person', 0.9 * score)


def test_seen_objects_pass_unchanged() -> None:
    """Nothing is added while everything is detected."""
    hold = BoxHold(CONFIG)
    for k in range(5):
        found = [walker(100 + 10 * k), walker(400 - 10 * k)]
        assert hold.update(found, SHAPE) == found


def test_a_missed_walker_walks_on_and_fades() -> None:
    """The held box is where the walker is; then it is let go."""
    hold = BoxHold(CONFIG)
    for k in range(8):
        hold.update([walker(100 + 10 * k)], SHAPE)
    scores = []
    for k in range(8, 11):
        (held,) = hold.update([], SHAPE)
        assert held.box_xyxy[0] == pytest.approx(100 + 10 * k, abs=1.0)
        scores.append(held.score)
    assert scores == sorted(scores, reverse=True) and scores[0] < 0.8
    assert hold.update([], SHAPE) == []


def test_a_held_walker_that_comes_back_is_one_walker() -> None:
    """No double is left behind."""
    hold = BoxHold(CONFIG)
    for k in range(5):
        hold.update([walker(100 + 10 * k)], SHAPE)
    hold.update([], SHAPE)
    assert len(hold.update([walker(161)], SHAPE)) == 1
    assert len(hold.update([], SHAPE)) == 1


def test_doubtful_and_static_objects_are_not_held() -> None:
    """A false alarm must not last."""
    hold = BoxHold(CONFIG)
    hold.update([walker(100, score=0.36)], SHAPE)
    assert hold.update([], SHAPE) == []
    hold.update([Detection((0, 0, 50, 50), 0.9, 62, 'tv', 0.0)], SHAPE)
    assert hold.update([], SHAPE) == []


def test_who_leaves_the_image_is_gone() -> None:
    """The velocity carries the box out."""
    hold = BoxHold(HoldConfig(frames=30))
    for k in range(8):
        hold.update([walker(430 + 30 * k)], SHAPE)
    assert hold.update([], SHAPE) == []


def test_coasting_moves_without_ageing() -> None:
    """Frames that the network skips on purpose are no misses."""
    hold = BoxHold(CONFIG)
    for k in range(8):
        hold.update([walker(100 + 10 * k)], SHAPE)
    for k in range(8, 16):
        (held,) = hold.coast(SHAPE)
        assert held.box_xyxy[0] == pytest.approx(100 + 10 * k, abs=1.5)
        assert held.score == pytest.approx(0.8)


def test_reset_forgets() -> None:
    """After a jump in time."""
    hold = BoxHold(CONFIG)
    hold.update([walker(100)], SHAPE)
    hold.reset()
    assert hold.update([], SHAPE) == []
