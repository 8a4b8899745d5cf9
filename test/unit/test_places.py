"""Places are recognised, bounded in number, and move with the world."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.tracking import FeatureConfig, PlacesConfig
from bdgs_ros.core.types import RgbdFrame
from bdgs_ros.tracking.places import Places

CAMERA = PinholeCamera(640, 480, 520.0, 520.0, 319.5, 239.5)
STILL = np.zeros((480, 640), np.uint8)


def wall(seed: int, offset_px: int = 0, stamp_ns: int = 0) -> RgbdFrame:
    """Return a textured wall 2 m away, seen from a place to its side."""
    rng = np.random.default_rng(seed)
    texture = np.kron(rng.integers(0, 255, (60, 100)), np.ones((12, 12))).astype(np.uint8)
    grey = texture[:480, 100 + offset_px : 740 + offset_px]
    color = np.repeat(grey[..., None], 3, axis=2)
    return RgbdFrame(stamp_ns, color, np.full((480, 640), 2.0, np.float32), CAMERA)


def pose(x: float) -> np.ndarray:
    return se3.exp(np.array([x, 0, 0, 0, 0, 0]))


@pytest.fixture
def places() -> Places:
    found = Places(PlacesConfig(), FeatureConfig())
    for seed in range(12):
        found.add(wall(seed, stamp_ns=seed), pose(10.0 * seed), STILL)
    return found


def test_the_right_place_of_many_is_found_with_its_pose(places: Places) -> None:
    offset_px = 52
    best = places.find(wall(7, offset_px), STILL)[0]
    assert best.place.stamp_ns == 7
    moved_m = offset_px * 2.0 / CAMERA.fx
    assert best.T_world_camera == pytest.approx(pose(70.0 + moved_m), abs=0.02)


def test_an_unknown_place_and_a_covered_lens_are_not_found(places: Places) -> None:
    assert places.find(wall(99), STILL) == []
    dark = replace(wall(7), color=np.zeros((480, 640, 3), np.uint8))
    assert places.find(dark, STILL) == []
    assert Places(PlacesConfig(), FeatureConfig()).find(wall(0), STILL) == []


def test_what_moves_is_no_landmark(places: Places) -> None:
    assert places.find(wall(7), np.full_like(STILL, 255)) == []


def test_places_move_with_the_world(places: Places) -> None:
    places.put({7: pose(71.0), 99: pose(5.0)})
    assert places.find(wall(7), STILL)[0].T_world_camera[0, 3] == pytest.approx(71.0, abs=0.02)
    assert places.find(wall(3), STILL)[0].T_world_camera[0, 3] == pytest.approx(30.0, abs=0.02)


def test_the_most_redundant_goes_first_and_never_the_newest() -> None:
    places = Places(PlacesConfig(count=3), FeatureConfig())
    for stamp_ns, x in enumerate((0.0, 5.0, 0.1, 9.0, 5.05)):
        places.add(wall(0, stamp_ns=stamp_ns), pose(x), STILL)
    assert len(places) == 3
    kept = [place.stamp_ns for place in places]
    assert kept[-1] == 4
    assert 3 in kept
    assert len({0, 2} & set(kept)) == 1


def test_features_come_when_there_is_time(places: Places) -> None:
    assert all(place.features is None for place in places)
    places.prepare(2)
    assert sum(place.features is not None for place in places) == 2
    places.find(wall(0), STILL)
    assert all(place.features is not None for place in places)
    places.clear()
    assert len(places) == 0
