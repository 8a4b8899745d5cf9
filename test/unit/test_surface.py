"""Planes are found where there are planes, and only there."""

import numpy as np
import pytest

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.mapping import surface as surface_module
from bdgs_ros.mapping.surface import fit_surface

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)


def plane_depth(normal: np.ndarray, distance: float) -> np.ndarray:
    """Depth of the plane normal.X = -distance, the normal towards the camera."""
    return (-distance / (CAMERA.rays() @ normal)).astype(np.float32)


def fit(depth: np.ndarray, tolerance: float = 0.01):  # type: ignore[no-untyped-def]
    wanted = np.ones(depth.shape, bool)
    limits = np.full(depth.shape, tolerance, np.float32)
    return fit_surface(depth, depth > 0, wanted, CAMERA, 4, limits)


def test_the_normal_of_a_slanted_plane_is_found_up_to_the_border() -> None:
    normal = np.array([0.5, -0.3, -0.8])
    normal /= np.linalg.norm(normal)
    depth = plane_depth(normal, 2.0)
    surface = fit(depth)
    assert surface.flat.all()
    assert np.arccos(np.clip(surface.normals @ normal, -1, 1)).max() < 2e-2
    np.testing.assert_allclose(1 / surface.inverse_depth, depth, rtol=1e-3)


def test_noise_is_averaged_out() -> None:
    depth = plane_depth(np.array([0.0, 0.0, -1.0]), 2.0)
    noise = np.random.default_rng(0).normal(0, 0.005, depth.shape).astype(np.float32)
    surface = fit(depth + noise, 0.02)
    tilt = np.arccos(np.clip(-surface.normals[..., 2], -1, 1))[6:-6, 6:-6]
    assert np.rad2deg(np.median(tilt)) < 3
    error = np.abs(1 / surface.inverse_depth - 2.0)[6:-6, 6:-6]
    assert error.mean() < 0.4 * np.abs(noise).mean()


def test_no_plane_leans_over_a_step() -> None:
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    depth[:, 32:] = 2.5
    surface = fit(depth)
    tilt = np.arccos(np.clip(-surface.normals[surface.flat][:, 2], -1, 1))
    assert np.rad2deg(tilt).max() < 5
    assert not surface.flat[:, 31:33].any()
    np.testing.assert_array_equal(surface.inverse_depth[:, 31:33], 1 / depth[:, 31:33])


def test_nothing_is_said_where_nothing_was_measured() -> None:
    depth = np.zeros(CAMERA.shape, np.float32)
    depth[20, 20] = 2.0
    surface = fit(depth)
    assert not surface.flat.any()
    assert not surface.normals.any()
    assert (surface.inverse_depth > 0).sum() == 1


def test_the_kernel_agrees_with_its_slow_twin(monkeypatch: pytest.MonkeyPatch) -> None:
    pytest.importorskip('bdgs_ros._surface')
    rng = np.random.default_rng(3)
    depth = plane_depth(np.array([0.5, -0.3, -0.8]), 2.0)
    depth[:, 40:] = 1.2
    depth += rng.normal(0, 0.004, depth.shape).astype(np.float32) * (rng.random(depth.shape) < 0.5)
    depth[rng.random(depth.shape) < 0.2] = 0
    usable = (depth > 0) & (rng.random(depth.shape) < 0.9)
    wanted = rng.random(depth.shape) < 0.5
    tolerance = np.full(depth.shape, 0.003, np.float32)
    fast = fit_surface(depth, usable, wanted, CAMERA, 4, tolerance)
    monkeypatch.setattr(surface_module, '_kernels', None)
    slow = fit_surface(depth, usable, wanted, CAMERA, 4, tolerance)
    np.testing.assert_array_equal(fast.flat, slow.flat)
    assert not fast.flat[~wanted].any()
    assert 0.2 < fast.flat[wanted].mean() < 0.9
    np.testing.assert_allclose(fast.normals, slow.normals, atol=1e-6)
    np.testing.assert_allclose(fast.inverse_depth, slow.inverse_depth, rtol=1e-6)
