"""
The gsplat backend against the float64 torch twin.

On CUDA where there is a device and gsplat, and everywhere on the CPU with `gsplat_stand_in` in
gsplat's place, so that packing, channels, masks, statistics and the pose's gradient are always
exercised. Errors are max |a - b| / max |b|; with the stand-in they measured 4e-6 at most where
nothing is opaque. The limits leave room for CUDA's approximate exponential.
"""

from __future__ import annotations

import logging
import os
import subprocess
import sys
from collections.abc import Iterator
from dataclasses import replace
from importlib.machinery import ModuleSpec
from types import SimpleNamespace

import gsplat_stand_in
import numpy as np
import pytest
import torch

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import MapError
from bdgs_ros.mapping import rasterize, rasterize_gsplat
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
from bdgs_ros.mapping.rasterize_torch import image_loss
from bdgs_ros.mapping.rasterize_types import Scene, Target

CAMERA = PinholeCamera(45, 37, 45.0, 47.0, 21.3, 18.3)  # no multiple of the tile
T_CAMERA_WORLD = se3.exp(np.array([0.1, -0.2, 0.3, 0.2, -0.3, 0.4]))
WEIGHTS = LossWeights(color=0.85, ssim=0.2, depth=0.3, smooth=0.4, empty=0.1)
EXPOSURE = (0.1, -0.02)
PARAMETERS = ('means', 'quats', 'log_scales', 'logit_opacities', 'colors')
IMAGES, GRADIENTS = 2e-5, 2e-4
"""Limits of the errors."""
RealBackend = rasterize_gsplat.GsplatBackend


def no_cuda() -> str | None:
    """Return why gsplat itself cannot run here."""
    if rasterize.find_spec('gsplat') is None:
        return 'gsplat is not installed: pip install .[cuda] on a machine with a CUDA device'
    return rasterize_gsplat.obstacle()


@pytest.fixture(params=['stand-in', 'cuda'])
def gsplat(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> Iterator[str]:
    """Return the backend's name, which stands for gsplat itself or for the stand-in."""
    reason = no_cuda()
    if request.param == 'cuda' and reason is not None:
        if 'BDGS_REQUIRE_CUDA' in os.environ:  # `make cuda-check`
            pytest.fail(reason)
        pytest.skip(reason)
    if request.param == 'stand-in':
        threads = torch.get_num_threads()
        torch.set_num_threads(1)
        stand_in = lambda: RealBackend(gsplat_stand_in, 'cpu')  # noqa: E731
        monkeypatch.setattr(rasterize_gsplat, 'GsplatBackend', stand_in)
        monkeypatch.setattr(rasterize, 'available_backends', lambda: ('gsplat', 'torch'))
    rasterize._backend.cache_clear()
    yield 'gsplat'
    rasterize._backend.cache_clear()
    if request.param == 'stand-in':
        torch.set_num_threads(threads)


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
def test_images_and_statistics_agree_with_twin(gsplat: str, seed: int) -> None:
    """Forward; depth along the ray as well."""
    g = make_gaussians(seed=seed)
    ours = render(g, T_CAMERA_WORLD, CAMERA, statistics=True, backend=gsplat)
    twin = render(g, T_CAMERA_WORLD, CAMERA, statistics=True, backend='torch')
    for field in Rendered.__dataclass_fields__:
        a, b = getattr(ours, field), getattr(twin, field)
        assert a.dtype == np.float32 and a.shape == b.shape and a.flags.c_contiguous, field
        assert error(a, b) < IMAGES, field
    assert twin.silhouette.mean() > 0.4


@pytest.mark.parametrize('seed', range(3))
def test_gradients_agree_with_twin(gsplat: str, seed: int) -> None:
    """Backward from arbitrary derivatives, the pose's in the same convention."""
    g, given = make_gaussians(seed=seed), make_derivatives(seed)
    ours = backward(g, T_CAMERA_WORLD, CAMERA, *given, backend=gsplat)
    assert_gradients_agree(ours, backward(g, T_CAMERA_WORLD, CAMERA, *given, backend='torch'))


@pytest.mark.parametrize('seed', range(3))
def test_fused_step_agrees_with_twin(gsplat: str, seed: int) -> None:
    """Loss and its terms, all gradients, visibility without a pass of its own."""
    g = make_gaussians(seed=seed)
    target = make_target(g)
    ours, twin = step(g, target, gsplat), step(g, target, 'torch')
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
def test_each_loss_term_agrees_alone(gsplat: str, weights: LossWeights) -> None:
    """No term hides behind another."""
    g = make_gaussians(seed=3)
    target = make_target(g)
    ours, twin = step(g, target, gsplat, weights), step(g, target, 'torch', weights)
    assert ours.loss == pytest.approx(twin.loss, rel=1e-4)
    for name in ('means', 'quats', 'log_scales', 'logit_opacities', 'pose'):
        a, b = getattr(ours.gradients, name), getattr(twin.gradients, name)
        assert error(a, b) < GRADIENTS, name


@pytest.mark.parametrize('seed', range(3))
def test_opaque_gaussians_differ_by_what_is_documented(gsplat: str, seed: int) -> None:
    """Alpha is cut elsewhere and pixels end earlier; measured 0.025, on average 4e-5."""
    g = make_gaussians(seed=seed, max_logit=99.0)
    g = replace(g, logit_opacities=2 * g.logit_opacities)
    ours = render(g, T_CAMERA_WORLD, CAMERA, backend=gsplat)
    twin = render(g, T_CAMERA_WORLD, CAMERA, backend='torch')
    apart = np.abs(ours.silhouette - twin.silhouette)
    assert apart.max() < 0.1 and apart.mean() < 2e-4
    given = make_derivatives(seed)
    a = backward(g, T_CAMERA_WORLD, CAMERA, *given, backend=gsplat)
    b = backward(g, T_CAMERA_WORLD, CAMERA, *given, backend='torch')
    for name in (*PARAMETERS, 'pose'):
        x, y = getattr(a, name), getattr(b, name)
        assert np.linalg.norm(x - y) < 0.05 * np.linalg.norm(y), name


def test_depth_of_a_slanted_gaussian_follows_its_plane(gsplat: str) -> None:
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
    seen = render(g, np.eye(4), camera, backend=gsplat)
    rays = camera.rays()
    near = (slice(20, 28), slice(28, 36))  # the mean is affine, the plane only nearly
    plane = 2.0 / (1 + np.tan(turn) * rays[..., 0])
    depth = seen.depth[near] / seen.silhouette[near]
    np.testing.assert_allclose(depth, plane[near], rtol=5e-3)


def test_masked_pixels_have_no_influence(gsplat: str) -> None:
    """Whatever the target holds where the weight is 0, NaN included."""
    g = make_gaussians()
    color, depth, weight = make_target(g)
    weight[10:30, 5:25] = 0
    before = step(g, (color, depth, weight), gsplat)
    color, depth = color.copy(), depth.copy()
    color[weight == 0], depth[weight == 0] = np.nan, np.nan
    after = step(g, (color, depth, weight), gsplat)
    assert after.loss == pytest.approx(before.loss, rel=1e-6)
    assert_gradients_agree(before.gradients, after.gradients, 1e-5)
    nothing = step(g, (color, depth, np.zeros_like(weight)), gsplat)
    assert nothing.loss == 0
    assert not any(a.any() for a in nothing.gradients.parameters())
    assert nothing.visibility.any()


def test_inactive_gaussians_are_as_if_absent(gsplat: str) -> None:
    """M_g of Eq. 11."""
    g = make_gaussians()
    active = np.random.default_rng(0).uniform(size=len(g)) > 0.4
    kept = Gaussians(*(a[active] for a in g.arrays()))
    target = make_target(g)
    masked, absent = step(g, target, gsplat, active=active), step(kept, target, gsplat)
    assert masked.rendered is not None and absent.rendered is not None
    assert error(masked.rendered.depth, absent.rendered.depth) < 1e-6
    for a, b in zip(masked.gradients.parameters(), absent.gradients.parameters(), strict=True):
        assert error(a[active], b) < 1e-5
        assert not a[~active].any()
    assert not masked.visibility[~active].any() and masked.visibility[active].any()
    seen = render(g, T_CAMERA_WORLD, CAMERA, active=active, statistics=True, backend=gsplat)
    assert seen.radius is not None and not seen.radius[~active].any()


def test_empty_and_unseen_maps_render_black(gsplat: str) -> None:
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
        seen = render(gaussians, pose, CAMERA, statistics=True, backend=gsplat)
        assert not seen.color.any() and not seen.silhouette.any()
        assert seen.radius is not None and not seen.radius.any()
        result = fused_step(gaussians, pose, CAMERA, *zeros, WEIGHTS, backend=gsplat)
        assert not any(a.any() for a in result.gradients.parameters())
        assert not result.gradients.pose.any() and not result.visibility.any()


def test_every_tensor_is_made_on_the_device() -> None:
    """On torch's `meta` device, which has no data but refuses tensors from elsewhere."""

    def blend(means2d: torch.Tensor, conics: torch.Tensor, *rest: object) -> tuple[object, ...]:
        channels, opacities = rest[:2]
        touched = means2d.sum() + conics.sum() + channels.sum() + opacities.sum()  # type: ignore[attr-defined]
        shape = (1, *CAMERA.shape)
        return touched.expand(*shape, 8), touched.expand(*shape, 1)

    ids = torch.zeros(9, device='meta')
    functions = SimpleNamespace(
        isect_tiles=lambda means2d, radii, depths, *_: ((means2d + radii) * depths.T, ids, ids),
        isect_offset_encode=lambda keys, images, columns, rows: torch.zeros(
            columns * rows, device=keys.device
        ),
        rasterize_to_pixels=blend,
    )
    g = make_gaussians()
    active = np.ones(len(g), bool)
    scene = Scene(g, active, T_CAMERA_WORLD, CAMERA, 1)
    view = rasterize_gsplat._View(scene, functions, torch.device('meta'))
    images = view.images()
    exposure = torch.zeros(2, device='meta', requires_grad=True)
    target = Target(*make_target(g), EXPOSURE)
    with torch.device('meta'):
        terms = image_loss(images, exposure, target, WEIGHTS)
    torch.autograd.backward([terms.total, view.visibility_image.sum()])
    assert images.device.type == terms.total.device.type == 'meta'
    assert images.dtype == terms.total.dtype == torch.float32


@pytest.fixture
def fresh_choice(monkeypatch: pytest.MonkeyPatch) -> Iterator[pytest.MonkeyPatch]:
    """Forget which backends were found, before and after."""
    caches = (rasterize.available_backends, rasterize._backend)
    for cached in caches:
        cached.cache_clear()
    yield monkeypatch
    monkeypatch.undo()
    for cached in caches:
        cached.cache_clear()


def pretend_gsplat(monkeypatch: pytest.MonkeyPatch, reason: str | None) -> None:
    """Let gsplat look installed, and usable unless a reason is given."""
    monkeypatch.setattr(rasterize, 'find_spec', lambda name: ModuleSpec(name, None))
    monkeypatch.setattr(rasterize_gsplat, 'obstacle', lambda: reason)


def test_auto_takes_gsplat_first_and_says_so(
    fresh_choice: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Named first among the available; logged once; overridden by name."""
    pretend_gsplat(fresh_choice, None)
    chosen = RealBackend(gsplat_stand_in, 'cpu')
    fresh_choice.setattr(rasterize_gsplat, 'GsplatBackend', lambda: chosen)
    assert rasterize.available_backends()[0] == 'gsplat'
    with caplog.at_level(logging.INFO):
        assert rasterize._backend('auto') is chosen
        assert rasterize._backend('auto') is chosen
        assert rasterize._backend('gsplat') is chosen
        assert rasterize._backend('torch') is not chosen
    assert sum('rasteriser: gsplat' in r.message for r in caplog.records) == 1


def test_gsplat_that_cannot_run_is_not_available_and_why_is_logged(
    fresh_choice: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Asked for by name, it is refused."""
    pretend_gsplat(fresh_choice, 'torch sees no CUDA device')
    with caplog.at_level(logging.INFO):
        assert 'gsplat' not in rasterize.available_backends()
        rasterize._backend('auto')
    assert any('torch sees no CUDA device' in r.message for r in caplog.records)
    with pytest.raises(MapError, match=r"'gsplat' cannot run here; available: .*torch"):
        rasterize._backend('gsplat')


def test_auto_falls_back_where_gsplat_does_not_start(
    fresh_choice: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """Its kernels may fail to compile: one warning, and the CPU serves. By name it is an error."""
    pretend_gsplat(fresh_choice, None)

    def refuse() -> None:
        raise MapError('gsplat cannot run on cuda: nvcc failed')

    fresh_choice.setattr(rasterize_gsplat, 'GsplatBackend', refuse)
    with caplog.at_level(logging.WARNING):
        assert not isinstance(rasterize._backend('auto'), RealBackend)
    assert sum('nvcc failed' in r.message for r in caplog.records) == 1
    with pytest.raises(MapError, match='nvcc failed'):
        rasterize._backend('gsplat')


def test_obstacles_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    """No device; no compiled kernels and no compiler; otherwise none."""
    monkeypatch.setattr(torch.cuda, 'is_available', lambda: False)
    assert rasterize_gsplat.obstacle() == 'torch sees no CUDA device'
    monkeypatch.setattr(torch.cuda, 'is_available', lambda: True)
    monkeypatch.setattr(rasterize_gsplat, '_cuda_home', lambda: None)
    monkeypatch.setattr(rasterize_gsplat, 'find_spec', lambda name: None)
    assert 'no CUDA toolkit' in str(rasterize_gsplat.obstacle())
    monkeypatch.setattr(rasterize_gsplat, 'find_spec', lambda name: ModuleSpec(name, None))
    assert rasterize_gsplat.obstacle() is None


def test_a_gsplat_that_fails_to_load_says_what_it_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    """As where its kernels were not compiled."""

    def isect_tiles(*arguments: object) -> None:
        raise AttributeError("'NoneType' object has no attribute 'intersect_tile'")

    monkeypatch.setitem(sys.modules, 'gsplat', SimpleNamespace(isect_tiles=isect_tiles))
    with pytest.raises(MapError, match=r'gsplat cannot run on cpu: .*intersect_tile.*nvcc'):
        RealBackend(device='cpu')


def test_gsplat_is_warmed_up_with_valid_arguments(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """The call that makes it compile; then the device is logged."""
    monkeypatch.setitem(sys.modules, 'gsplat', gsplat_stand_in)
    with caplog.at_level(logging.INFO):
        RealBackend(device='cpu')
    assert any('runs on cpu' in r.message for r in caplog.records)


def test_torch_is_not_imported_to_look_for_gsplat() -> None:
    """It takes seconds; the native backend does without."""
    if rasterize.find_spec('gsplat') is not None:
        pytest.skip('gsplat is installed: whether it can run is torch to say')
    code = (
        'import sys; from bdgs_ros.mapping import rasterize; rasterize.available_backends(); '
        "sys.exit('torch' in sys.modules)"
    )
    assert subprocess.run([sys.executable, '-c', code], check=False, timeout=60).returncode == 0
