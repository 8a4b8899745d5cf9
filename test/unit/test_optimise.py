"""Eq. 7, 12 and 13 in the optimiser."""

from dataclasses import replace
from itertools import chain, repeat

import numpy as np
import pytest

from bdgs_ros.belief.fusion import State
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.keyframes import MapKeyframe, build_levels
from bdgs_ros.mapping.optimise import Optimiser
from bdgs_ros.mapping.rasterize import render
from bdgs_ros.mapping.steps import least_logit

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
CONFIG = replace(MappingConfig(), iterations=40, threads=1)


def scene(seed: int = 0, grey: bool = True) -> tuple[GaussianMap, MapKeyframe]:
    """Gaussians on a plane, and a keyframe of them; `grey` then takes their colours away."""
    rng = np.random.default_rng(seed)
    depth = np.full(CAMERA.shape, 2.0, np.float32)
    pixels = np.zeros(CAMERA.shape, bool)
    pixels[::2, ::2] = True
    means = CAMERA.unproject(depth)[pixels]
    count = len(means)
    colors = rng.random((count, 3)).astype(np.float32)
    gaussians = GaussianMap(BeliefConfig())
    scales = np.full(count, 0.03, np.float32)
    gaussians.append(NewGaussians(means, scales, colors, np.full(count, 0.3, np.float32)), 0.8, 0)
    image = render(gaussians.as_gaussians(), np.eye(4), CAMERA).color
    if grey:
        gaussians.parameters['colors'][:] = 0.5
    color = (255 * np.clip(image, 0, 1)).astype(np.uint8)
    levels = build_levels(color, depth, np.zeros(CAMERA.shape, bool), CAMERA, 3)
    keyframe = MapKeyframe(1, 0, np.eye(4), np.zeros(CAMERA.shape, np.uint8), levels)
    return gaussians, keyframe


def test_the_loss_falls() -> None:
    gaussians, keyframe = scene()
    losses = Optimiser(CONFIG).run(gaussians, keyframe, [])
    assert len(losses) == CONFIG.iterations
    assert losses[-1] < 0.8 * losses[-20]


def test_levels_go_from_coarse_to_fine() -> None:
    levels = list(Optimiser(CONFIG)._levels(3))
    assert levels == sorted(levels, reverse=True)
    assert len(levels) == CONFIG.iterations
    assert set(levels) == {0, 1, 2}
    assert levels.count(0) == CONFIG.iterations - round(
        CONFIG.iterations * CONFIG.pyramid.coarse_share
    )


def test_one_level_takes_all_iterations() -> None:
    assert list(Optimiser(CONFIG)._levels(1)) == [0] * CONFIG.iterations


def test_opacity_threshold_doubles_with_each_coarser_level() -> None:
    tau = CONFIG.pyramid.opacity_threshold
    alpha = np.array([0.9 * tau, 1.1 * tau, 2.2 * tau, 4.4 * tau])
    logit = np.log(alpha / (1 - alpha)).astype(np.float32)
    counts = [int((logit > least_logit(CONFIG, level)).sum()) for level in range(3)]
    assert counts == [3, 2, 1]


def test_half_of_the_iterations_look_at_the_newest_keyframe() -> None:
    _, newest = scene()
    _, other = scene(1)
    coarse, fine = Optimiser(CONFIG)._plan(newest, [other])
    assert len(coarse) + len(fine) == CONFIG.iterations
    assert sum(kf is newest for kf, _ in coarse + fine) == CONFIG.iterations // 2
    assert {level for _, level in fine} == {0}


def test_fewer_iterations_where_the_coarse_ones_gain_nothing() -> None:
    gaussians, keyframe = scene()
    patient = replace(CONFIG, enough=-1e9)
    assert len(Optimiser(patient).run(gaussians, keyframe, [])) == CONFIG.iterations
    hasty = replace(CONFIG, enough=1.0, min_fine=2)
    coarse, _ = Optimiser(hasty)._plan(keyframe, [])
    assert len(Optimiser(hasty).run(gaussians, keyframe, [])) == len(coarse) + 2


@pytest.mark.parametrize('least', [0, 2, 20])
def test_in_a_hurry_iterations_end_where_enough_is_done(least: int) -> None:
    gaussians, keyframe = scene()
    config = replace(CONFIG, enough=-1e9, hurried=least)
    hurried = chain([False, False], repeat(True))
    optimiser = Optimiser(config, lambda: next(hurried))
    assert len(optimiser.run(gaussians, keyframe, [])) == least + 2


def test_windows_cover_a_large_image() -> None:
    _, keyframe = scene()
    level = keyframe.levels[0]
    optimiser = Optimiser(replace(CONFIG, step_pixels=level.depth_m.size // 4))
    seen = np.zeros(level.camera.shape, int)
    camera = level.camera
    for _ in range(200):
        part = level.cut(optimiser._look(keyframe, 0))
        assert part.depth_m.size == pytest.approx(level.depth_m.size / 4, rel=0.1)
        x, y = round(camera.cx - part.camera.cx), round(camera.cy - part.camera.cy)
        np.testing.assert_array_equal(
            part.image, level.image[y : y + part.camera.height, x : x + part.camera.width]
        )
        seen[y : y + part.camera.height, x : x + part.camera.width] += 1
    assert seen.min() >= 10


def test_a_keyframe_that_is_a_little_off_moves_back_but_the_first_stays() -> None:
    for index, moves in ((0, False), (1, True)):
        gaussians, keyframe = scene(grey=False)
        keyframe.index = index
        true = keyframe.T_world_camera
        off = se3.exp(np.array([0.01, 0.0, 0.0, 0.0, 0.0, 0.0])) @ true
        keyframe.T_world_camera = off
        still = replace(CONFIG.rate, means=0.0, quats=0.0, scales=0.0, colors=0.0, opacities=0.0)
        config = replace(CONFIG, rate=replace(still, pose=0.001), iterations=40, enough=-1e9)
        Optimiser(config).run(gaussians, keyframe, [])
        left = np.linalg.norm(keyframe.T_world_camera[:3, 3] - true[:3, 3])
        assert (left < 0.008) == moves


def test_hidden_gaussians_are_frozen() -> None:
    gaussians, keyframe = scene()
    gaussians.belief.hidden[:100] = True
    gaussians.belief.belief[:100] = 0.9
    before = {
        name: array[:100].copy() for name, array in gaussians.parameters.rasterised().items()
    }
    Optimiser(CONFIG).run(gaussians, keyframe, [])
    for name, array in before.items():
        np.testing.assert_array_equal(gaussians.parameters[name][:100], array, err_msg=name)


def test_the_penalty_makes_dynamic_gaussians_fainter() -> None:
    """Second term of Eq. 7, on Gaussians between the decision and the mask."""
    faint = []
    for weight in (0.0, 0.15):
        gaussians, keyframe = scene()
        gaussians.belief.states[:100] = State.DYNAMIC
        loss = replace(CONFIG.loss, dynamic=weight)
        Optimiser(replace(CONFIG, loss=loss)).run(gaussians, keyframe, [])
        faint.append(float(gaussians.logit_opacities[:100].mean()))
    assert faint[1] < faint[0]


def test_exposure_is_fitted_except_for_the_first_keyframe() -> None:
    for index, moves in ((0, False), (1, True)):
        gaussians, keyframe = scene()
        keyframe.index = index
        brighter = tuple(
            replace(level, image=np.clip(1.3 * level.image, 0, 255).astype(np.uint8))
            for level in keyframe.levels
        )
        keyframe.levels = brighter
        Optimiser(CONFIG).run(gaussians, keyframe, [])
        assert (abs(keyframe.exposure[0]) > 0.005) == moves


def test_settling_moves_the_map_and_no_keyframe_and_ends_when_one_waits() -> None:
    gaussians, keyframe = scene()
    before, pose = gaussians.colors.copy(), keyframe.T_world_camera.copy()
    waits = iter([False, False, True])
    optimiser = Optimiser(CONFIG, lambda: next(waits))
    optimiser.settle(gaussians, [keyframe] * 5, 0.5)
    assert len(optimiser._steps.losses()) == 2
    assert np.abs(gaussians.colors - before).max() > 1e-3
    np.testing.assert_array_equal(keyframe.T_world_camera, pose)
