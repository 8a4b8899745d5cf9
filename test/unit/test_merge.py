"""Merging keeps what the map looks like, and only like goes to like."""

from dataclasses import replace

import numpy as np

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.merge import merge_down_to
from bdgs_ros.mapping.rasterize import render

CONFIG = MappingConfig().merge
CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)


def wall(spacing: float, colors: np.ndarray | None = None) -> GaussianMap:
    """Flat static Gaussians on the plane z = 2 m."""
    x, y = np.meshgrid(np.arange(-0.8, 0.8, spacing), np.arange(-0.6, 0.6, spacing))
    means = np.stack([x.ravel(), y.ravel(), np.full(x.size, 2.0)], axis=1).astype(np.float32)
    scales = np.tile(np.array([spacing, spacing, 0.1 * spacing], np.float32), (len(means), 1))
    colors = np.full((len(means), 3), 0.5, np.float32) if colors is None else colors
    gaussians = GaussianMap(BeliefConfig())
    belief = np.full(len(means), 0.05, np.float32)
    gaussians.append(NewGaussians(means, scales, colors, belief), 0.7, 3)
    return gaussians


def test_a_plain_wall_looks_the_same_with_fewer_gaussians() -> None:
    gaussians = wall(0.02)
    rng = np.random.default_rng(0)
    gaussians.contribution[:] = rng.uniform(0, 1, len(gaussians))
    before = render(gaussians.as_gaussians(), np.eye(4), CAMERA)
    count = len(gaussians)
    merge_down_to(gaussians, round(0.7 * count), CONFIG)
    assert len(gaussians) < 0.75 * count
    after = render(gaussians.as_gaussians(), np.eye(4), CAMERA)
    inner = (slice(6, -6), slice(6, -6))
    assert np.abs(after.color - before.color)[inner].mean() < 0.02
    depth = (after.depth / np.maximum(after.silhouette, 1e-6))[inner]
    assert np.abs(depth - 2.0).max() < 0.01


def test_nothing_happens_within_the_budget() -> None:
    gaussians = wall(0.05)
    means = gaussians.means.copy()
    merge_down_to(gaussians, len(gaussians), CONFIG)
    np.testing.assert_array_equal(gaussians.means, means)


def test_other_colours_do_not_merge() -> None:
    gaussians = wall(0.02)
    gaussians.parameters['colors'][:] = np.random.default_rng(0).permutation(
        np.linspace(0, 100, 3 * len(gaussians), dtype=np.float32).reshape(-1, 3)
    )
    count = len(gaussians)
    merge_down_to(gaussians, count // 2, replace(CONFIG, color=1e-3))
    assert len(gaussians) == count


def test_what_is_hidden_or_uncertain_stays() -> None:
    gaussians = wall(0.02)
    gaussians.belief.belief[::2] = 0.9
    gaussians.belief.smoothed[::2] = 0.9
    hidden = (gaussians.belief.smoothed > 0.5).sum()
    merge_down_to(gaussians, len(gaussians) // 4, CONFIG)
    assert (gaussians.belief.smoothed > 0.5).sum() == hidden


def test_two_become_the_gaussian_with_their_moments() -> None:
    gaussians = GaussianMap(BeliefConfig())
    means = np.array([[0.001, 0.001, 2.0], [0.009, 0.001, 2.0]], np.float32)
    scales = np.full((2, 3), 0.015, np.float32)
    belief = np.array([0.02, 0.06], np.float32)
    colors = np.array([[0.5, 0.5, 0.5], [0.52, 0.5, 0.5]], np.float32)
    gaussians.append(NewGaussians(means, scales, colors, belief), 0.7, 7)
    gaussians.keyframe_index[:] = [7, 4]
    gaussians.observations[:] = [2, 9]
    merge_down_to(gaussians, 1, replace(CONFIG, reach=1.0))
    assert len(gaussians) == 1
    np.testing.assert_allclose(gaussians.means, [[0.005, 0.001, 2.0]], atol=1e-5)
    variance = np.sort(np.exp(2 * gaussians.log_scales[0]))
    np.testing.assert_allclose(variance, [0.015**2, 0.015**2, 0.015**2 + 0.004**2], rtol=1e-3)
    np.testing.assert_allclose(gaussians.colors, [[0.51, 0.5, 0.5]], atol=1e-4)
    np.testing.assert_allclose(gaussians.belief.belief, [0.04], atol=1e-4)
    assert gaussians.keyframe_index.tolist() == [4]
    assert gaussians.observations.tolist() == [9]
    assert len(gaussians.parameters.moments['means'][0]) == 1
    assert gaussians.belief.hidden.tolist() == [False]
