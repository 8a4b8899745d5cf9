"""New Gaussians lie on the surface, flat, and as wide as their cells."""

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import MappingConfig
from bdgs_ros.mapping.keyframes import MapKeyframe, build_levels
from bdgs_ros.mapping.lift import lift
from bdgs_ros.mapping.rotations import axes_from_quats
from bdgs_ros.mapping.surface import Surface, fit_surface

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
INSERT = MappingConfig().insert
FINE = replace(INSERT, doublings=0)


def seen(depth: np.ndarray, T: np.ndarray) -> tuple[MapKeyframe, Surface]:
    color = np.random.default_rng(0).integers(0, 255, (*CAMERA.shape, 3), np.uint8)
    moving = np.zeros(CAMERA.shape, bool)
    levels = build_levels(color, depth.astype(np.float32), moving, CAMERA, 1)
    keyframe = MapKeyframe(0, 0, T, np.zeros(CAMERA.shape, np.uint8), levels)
    tolerance = np.full(CAMERA.shape, 0.01, np.float32)
    surface = fit_surface(levels[0].depth_m, depth > 0, depth > 0, CAMERA, 4, tolerance)
    return keyframe, surface


def test_lifted_gaussians_project_back_to_their_pixels() -> None:
    keyframe, surface = seen(np.random.default_rng(0).uniform(1, 3, (48, 64)), np.eye(4))
    pixels = np.zeros(CAMERA.shape, bool)
    pixels[7, 9] = pixels[30, 50] = True
    new = lift(keyframe, keyframe.levels[0], surface, pixels, 0.3, replace(FINE, finest=1))
    np.testing.assert_allclose(CAMERA.project(new.means), [[9, 7], [50, 30]], atol=1e-3)
    width = INSERT.sigma_px * new.means[:, 2] / CAMERA.fx
    np.testing.assert_allclose(new.scales, width[:, None].repeat(3, 1), rtol=1e-4)
    color = keyframe.levels[0].color[[7, 30], [9, 50]]
    np.testing.assert_allclose(new.colors, color, atol=1e-4)


@pytest.mark.parametrize('tilt', [0.0, 0.5, -1.0])
def test_gaussians_on_a_slanted_wall_lie_in_it(tilt: float) -> None:
    T = se3.exp(np.array([0.4, -0.2, 0.1, 0.3, -0.2, 0.5]))
    normal = np.array([np.sin(tilt), 0, -np.cos(tilt)])
    depth = -2.0 / (CAMERA.rays() @ normal)
    depth[(depth < 0) | (depth > 6)] = 0
    keyframe, surface = seen(depth, T)
    new = lift(keyframe, keyframe.levels[0], surface, surface.flat, 0.3, FINE)
    assert new.quats is not None
    world_normal = T[:3, :3] @ normal
    axis = axes_from_quats(new.quats)
    assert np.abs(axis[:, :, 2] @ world_normal).min() > 0.999
    distance = (new.means - T[:3, 3]) @ world_normal + 2.0
    assert np.abs(distance).max() < 5e-3
    np.testing.assert_allclose(new.scales[:, 2] / new.scales[:, 0], INSERT.flatness, rtol=1e-4)
    assert (new.scales[:, 1] >= 0.999 * new.scales[:, 0]).all()
    assert (new.scales[:, 1] <= 1.001 * INSERT.max_slant * new.scales[:, 0]).all()


def test_seen_from_where_it_came_a_gaussian_is_round() -> None:
    """Length by 1 / cos(slant) on the surface: its image in the keyframe is a circle."""
    normal = np.array([np.sin(0.9), 0, -np.cos(0.9)])
    depth = -2.0 / (CAMERA.rays() @ normal)
    depth[(depth < 0) | (depth > 6)] = 0
    keyframe, surface = seen(depth, np.eye(4))
    pixels = np.zeros(CAMERA.shape, bool)
    pixels[20:28, 28:36] = surface.flat[20:28, 28:36]
    new = lift(
        keyframe,
        keyframe.levels[0],
        surface,
        pixels,
        0.3,
        replace(FINE, flatness=0.01, max_slant=100.0),
    )
    assert new.quats is not None
    half = axes_from_quats(new.quats) * new.scales[:, None, :]
    z = new.means[:, 2]
    zero = np.zeros_like(z)
    jacobian = np.stack(
        [
            np.stack([CAMERA.fx / z, zero, -CAMERA.fx * new.means[:, 0] / z**2], 1),
            np.stack([zero, CAMERA.fy / z, -CAMERA.fy * new.means[:, 1] / z**2], 1),
        ],
        axis=1,
    )
    spread = np.linalg.svd(jacobian @ half, compute_uv=False)
    expected = INSERT.sigma_px * FINE.finest
    np.testing.assert_allclose(spread, expected, rtol=0.1)


def test_a_keyframe_s_exposure_is_taken_out_of_the_colours() -> None:
    keyframe, surface = seen(np.full(CAMERA.shape, 2.0), np.eye(4))
    pixels = np.ones(CAMERA.shape, bool)
    plain = lift(keyframe, keyframe.levels[0], surface, pixels, 0.3, FINE).colors
    keyframe.exposure = np.array([np.log(2.0), 0.1], np.float32)
    np.testing.assert_allclose(
        lift(keyframe, keyframe.levels[0], surface, pixels, 0.3, FINE).colors,
        (plain - 0.1) / 2,
        atol=1e-5,
    )
