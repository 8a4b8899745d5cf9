"""Boxes cut with depth: made-up rooms in which the object's pixels are known."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.core.config.detection import CutConfig
from bdgs_ros.core.types import Detection
from bdgs_ros.detection.mask import dynamic_prior_image

CONFIG = CutConfig()
H, W = 480, 640


def person(x0: float, y0: float, x1: float, y1: float, p: float = 0.9) -> Detection:
    """Return a detection of a person."""
    return Detection((x0, y0, x1, y1), 0.8, 0, 'person', p)


def room(far: float = 4.0) -> np.ndarray:
    """Return the depth of a wall with noise, and a floor that comes nearer below row 400."""
    rng = np.random.default_rng(0)
    depth = np.full((H, W), far, np.float32)
    depth[400:] = np.linspace(far, 0.55 * far, H - 400)[:, None]
    return (depth + 0.0025 * depth**2 * rng.standard_normal((H, W))).astype(np.float32)


def ellipse(cx: float, cy: float, rx: float, ry: float) -> np.ndarray:
    """Return a mask, shape (H, W)."""
    v, u = np.mgrid[:H, :W]
    return ((u - cx) / rx) ** 2 + ((v - cy) / ry) ** 2 < 1


def put(depth: np.ndarray, mask: np.ndarray, z: float) -> np.ndarray:
    """Place an object at a depth."""
    return np.where(mask, z, depth).astype(np.float32)


def scores(p: np.ndarray, truth: np.ndarray) -> tuple[float, float]:
    """Return recall and precision at one half."""
    found = p >= 128
    hits = np.count_nonzero(found & truth)
    return hits / np.count_nonzero(truth), hits / max(np.count_nonzero(found), 1)


def test_background_around_the_person_is_not_labelled() -> None:
    """The object is found and little else of its box."""
    truth = ellipse(300, 240, 60, 170)
    p = dynamic_prior_image([person(240, 70, 360, 410)], put(room(), truth, 2.2), CONFIG)
    recall, precision = scores(p, truth)
    assert recall > 0.98 and precision > 0.8
    assert p[80, 245] == 0 and p[300, 100] == 0
    assert p[240, 300] == round(0.9 * 255)


def test_a_known_depth_does_not_paint_the_wall_behind() -> None:
    """A range that ends before the wall admits no more than one that ends behind it."""
    truth = ellipse(300, 240, 60, 170)
    depth = put(room(2.55), truth, 2.2)
    for far in (2.5, 2.8):
        found = replace(person(240, 70, 360, 410), depth_m=(1.6, far))
        p = dynamic_prior_image([found], depth, CONFIG)
        recall, precision = scores(p, truth)
        assert recall > 0.95 and precision > 0.75, far


def test_gap_between_legs_stays_static() -> None:
    """Background seen through the object is not the object."""
    truth = ellipse(300, 240, 60, 170)
    truth[260:, 280:320] = False
    p = dynamic_prior_image([person(240, 70, 360, 410)], put(room(), truth, 2.0), CONFIG)
    assert scores(p, truth)[0] > 0.98
    assert p[330, 300] == 0


def test_person_behind_a_nearer_one_is_found_too() -> None:
    """Each box finds its own layer although the boxes overlap."""
    near, far = ellipse(260, 260, 70, 210), ellipse(360, 230, 45, 140)
    depth = put(put(room(), far, 2.9), near, 1.3)
    boxes = [person(190, 50, 330, 470), person(315, 90, 405, 370)]
    recall, precision = scores(dynamic_prior_image(boxes, depth, CONFIG), near | far)
    assert recall > 0.97 and precision > 0.8


def test_near_person_full_of_holes() -> None:
    """Most of a near person has no depth; the box tells that it is the person."""
    truth = ellipse(320, 300, 220, 280)
    depth = put(room(), truth, 0.6)
    holes = truth & (np.random.default_rng(1).random((H, W)) < 0.3)
    holes |= ellipse(320, 330, 150, 190)
    p = dynamic_prior_image([person(100, 20, 540, 480)], put(depth, holes, 0.0), CONFIG)
    assert scores(p, truth)[0] > 0.97
    assert p[30, 110] == 0


def test_person_without_any_depth_takes_the_holes_of_the_box() -> None:
    """No layer can be found, so what has no depth is taken, and what has depth is not."""
    truth = ellipse(320, 260, 200, 300)
    p = dynamic_prior_image([person(120, 0, 520, 480)], put(room(), truth, 0.0), CONFIG)
    recall, precision = scores(p, truth)
    assert recall > 0.99 and precision > 0.85


def test_box_cut_off_by_the_image_border() -> None:
    """A person half in view is found as well."""
    truth = ellipse(0, 240, 70, 300)
    p = dynamic_prior_image([person(0, 0, 72, 480)], put(room(), truth, 1.6), CONFIG)
    recall, precision = scores(p, truth)
    assert recall > 0.97 and precision > 0.75


def test_larger_probability_wins_and_zero_paints_nothing() -> None:
    """Overlapping detections of one thing do not weaken each other."""
    truth = ellipse(300, 240, 60, 170)
    depth = put(room(), truth, 2.2)
    box = (240, 70, 360, 410)
    p = dynamic_prior_image([person(*box, p=0.9), person(*box, p=0.4)], depth, CONFIG)
    assert p[240, 300] == round(0.9 * 255)
    assert not dynamic_prior_image([person(*box, p=0.0)], depth, CONFIG).any()


@pytest.mark.parametrize('box', [(0, 0, 1, 1), (639, 479, 640, 480), (0, 0, 640, 480)])
@pytest.mark.parametrize('fill', [0.0, 2.0, 50.0])
def test_degenerate_boxes_and_depths_do_not_crash(box: tuple[float, ...], fill: float) -> None:
    """Any box, any depth."""
    p = dynamic_prior_image([person(*box)], np.full((H, W), fill, np.float32), CONFIG)
    assert p.shape == (H, W) and p.dtype == np.uint8


def test_odd_sizes() -> None:
    """Images whose size is no multiple of the stride."""
    depth = np.full((123, 157), 2.0, np.float32)
    depth[40:100, 50:90] = 1.0
    p = dynamic_prior_image([person(50, 40, 90, 100)], depth, CONFIG)
    assert p.shape == depth.shape and p[70, 70] > 0 and p[10, 10] == 0
