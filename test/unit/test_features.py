"""Features are found on static surfaces alone, matched, and give the pose between two views."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.tracking import FeatureConfig
from bdgs_ros.core.types import RgbdFrame
from bdgs_ros.tracking.features import FeatureExtractor, match
from bdgs_ros.tracking.pnp import locate

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)


def wall(offset_px: int, seed: int = 0) -> RgbdFrame:
    """Return a textured wall 2 m away, moved sideways by whole pixels."""
    rng = np.random.default_rng(seed)
    texture = np.kron(rng.integers(0, 255, (60, 100)), np.ones((6, 6))).astype(np.uint8)
    grey = texture[:240, 100 + offset_px : 420 + offset_px]
    color = np.repeat(grey[..., None], 3, axis=2)
    return RgbdFrame(1, color, np.full((240, 320), 2.0, np.float32), CAMERA)


def no_mask() -> np.ndarray:
    return np.zeros((240, 320), np.uint8)


def test_two_views_of_a_wall_give_the_motion_between_them() -> None:
    config = FeatureConfig()
    extractor = FeatureExtractor(config)
    a, b = (extractor.extract(wall(offset), no_mask()) for offset in (0, 26))
    pairs = match(a, b, config)
    assert len(pairs) > 50
    found = locate(a.points_camera[pairs[:, 0]], b.pixels[pairs[:, 1]], CAMERA, 3.0)
    assert found is not None
    assert len(found.inliers) > 0.8 * len(pairs)
    expected = se3.identity()
    expected[0, 3] = -26 * 2.0 / CAMERA.fx
    assert np.allclose(found.T_current_reference, expected, atol=0.01)


def test_nothing_is_found_on_movers_or_without_depth() -> None:
    frame, moving = wall(0), no_mask()
    moving[:, :160] = 255
    frame.depth_m[120:] = 0
    found = FeatureExtractor(FeatureConfig()).extract(frame, moving)
    assert len(found) > 20
    assert found.pixels[:, 0].min() >= 159
    assert found.pixels[:, 1].max() <= 120


def test_points_lie_where_the_pixels_are() -> None:
    found = FeatureExtractor(FeatureConfig()).extract(wall(0), no_mask())
    u = CAMERA.fx * found.points_camera[:, 0] / found.points_camera[:, 2] + CAMERA.cx
    assert np.allclose(u, found.pixels[:, 0], atol=1e-3)


@pytest.mark.parametrize('color', [0, 128])
def test_a_blank_image_has_no_features_and_matches_nothing(color: int) -> None:
    blank = RgbdFrame(
        1, np.full((240, 320, 3), color, np.uint8), np.ones((240, 320), np.float32), CAMERA
    )
    config = FeatureConfig()
    extractor = FeatureExtractor(config)
    nothing = extractor.extract(blank, no_mask())
    assert len(nothing) == 0
    assert match(nothing, extractor.extract(wall(0), no_mask()), config).shape == (0, 2)


def test_other_places_do_not_match() -> None:
    config = FeatureConfig()
    extractor = FeatureExtractor(config)
    a, b = extractor.extract(wall(0), no_mask()), extractor.extract(wall(0, seed=1), no_mask())
    pairs = match(a, b, config)
    found = locate(a.points_camera[pairs[:, 0]], b.pixels[pairs[:, 1]], CAMERA, 3.0)
    assert found is None or len(found.inliers) < 12


def test_locate_is_repeatable_and_refuses_too_few() -> None:
    config = FeatureConfig()
    extractor = FeatureExtractor(config)
    a, b = (extractor.extract(wall(offset), no_mask()) for offset in (0, 26))
    pairs = match(a, b, config)
    points, pixels = a.points_camera[pairs[:, 0]], b.pixels[pairs[:, 1]]
    first, second = (locate(points, pixels, CAMERA, 3.0, seed=5) for _ in range(2))
    assert first is not None and second is not None
    assert np.array_equal(first.T_current_reference, second.T_current_reference)
    assert locate(points[:3], pixels[:3], CAMERA, 3.0) is None
