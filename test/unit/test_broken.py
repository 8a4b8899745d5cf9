"""Images that did not arrive whole."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from bdgs_ros.tracking.broken import BrokenRows, flat_share, without_rows

SHAPE = (120, 160)


def picture(seed: int = 0) -> np.ndarray:
    rng = np.random.default_rng(seed)
    return rng.integers(0, 255, (*SHAPE, 3), dtype=np.uint8)


def cut(image: np.ndarray, share: float, value: int = 128) -> np.ndarray:
    broken = image.copy()
    broken[round((1 - share) * len(image)) :] = value
    return broken


@pytest.mark.parametrize('value', [0, 128, 255])
def test_the_missing_share_is_found(value: int) -> None:
    rows = BrokenRows()
    assert rows.share(picture()) == 0
    assert rows.share(cut(picture(), 2 / 3, value)) == pytest.approx(2 / 3, abs=0.04)
    assert rows.share(picture()) == 0


def test_a_jpeg_that_was_cut_off() -> None:
    data = cv2.imencode('.jpg', cv2.GaussianBlur(picture(), (0, 0), 3))[1]
    image = cv2.imdecode(data[: len(data) // 3], cv2.IMREAD_COLOR)
    if image is None:
        pytest.skip('this OpenCV does not decode what is left')
    assert flat_share(image) == pytest.approx(2 / 3, abs=0.15)


def test_whole_images_and_covered_lenses_are_not_broken() -> None:
    rows = BrokenRows()
    assert rows.share(picture()) == 0
    assert rows.share(cut(picture(), 0.02)) == 0  # a dark line
    assert rows.share(np.zeros((*SHAPE, 3), np.uint8)) == 0  # a lid: others judge that


def test_what_always_covers_the_lower_edge_is_usual() -> None:
    """A robot's own body, painted black."""
    rows = BrokenRows()
    shares = [rows.share(cut(picture(i), 0.2, 0)) for i in range(8)]
    assert shares[0] > 0.1 and shares[-1] == 0
    assert rows.share(cut(picture(), 0.6, 0)) > 0.5
    rows.reset()
    assert rows.share(cut(picture(), 0.2, 0)) > 0.1


def test_missing_rows_are_masked() -> None:
    mask = without_rows(np.zeros(SHAPE, np.uint8), 0.25)
    assert not mask[:90].any() and (mask[90:] == 255).all()
