"""Division of Gaussians by the gradient of their positions."""

from dataclasses import replace

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.mapping.densify import PositionalGradient, divide
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.keyframes import MapKeyframe, build_levels
from bdgs_ros.mapping.rasterize import render
from bdgs_ros.mapping.refiner import Refiner

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)


def a_map(count: int = 30) -> GaussianMap:
    rng = np.random.default_rng(0)
    gaussians = GaussianMap(BeliefConfig())
    means = rng.uniform([-0.6, -0.4, 2.0], [0.6, 0.4, 2.2], (count, 3)).astype(np.float32)
    scales = np.tile(np.array([0.2, 0.05, 0.02], np.float32), (count, 1))
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    colors = rng.random((count, 3)).astype(np.float32)
    belief = np.linspace(0.1, 0.4, count).astype(np.float32)
    gaussians.append(NewGaussians(means, scales, colors, belief, quats), 0.6, 3)
    return gaussians


def test_two_halves_have_mean_and_variance_of_the_whole() -> None:
    gaussians = a_map()
    mean, belief = gaussians.means.copy(), gaussians.p_dynamic.copy()
    rows = np.array([4, 7])
    divide(gaussians, rows)
    assert len(gaussians) == 32
    np.testing.assert_allclose(
        (gaussians.means[rows] + gaussians.means[30:]) / 2, mean[rows], atol=1e-6
    )
    apart = np.linalg.norm(gaussians.means[rows] - mean[rows], axis=1)
    longest = np.exp(gaussians.log_scales[rows].max(axis=1))
    np.testing.assert_allclose(apart**2 + longest**2, 0.2**2, rtol=1e-4)
    np.testing.assert_array_equal(gaussians.p_dynamic[30:], belief[rows])
    np.testing.assert_array_equal(gaussians.keyframe_index[30:], 3)
    others = np.setdiff1d(np.arange(30), rows)
    np.testing.assert_array_equal(gaussians.means[others], mean[others])


def test_division_goes_along_the_longest_axis_in_world() -> None:
    gaussians = a_map(1)
    gaussians.quats[:] = [np.cos(np.pi / 4), 0, 0, np.sin(np.pi / 4)]  # x to y
    before = gaussians.means.copy()
    divide(gaussians, np.array([0]))
    step = gaussians.means[0] - before[0]
    np.testing.assert_allclose(np.abs(step), [0, 0.12, 0], atol=1e-5)


def test_the_strongest_are_those_pulled_most_in_the_image() -> None:
    gaussians = a_map(4)
    gaussians.means[:] = [[0, 0, 1], [0, 0, 2], [0, 0, 4], [0, 0, 1]]
    by_mean = np.array([[3, 0, 0], [2, 0, 0], [1.25, 0, 0], [9, 0, 0]], np.float32)
    pull = PositionalGradient(4)
    seen = np.array([True, True, True, False])
    for _ in range(2):
        pull.note(gaussians.means, by_mean, seen, se3.identity(), CAMERA)
    # in pixels: 3 x 1, 2 x 2, 1.25 x 4; the last was never seen
    assert pull.strongest(2).tolist() == [2, 1]
    assert len(pull.strongest(10)) == 3


def refined(rounds: int) -> GaussianMap:
    gaussians = a_map()
    color = (
        np.random.default_rng(1).integers(0, 256, (12, 16, 3), np.uint8).repeat(4, 0).repeat(4, 1)
    )
    depth = np.full(CAMERA.shape, 2.1, np.float32)
    levels = build_levels(color, depth, np.zeros(CAMERA.shape, bool), CAMERA, 1)
    keyframe = MapKeyframe(0, 0, np.eye(4), np.zeros(CAMERA.shape, np.uint8), levels)
    config = MappingConfig()
    config = replace(
        config, threads=1, densify=replace(config.densify, rounds=rounds, share=0.5),
        prune=replace(config.prune, max_gaussians=100),
    )  # fmt: skip
    refiner = Refiner(gaussians, [keyframe], config)
    for i in range(60):
        refiner.step(i / 60)
    return gaussians


def test_refinement_divides_within_the_budget_and_stays_sound() -> None:
    assert len(refined(0)) == 30
    more = refined(4)
    assert 50 < len(more) <= 100
    assert np.isfinite(more.means).all()
    view = render(more.as_gaussians(), np.eye(4), CAMERA)
    assert np.isfinite(view.color).all() and view.silhouette.max() > 0.5
