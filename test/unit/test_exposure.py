"""Gain and offset from a render to its image, in spite of what does not belong."""

import numpy as np
import pytest

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.mapping.exposure import fit_exposure
from bdgs_ros.mapping.keyframes import Level
from bdgs_ros.mapping.rasterize import Rendered

CAMERA = PinholeCamera(80, 60, 70.0, 70.0, 39.5, 29.5)


def shown(silhouette: float = 1.0) -> Rendered:
    """What the map shows."""
    color = np.random.default_rng(0).uniform(0.15, 0.65, (*CAMERA.shape, 3)).astype(np.float32)
    full = np.full(CAMERA.shape, silhouette, np.float32)
    return Rendered(color * full[..., None], 2 * full, full, 0 * full)


def taken(gain: float, offset: float) -> Level:
    """The same scene as the camera took it."""
    color = gain * shown().color + offset
    image = (255 * color + 0.5).clip(0, 255).astype(np.uint8)
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    return Level(CAMERA, image, depth, np.ones(CAMERA.shape, bool))


@pytest.mark.parametrize('gain', [0.7, 1.0, 1.3])
def test_the_gain_is_found(gain: float) -> None:
    exposure = fit_exposure(shown(), taken(gain, 0.0))
    assert exposure is not None
    assert np.exp(exposure[0]) == pytest.approx(gain, abs=0.02)
    assert abs(exposure[1]) < 0.01


def test_an_offset_is_found_in_part_because_it_is_held_back() -> None:
    exposure = fit_exposure(shown(), taken(1.0, 0.05))
    assert exposure is not None
    assert 0.0 < exposure[1] < 0.06
    middle = np.exp(exposure[0]) * 0.4 + exposure[1]
    assert middle == pytest.approx(0.45, abs=0.01)


def test_a_faint_render_is_divided_by_its_silhouette() -> None:
    exposure = fit_exposure(shown(0.95), taken(1.2, 0.0))
    assert exposure is not None
    assert np.exp(exposure[0]) == pytest.approx(1.2, abs=0.02)


def test_what_is_not_in_the_map_counts_little() -> None:
    level = taken(1.2, 0.0)
    level.image[:15] = 30
    exposure = fit_exposure(shown(), level)
    assert exposure is not None
    assert np.exp(exposure[0]) == pytest.approx(1.2, abs=0.06)


def test_movers_and_saturated_pixels_do_not_count() -> None:
    level = taken(1.2, 0.0)
    level.image[:30] = 255
    level.image[30:40] = 100
    level.static[30:40] = False
    exposure = fit_exposure(shown(), level)
    assert exposure is not None
    assert np.exp(exposure[0]) == pytest.approx(1.2, abs=0.02)


@pytest.mark.parametrize('silhouette', [0.0, 0.5])
def test_where_the_map_is_empty_there_is_no_exposure(silhouette: float) -> None:
    assert fit_exposure(shown(silhouette), taken(1.0, 0.0)) is None


def test_the_gain_stays_within_reason() -> None:
    dim = shown()
    faint = Rendered(dim.color * 0.01, dim.depth, dim.silhouette, dim.p_dynamic)
    exposure = fit_exposure(faint, taken(1.0, 0.0))
    assert exposure is not None
    assert np.isfinite(exposure).all()
    assert exposure[0] <= 1.0
