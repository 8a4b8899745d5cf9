"""Frames are labelled ahead, in order and with the labels that they have anyway."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import closing
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from bdgs_ros.ahead import DetectedAhead
from bdgs_ros.core.types import Labels


class Counting:
    """Says how often it was asked, which depends on the order."""

    name = 'counting'

    def __init__(self) -> None:
        self.asked = 0

    def process(self, frame: Any) -> Labels:
        self.asked += 1
        return Labels(frame.stamp_ns, np.full((2, 2), self.asked, np.uint8), ())


def recording(count: int) -> Iterator[Any]:
    for stamp in range(count):
        yield SimpleNamespace(stamp_ns=stamp)


def test_every_frame_has_the_labels_it_would_have_in_turn() -> None:
    stage = Counting()
    ahead = DetectedAhead(stage)
    found = [(f.stamp_ns, ahead.process(f).p_dynamic[0, 0]) for f in ahead.frames(recording(20))]
    assert found == [(i, i + 1) for i in range(20)]
    assert ahead.name == 'counting'


def test_no_more_than_a_few_frames_are_held() -> None:
    stage = Counting()
    ahead = DetectedAhead(stage)
    with closing(ahead.frames(recording(1000))) as frames:
        next(frames)
        for _ in range(100):
            if stage.asked == 4:  # one here, three wait
                break
            threading.Event().wait(0.01)
        assert stage.asked == 4
    assert not [t for t in threading.enumerate() if t.name.startswith('detection')]


def test_an_error_in_the_recording_or_the_stage_comes_out() -> None:
    def broken() -> Iterator[Any]:
        yield SimpleNamespace(stamp_ns=0)
        raise OSError('the disk is gone')

    with pytest.raises(OSError, match='the disk is gone'):
        list(DetectedAhead(Counting()).frames(broken()))
    with pytest.raises(AttributeError, match='stamp_ns'):
        list(DetectedAhead(Counting()).frames([SimpleNamespace()]))  # type: ignore[list-item]
