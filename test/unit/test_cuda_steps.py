"""
The optimisation on a card against that of the CPU, and the store of its parameters.

Run on a card where there is one, and everywhere on the emulation of its kernels.
"""

from __future__ import annotations

import copy
from dataclasses import replace

import numpy as np
import pytest
from cuda_devices import PLACES, open_device

from bdgs_ros.belief.fusion import State
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.mapping.cuda.kernels import Device
from bdgs_ros.mapping.cuda.steps import CudaSteps
from bdgs_ros.mapping.cuda.store import DeviceParameters
from bdgs_ros.mapping.densify import divide
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.groups import Groups
from bdgs_ros.mapping.keyframes import MapKeyframe, Window, build_levels
from bdgs_ros.mapping.parameters import PARAMETERS, RASTERISED, HostParameters
from bdgs_ros.mapping.rasterize import render
from bdgs_ros.mapping.steps import HostSteps, Steps
from bdgs_ros.mapping.vignette import Vignette

CAMERA = PinholeCamera(48, 36, 45.0, 45.0, 23.5, 17.5)
CONFIG = replace(MappingConfig(), threads=1, backend='auto')
VIGNETTE = Vignette(-0.1, 0.02)


@pytest.fixture(params=PLACES)
def device(request: pytest.FixtureRequest) -> Device:
    """Return where the kernels run."""
    return open_device(request.param)


def make_map(degree: int = 0, seed: int = 0) -> GaussianMap:
    """Gaussians on a slanted wall; some hidden, some called dynamic."""
    rng = np.random.default_rng(seed)
    depth = (2.0 + 0.3 * CAMERA.rays()[..., 0]).astype(np.float32)
    pixels = np.zeros(CAMERA.shape, bool)
    pixels[::3, ::3] = True
    means = CAMERA.unproject(depth)[pixels]
    count = len(means)
    scales = rng.uniform(0.02, 0.08, (count, 3)).astype(np.float32)
    new = NewGaussians(
        means,
        scales,
        rng.random((count, 3)).astype(np.float32),
        rng.uniform(0, 0.9, count).astype(np.float32),
        rng.normal(size=(count, 4)).astype(np.float32),
    )
    gaussians = GaussianMap(BeliefConfig(), degree)
    gaussians.append(new, 0.6, 0)
    gaussians.belief.hidden[::7] = True
    gaussians.belief.states[::5] = State.DYNAMIC
    if degree:
        harmonics = 0.1 * rng.normal(size=gaussians.harmonics.shape).astype(np.float32)
        gaussians.parameters['harmonics'] = harmonics
    return gaussians


def make_keyframes(gaussians: GaussianMap) -> list[MapKeyframe]:
    """Three views of other colours, each with something that moves and its own exposure."""
    rng = np.random.default_rng(7)
    keyframes = []
    for index in range(3):
        T = se3.exp(0.03 * rng.normal(size=6))
        seen = render(gaussians.as_gaussians(), se3.inverse(T), CAMERA, backend='torch')
        noise = rng.integers(-60, 60, seen.color.shape)
        color = np.clip(255 * seen.color + noise, 0, 255).astype(np.uint8)
        depth = (seen.depth / np.maximum(seen.silhouette, 1e-3)).astype(np.float32)
        moving = np.zeros(CAMERA.shape, bool)
        moving[5:15, 8 * index : 8 * index + 8] = True
        levels = build_levels(color, depth + 0.01, moving, CAMERA, 2, VIGNETTE)
        p_dynamic = np.zeros(CAMERA.shape, np.uint8)
        kept = MapKeyframe(index, index, T, p_dynamic, levels)
        kept.exposure = rng.normal(0, 0.05, 2).astype(np.float32)
        keyframes.append(kept)
    return keyframes


def take_some(steps: Steps, gaussians: GaussianMap, keyframes: list[MapKeyframe]) -> list[float]:
    """Eight steps on all levels, whole and by windows."""
    steps.begin(gaussians, keyframes)
    window = Window(slice(6, 30), slice(10, 42))
    for i in range(8):
        level = (i // 3) % 2
        part = window if level == 0 and i % 2 else None
        steps.take(keyframes[i % 3], level, part, rate_scale=1.5, pose_scale=0.5)
    steps.end()
    return steps.losses()


@pytest.mark.parametrize('degree', [0, 2])
def test_steps_agree_with_those_of_the_cpu(device: Device, degree: int) -> None:
    """Parameters, poses, exposures, losses and what is gathered, after eight steps."""
    ours, twin = make_map(degree), make_map(degree)
    seen, seen_twin = make_keyframes(ours), make_keyframes(twin)
    fast, slow = CudaSteps(CONFIG, device), HostSteps(replace(CONFIG, backend='torch'))
    pulls = fast.gather(len(ours)), slow.gather(len(twin))
    start = {name: twin.parameters[name].copy() for name in PARAMETERS}
    losses = take_some(fast, ours, seen)
    np.testing.assert_allclose(losses, take_some(slow, twin, seen_twin), rtol=1e-4)
    assert isinstance(ours.parameters, DeviceParameters)
    for name in RASTERISED:
        moved = np.abs(twin.parameters[name] - start[name])
        apart = np.abs(ours.parameters[name] - twin.parameters[name])
        assert apart.max() < 1e-3 * moved.max(), name
    if degree:  # the CPU looks from the means as they are after the step, and noise has its sign
        moved = np.abs(twin.harmonics - start['harmonics'])
        assert np.abs(ours.harmonics - twin.harmonics).mean() < 0.05 * moved.mean()
    for a, b in zip(seen, seen_twin, strict=True):
        np.testing.assert_allclose(a.T_world_camera, b.T_world_camera, atol=2e-6)
        np.testing.assert_allclose(a.exposure, b.exposure, atol=1e-5)
        np.testing.assert_allclose(a.pose_moments[0], b.pose_moments[0], rtol=2e-2, atol=1e-5)
    one, other = (set(pull.strongest(40).tolist()) for pull in pulls if pull is not None)
    assert len(one & other) >= 38


def test_what_is_hidden_is_frozen_and_the_first_keyframe_stays(device: Device) -> None:
    gaussians = make_map()
    keyframes = make_keyframes(gaussians)
    before = {name: gaussians.parameters[name].copy() for name in RASTERISED}
    poses = [k.T_world_camera.copy() for k in keyframes]
    take_some(CudaSteps(CONFIG, device), gaussians, keyframes)
    for name in RASTERISED:
        np.testing.assert_array_equal(gaussians.parameters[name][::7], before[name][::7])
        assert (gaussians.parameters[name][1::7] != before[name][1::7]).any()
    moved = [
        not np.array_equal(k.T_world_camera, T) for k, T in zip(keyframes, poses, strict=True)
    ]
    assert moved == [False, True, True]


def test_same_input_same_result(device: Device) -> None:
    results = []
    for _ in range(2):
        gaussians = make_map()
        losses = take_some(CudaSteps(CONFIG, device), gaussians, make_keyframes(gaussians))
        results.append((losses, {name: gaussians.parameters[name] for name in RASTERISED}))
    assert results[0][0] == results[1][0]
    for name in RASTERISED:
        np.testing.assert_array_equal(results[0][1][name], results[1][1][name], err_msg=name)


def test_images_are_forgotten_with_their_keyframes(device: Device) -> None:
    gaussians = make_map()
    keyframes = make_keyframes(gaussians)
    steps = CudaSteps(CONFIG, device)
    take_some(steps, gaussians, keyframes)
    assert len(steps._images._copies) == 3 * 2 * 3  # keyframes, levels, images
    steps.begin(gaussians, keyframes[:1])
    del keyframes[1:]
    assert len(steps._images._copies) == 1 * 2 * 3


def random_moments(gaussians: GaussianMap) -> None:
    """Give Adam something to remember."""
    rng = np.random.default_rng(3)
    assert isinstance(gaussians.parameters, HostParameters)
    for name, moments in gaussians.parameters.moments.items():
        for m in moments:
            m[:] = rng.random(m.shape, np.float32)
        assert gaussians.parameters[name].shape == moments[0].shape


def test_the_map_changes_on_the_card_as_on_the_cpu(device: Device) -> None:
    """Every way in which Gaussians come, go and move; with their moments."""
    twin = make_map(degree=1)
    random_moments(twin)
    ours = copy.deepcopy(twin)
    assert isinstance(ours.parameters, HostParameters)
    ours.parameters = DeviceParameters(ours.parameters, device)
    rng = np.random.default_rng(0)
    new = NewGaussians(
        *(rng.random(s).astype(np.float32) for s in ((9, 3), (9, 3), (9, 3), 9, (9, 4)))
    )
    keep = rng.random(len(twin) + 9) > 0.3
    groups = Groups(rng.integers(0, 5, keep.sum()), np.arange(5), np.ones(keep.sum(), np.float32))
    pooled = {n: rng.random((5, *twin.parameters[n].shape[1:]), np.float32) for n in PARAMETERS}
    for gaussians in (twin, ours):
        gaussians.append(new, 0.5, 1)
        gaussians.keep(keep)
    assert_same(ours, twin)
    for gaussians in (twin, ours):
        divide(gaussians, np.array([3, 8]))
        gaussians.deform({0: se3.exp(np.array([0.1, 0.2, 0.3, 0.1, 0, 0]))})
    assert_same(ours, twin)
    for gaussians in (twin, ours):
        gaussians.keep(np.arange(len(gaussians)) < len(gaussians) - 2)
        gaussians.pool(groups, pooled)
    assert_same(ours, twin)
    for gaussians in (twin, ours):
        gaussians.resize_colors(2)
    assert_same(ours, twin)


def assert_same(ours: GaussianMap, twin: GaussianMap) -> None:
    """Compare values and moments, read through copies and without."""
    assert isinstance(ours.parameters, DeviceParameters)
    assert isinstance(twin.parameters, HostParameters)
    for name in PARAMETERS:
        expected = twin.parameters[name]
        np.testing.assert_array_equal(ours.parameters[name], expected, err_msg=name)
        np.testing.assert_array_equal(ours.parameters.values[name].cpu().numpy(), expected)
        for m, n in zip(ours.parameters.moments[name], twin.parameters.moments[name], strict=True):
            np.testing.assert_array_equal(m.cpu().numpy(), n, err_msg=name)


def test_a_copy_of_what_is_on_the_card_cannot_be_changed(device: Device) -> None:
    gaussians = make_map()
    assert isinstance(gaussians.parameters, HostParameters)
    gaussians.parameters = DeviceParameters(gaussians.parameters, device)
    with pytest.raises(ValueError, match='read-only'):
        gaussians.means[:] = 0
    gaussians.parameters['means'] = gaussians.means + 1
    with pytest.raises(ValueError, match='read-only'):
        gaussians.means[:] = 0
