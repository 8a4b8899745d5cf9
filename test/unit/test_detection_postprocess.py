"""Letterbox, decoding, suppression and the class table, on made-up network outputs."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.detection import classes, postprocess

NAMES = ('person', 'chair', 'ball')


def output(*rows: tuple[float, ...]) -> np.ndarray:
    """Return a network output, shape (1, 20, 8), with some rows filled."""
    out = np.zeros((1, 20, 5 + len(NAMES)), np.float32)
    for k, row in enumerate(rows):
        out[0, k] = row
    return out


def find(out: np.ndarray, placement: postprocess.Letterbox, **kw: float) -> list:
    """Post-process for a 640x480 image."""
    return postprocess.detections(
        out, placement, (480, 640), NAMES, kw.get('score', 0.35), kw.get('iou', 0.45)
    )


HALF = postprocess.Letterbox(0.5, 0, 40)  # 640x480 in 320x320


def test_letterbox_keeps_proportions_and_pads_with_grey() -> None:
    """A 640x480 image lies in the middle rows of a 320x320 input."""
    color = np.full((480, 640, 3), (255, 0, 51), np.uint8)
    blob, placement = postprocess.letterbox(color, 320, 320)
    assert blob.shape == (1, 3, 320, 320) and blob.dtype == np.float32
    assert placement == HALF
    assert blob[0, :, 160, 160] == pytest.approx([1.0, 0.0, 0.2])
    assert blob[0, :, 39, 160] == pytest.approx([114 / 255] * 3)
    assert blob[0, :, 280, 160] == pytest.approx([114 / 255] * 3)


@pytest.mark.parametrize('size', [(480, 640), (640, 480), (100, 333), (320, 320)])
def test_letterbox_and_to_image_are_inverse(size: tuple[int, int]) -> None:
    """A box brought to the input and back is where it was."""
    _, placement = postprocess.letterbox(np.zeros((*size, 3), np.uint8), 320, 416)
    box = np.array([[10, 20, 70, 60]], np.float32)
    offset = np.array([placement.offset_x, placement.offset_y] * 2)
    back = postprocess.to_image(
        (box * placement.scale + offset).astype(np.float32), placement, *size
    )
    assert back == pytest.approx(box, abs=1e-3)


def test_box_score_and_class_come_out_in_image_pixels() -> None:
    """Centre and size in the letterboxed input become corners in the image."""
    (found,) = find(output((160, 160, 100, 60, 0.9, 0.1, 0.2, 0.8)), HALF)
    assert found.box_xyxy == pytest.approx((220, 180, 420, 300))
    assert found.score == pytest.approx(0.72)
    assert (found.class_id, found.class_name) == (2, 'ball')


def test_weak_candidates_are_dropped() -> None:
    """Objectness times class score decides, not objectness alone."""
    assert find(output((160, 160, 50, 50, 0.9, 0.3, 0, 0)), HALF) == []


def test_suppression_is_per_class_and_keeps_the_best() -> None:
    """Overlapping boxes of one class merge; another class at the same place stays."""
    found = find(
        output(
            (160, 160, 100, 100, 0.7, 1, 0, 0),
            (162, 161, 100, 100, 0.9, 1, 0, 0),
            (160, 160, 100, 100, 0.8, 0, 1, 0),
            (60, 160, 60, 60, 0.5, 1, 0, 0),
        ),
        HALF,
    )
    assert [(d.class_name, round(d.score, 2)) for d in found] == [
        ('person', 0.9),
        ('chair', 0.8),
        ('person', 0.5),
    ]


def test_boxes_are_clipped_and_empty_ones_dropped() -> None:
    """What lies in the padding is not in the image."""
    found = find(output((10, 160, 100, 100, 0.9, 1, 0, 0), (160, 20, 50, 30, 0.9, 1, 0, 0)), HALF)
    assert len(found) == 1
    assert found[0].box_xyxy[0] == 0


def test_numbers_that_are_not_finite_make_no_box() -> None:
    """A network gone wrong yields nothing instead of a crash."""
    assert find(output((np.nan, 160, 50, 50, 0.9, 1, 0, 0)), HALF) == []
    assert find(np.full((1, 20, 8), np.nan, np.float32), HALF) == []


def test_iou_of_known_boxes() -> None:
    """Half-overlapping unit squares have 1/3."""
    a = np.array([[0, 0, 2, 2]], np.float32)
    b = np.array([[0, 0, 2, 2], [1, 0, 3, 2], [5, 5, 6, 6]], np.float32)
    assert postprocess.iou_matrix(a, b)[0] == pytest.approx([1, 1 / 3, 0])


def test_class_table_names_are_cocos() -> None:
    """Every prior belongs to a class that the network can name, and is a probability."""
    assert len(classes.COCO_NAMES) == len(set(classes.COCO_NAMES)) == 80
    assert set(classes.DYNAMIC_PRIOR) <= set(classes.COCO_NAMES)
    assert all(0 < p < 1 for p in classes.DYNAMIC_PRIOR.values())


def test_confident_people_are_dynamic_and_furniture_never() -> None:
    """The threshold of one half separates the tiers."""
    assert classes.p_dynamic('person', 0.35) > 0.5
    assert classes.p_dynamic('person', 0.8) == pytest.approx(0.912, abs=1e-3)
    assert classes.p_dynamic('chair', 1.0) < 0.5
    assert classes.p_dynamic('refrigerator', 1.0) == 0.0
    assert classes.p_dynamic('no such thing', 1.0) == 0.0
