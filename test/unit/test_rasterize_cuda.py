"""
The kernels for CUDA against the float64 torch twin.

On a card where there is one, and everywhere on their emulation (src/cuda/emulate.hpp), so that the
same source is always exercised. Errors are max |a - b| / max |b|; emulated they measured 7e-7 in
images and 6e-6 in gradients at most. The limits leave room for the exponential of a card.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace
from importlib.machinery import ModuleSpec
from types import SimpleNamespace

import numpy as np
import pytest
import torch
from cuda_devices import PLACES, emulated, open_device

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import MapError
from bdgs_ros.mapping import rasterize
from bdgs_ros.mapping.cuda import kernels
from bdgs_ros.mapping.cuda.backend import CudaBackend
from bdgs_ros.mapping.cuda.kernels import Device
from bdgs_ros.mapping.rasterize import (
    FusedResult,
    Gaussians,
    Gradients,
    LossWeights,
    Rendered,
    backward,
    fused_step,
    render,
)

CAMERA = PinholeCamera(45, 37, 45.0, 47.0, 21.3, 18.3)  # no multiple of the tile
T_CAMERA_WORLD = se3.exp(np.array([0.1, -0.2, 0.3, 0.2, -0.3, 0.4]))
WEIGHTS = LossWeights(color=0.85, ssim=0.2, depth=0.3, smooth=0.4, empty=0.1)
EXPOSURE = (0.1, -0.02)
PARAMETERS = ('means', 'quats', 'log_scales', 'logit_opacities', 'colors')
IMAGES, GRADIENTS = 5e-6, 5e-5
"""Limits of the errors."""


@pytest.fixture(params=PLACES)
def cuda(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Return the backend's name, which stands for the card or for the emulation."""
    backend, others = CudaBackend(open_device(request.param)), rasterize._backend
    chosen = lambda name: backend if name == 'cuda' else others(name)  # noqa: E731
    monkeypatch.setattr(rasterize, '_backend', chosen)
    return 'cuda'


def make_gaussians(count: int = 150, seed: int = 0, max_logit: float = 0.8) -> Gaussians:
    """Gaussians in and around the view, some behind it; at most 0.69 opaque by default."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 4, count)
    u, v = rng.uniform(-6, 51, count), rng.uniform(-6, 43, count)
    x, y = (u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z
    points = np.stack([x, y, np.where(rng.uniform(size=count) < 0.05, -z, z)], axis=1)
    arrays = (
        (points - T_CAMERA_WORLD[:3, 3]) @ T_CAMERA_WORLD[:3, :3],
        2 * rng.normal(size=(count, 4)),
        np.log(rng.uniform(0.01, 0.25, (count, 3))),
        np.minimum(2 * rng.normal(size=count), max_logit),
        rng.uniform(size=(count, 3)),
        rng.uniform(size=count),
    )
    return Gaussians(*(a.astype(np.float32) for a in arrays))


def make_target(g: Gaussians, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour near the rendering, depth with holes, weights with masked pixels."""
    rng = np.random.default_rng(seed)
    shape = CAMERA.shape
    color = 0.8 * render(g, T_CAMERA_WORLD, CAMERA, backend='torch').color
    color += 0.2 * rng.uniform(size=(*shape, 3)) + 0.03
    depth = rng.uniform(1, 4, shape) * (rng.uniform(size=shape) > 0.2)
    weight = rng.uniform(size=shape) * (rng.uniform(size=shape) > 0.2)
    return color.astype(np.float32), depth.astype(np.float32), weight.astype(np.float32)


def step(
    g: Gaussians,
    target: tuple[np.ndarray, ...],
    backend: str,
    weights: LossWeights = WEIGHTS,
    active: np.ndarray | None = None,
) -> FusedResult:
    """Call fused_step with this file's camera, pose and exposure."""
    color, depth, weight = target
    how = {'exposure': EXPOSURE, 'active': active, 'with_images': True, 'backend': backend}
    return fused_step(g, T_CAMERA_WORLD, CAMERA, color, depth, weight, weights, **how)


def make_derivatives(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return arbitrary derivatives by colour, depth and silhouette."""
    rng = np.random.default_rng(seed)
    shape = CAMERA.shape
    color, depth, silhouette = (rng.normal(size=s) for s in ((*shape, 3), shape, shape))
    return color, depth, silhouette


def error(a: np.ndarray, b: np.ndarray) -> float:
    """Return max |a - b| / max |b|."""
    return float(np.abs(a - b).max() / np.abs(b).max())


def assert_gradients_agree(a: Gradients, b: Gradients, limit: float = GRADIENTS) -> None:
    """Compare all gradients."""
    for name in (*PARAMETERS, 'pose'):
        ours, twin = getattr(a, name), getattr(b, name)
        assert ours.dtype == twin.dtype and ours.shape == twin.shape, name
        assert error(ours, twin) < limit, name


@pytest.mark.parametrize('seed', range(3))
def test_images_and_statistics_agree_with_twin(cuda: str, seed: int) -> None:
    """Forward; depth along the ray as well."""
    g = make_gaussians(seed=seed)
    ours = render(g, T_CAMERA_WORLD, CAMERA, statistics=True, backend=cuda)
    twin = render(g, T_CAMERA_WORLD, CAMERA, statistics=True, backend='torch')
    for field in Rendered.__dataclass_fields__:
        a, b = getattr(ours, field), getattr(twin, field)
        assert a.dtype == np.float32 and a.shape == b.shape and a.flags.c_contiguous, field
        assert error(a, b) < IMAGES, field
    assert twin.silhouette.mean() > 0.4


@pytest.mark.parametrize('seed', range(3))
def test_gradients_agree_with_twin(cuda: str, seed: int) -> None:
    """Backward from arbitrary derivatives, the pose's in the same convention."""
    g, given = make_gaussians(seed=seed), make_derivatives(seed)
    ours = backward(g, T_CAMERA_WORLD, CAMERA, *given, backend=cuda)
    assert_gradients_agree(ours, backward(g, T_CAMERA_WORLD, CAMERA, *given, backend='torch'))


@pytest.mark.parametrize('seed', range(3))
def test_fused_step_agrees_with_twin(cuda: str, seed: int) -> None:
    """Loss and its terms, all gradients, visibility without a pass of its own."""
    g = make_gaussians(seed=seed)
    target = make_target(g)
    ours, twin = step(g, target, cuda), step(g, target, 'torch')
    for field in ('loss', 'l1', 'ssim', 'depth', 'smooth', 'empty'):
        assert getattr(ours, field) == pytest.approx(getattr(twin, field), rel=1e-4), field
        assert getattr(twin, field) > 0
    assert_gradients_agree(ours.gradients, twin.gradients)
    assert error(ours.exposure_gradient, twin.exposure_gradient) < GRADIENTS
    assert error(ours.visibility, twin.visibility) < IMAGES
    assert ours.rendered is not None and twin.rendered is not None
    assert error(ours.rendered.p_dynamic, twin.rendered.p_dynamic) < IMAGES


@pytest.mark.parametrize(
    'weights',
    [
        LossWeights(1.0, 0.0, 0.0),
        LossWeights(1.0, 1.0, 0.0),
        LossWeights(0.0, 0.0, 1.0),
        LossWeights(0.0, 0.0, 0.0, 1.0),
    ],
    ids=['color', 'ssim', 'depth', 'smooth'],
)
def test_each_loss_term_agrees_alone(cuda: str, weights: LossWeights) -> None:
    """No term hides behind another."""
    g = make_gaussians(seed=3)
    target = make_target(g)
    ours, twin = step(g, target, cuda, weights), step(g, target, 'torch', weights)
    assert ours.loss == pytest.approx(twin.loss, rel=1e-4)
    for name in ('means', 'quats', 'log_scales', 'logit_opacities', 'pose'):
        a, b = getattr(ours.gradients, name), getattr(twin.gradients, name)
        assert error(a, b) < GRADIENTS, name


@pytest.mark.parametrize('seed', range(3))
def test_opaque_gaussians_agree_too(cuda: str, seed: int) -> None:
    """Alpha is cut and pixels end where the twin's do."""
    g = make_gaussians(seed=seed, max_logit=99.0)
    g = replace(g, logit_opacities=2 * g.logit_opacities)
    ours = render(g, T_CAMERA_WORLD, CAMERA, backend=cuda)
    twin = render(g, T_CAMERA_WORLD, CAMERA, backend='torch')
    assert error(ours.silhouette, twin.silhouette) < IMAGES
    given = make_derivatives(seed)
    a = backward(g, T_CAMERA_WORLD, CAMERA, *given, backend=cuda)
    assert_gradients_agree(a, backward(g, T_CAMERA_WORLD, CAMERA, *given, backend='torch'))


def test_results_repeat_to_the_last_bit(cuda: str) -> None:
    """No sum depends on who comes first."""
    g, given = make_gaussians(seed=5), make_derivatives(5)
    one, other = (backward(g, T_CAMERA_WORLD, CAMERA, *given, backend=cuda) for _ in range(2))
    for name in (*PARAMETERS, 'pose'):
        np.testing.assert_array_equal(getattr(one, name), getattr(other, name), err_msg=name)


def test_depth_of_a_slanted_gaussian_follows_its_plane(cuda: str) -> None:
    """A large flat Gaussian turned by 40 degrees: depth over silhouette is its plane's."""
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    turn = np.deg2rad(40)
    row = (
        [[0.0, 0.0, 2.0]],
        [[np.cos(turn / 2), 0, np.sin(turn / 2), 0]],
        np.log([[0.2, 0.2, 1e-4]]),
        [2.0],
        [[0.2, 0.4, 0.6]],
        [0.5],
    )
    g = Gaussians(*(np.array(a, np.float32) for a in row))
    seen = render(g, np.eye(4), camera, backend=cuda)
    rays = camera.rays()
    near = (slice(20, 28), slice(28, 36))  # the mean is affine, the plane only nearly
    plane = 2.0 / (1 + np.tan(turn) * rays[..., 0])
    depth = seen.depth[near] / seen.silhouette[near]
    np.testing.assert_allclose(depth, plane[near], rtol=5e-3)


def test_masked_pixels_have_no_influence(cuda: str) -> None:
    """Whatever the target holds where the weight is 0, NaN included."""
    g = make_gaussians()
    color, depth, weight = make_target(g)
    weight[10:30, 5:25] = 0
    before = step(g, (color, depth, weight), cuda)
    color, depth = color.copy(), depth.copy()
    color[weight == 0], depth[weight == 0] = np.nan, np.nan
    after = step(g, (color, depth, weight), cuda)
    assert after.loss == pytest.approx(before.loss, rel=1e-6)
    assert_gradients_agree(before.gradients, after.gradients, 1e-5)
    nothing = step(g, (color, depth, np.zeros_like(weight)), cuda)
    assert nothing.loss == 0
    assert not any(a.any() for a in nothing.gradients.parameters())
    assert nothing.visibility.any()


def test_inactive_gaussians_are_as_if_absent(cuda: str) -> None:
    """M_g of Eq. 11."""
    g = make_gaussians()
    active = np.random.default_rng(0).uniform(size=len(g)) > 0.4
    kept = Gaussians(*(a[active] for a in g.arrays()))
    target = make_target(g)
    masked, absent = step(g, target, cuda, active=active), step(kept, target, cuda)
    assert masked.rendered is not None and absent.rendered is not None
    assert error(masked.rendered.depth, absent.rendered.depth) < 1e-6
    for a, b in zip(masked.gradients.parameters(), absent.gradients.parameters(), strict=True):
        assert error(a[active], b) < 1e-5
        assert not a[~active].any()
    assert not masked.visibility[~active].any() and masked.visibility[active].any()
    seen = render(g, T_CAMERA_WORLD, CAMERA, active=active, statistics=True, backend=cuda)
    assert seen.radius is not None and not seen.radius[~active].any()


def test_empty_and_unseen_maps_render_black(cuda: str) -> None:
    """No Gaussians; all behind the camera; parameters that are not numbers."""
    g = make_gaussians(20)
    behind = T_CAMERA_WORLD.copy()
    behind[2, 3] -= 50
    broken = [replace(g, **{n: np.full_like(getattr(g, n), np.nan)}) for n in PARAMETERS]
    zeros = (np.zeros((*CAMERA.shape, 3)), np.ones(CAMERA.shape), np.ones(CAMERA.shape))
    for gaussians, pose in (
        (make_gaussians(0), T_CAMERA_WORLD),
        (g, behind),
        *((b, T_CAMERA_WORLD) for b in broken),
    ):
        seen = render(gaussians, pose, CAMERA, statistics=True, backend=cuda)
        assert not seen.color.any() and not seen.silhouette.any()
        assert seen.radius is not None and not seen.radius.any()
        result = fused_step(gaussians, pose, CAMERA, *zeros, WEIGHTS, backend=cuda)
        assert not any(a.any() for a in result.gradients.parameters())
        assert not result.gradients.pose.any() and not result.visibility.any()


@pytest.fixture
def fresh_choice(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """Let the kernels look compiled; forget which backends were found, before and after."""
    caches = (rasterize.available_backends, rasterize._backend)
    for cached in caches:
        cached.cache_clear()
    monkeypatch.setattr(rasterize, 'find_spec', lambda name: ModuleSpec(name, None))
    yield monkeypatch
    monkeypatch.undo()
    for cached in caches:
        cached.cache_clear()


def test_auto_takes_the_card_first(fresh_choice: pytest.MonkeyPatch) -> None:
    """Named first among the available; overridden by name."""
    fresh_choice.setattr(kernels, 'obstacle', lambda: None)
    device = Device(emulated(), 'cpu')
    fresh_choice.setattr(kernels, 'device', lambda: device)
    assert rasterize.available_backends()[0] == 'cuda'
    chosen = rasterize._backend('auto')
    assert isinstance(chosen, CudaBackend)
    assert rasterize.map_device('auto') is device
    assert rasterize.map_device('torch') is None


def test_a_card_that_cannot_be_used_is_not_available_and_why_is_logged(
    fresh_choice: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Asked for by name, it is refused."""
    fresh_choice.setattr(kernels, 'obstacle', lambda: 'torch sees no CUDA device')
    with caplog.at_level(logging.INFO):
        assert 'cuda' not in rasterize.available_backends()
        rasterize._backend('auto')
    assert any('torch sees no CUDA device' in r.message for r in caplog.records)
    with pytest.raises(MapError, match=r"'cuda' cannot run here; available: .*torch"):
        rasterize._backend('cuda')


def test_auto_falls_back_where_the_card_does_not_start(
    fresh_choice: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """One warning, and the CPU serves. By name it is an error."""
    fresh_choice.setattr(kernels, 'obstacle', lambda: None)

    def refuse() -> None:
        raise MapError('the CUDA kernels cannot run on cuda: driver too old')

    fresh_choice.setattr(kernels, 'device', refuse)
    with caplog.at_level(logging.WARNING):
        assert not isinstance(rasterize._backend('auto'), CudaBackend)
    assert sum('driver too old' in r.message for r in caplog.records) == 1
    with pytest.raises(MapError, match='driver too old'):
        rasterize._backend('cuda')


def test_obstacles_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """Not compiled; no device; otherwise none."""
    monkeypatch.setattr(kernels, 'is_built', lambda: False)
    assert 'not compiled' in str(kernels.obstacle())
    monkeypatch.setattr(kernels, 'is_built', lambda: True)
    monkeypatch.setattr(torch.cuda, 'is_available', lambda: False)
    assert kernels.obstacle() == 'torch sees no CUDA device'
    monkeypatch.setattr(torch.cuda, 'is_available', lambda: True)
    assert kernels.obstacle() is None


def test_a_device_that_fails_says_where() -> None:
    def fail() -> None:
        raise RuntimeError('memory of the device: out of memory')

    with pytest.raises(MapError, match=r'cannot run on cpu: .*out of memory'):
        Device(SimpleNamespace(Rasterizer=fail), 'cpu')  # type: ignore[arg-type]
