"""
The rasteriser: every native build against the float64 torch twin, and both against the rules.

Errors are max |a - b| / max |b|; docstrings say what was measured over three seeds and all
builds.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import MapError
from bdgs_ros.mapping import rasterize, rasterize_native, rasterize_torch
from bdgs_ros.mapping.rasterize import (
    AdamGroup,
    FusedResult,
    Gaussians,
    Gradients,
    LossWeights,
    Rendered,
    adam_step,
    adam_steps,
    available_backends,
    backward,
    fused_step,
    render,
)
from bdgs_ros.mapping.rasterize_native import VARIANTS

CAMERA = PinholeCamera(48, 40, 45.0, 47.0, 23.3, 20.3)
T_CAMERA_WORLD = se3.exp(np.array([0.1, -0.2, 0.3, 0.2, -0.3, 0.4]))
WEIGHTS = LossWeights(color=0.85, ssim=0.2, depth=0.3, smooth=0.4, empty=0.1)
EXPOSURE = (0.1, -0.02)
NATIVES = [name for name in available_backends() if name in VARIANTS]
ON_CPU = [*NATIVES, 'torch']  # a card has tests of its own
PARAMETERS = ('means', 'quats', 'log_scales', 'logit_opacities', 'colors')

native = pytest.mark.skipif(not NATIVES, reason='no native rasteriser was built')


@pytest.fixture(autouse=True)
def one_torch_thread() -> Iterator[None]:
    """Small tensors: torch's threads only wait for each other."""
    threads = torch.get_num_threads()
    torch.set_num_threads(1)
    yield
    torch.set_num_threads(threads)


def make_gaussians(count: int = 200, seed: int = 0) -> Gaussians:
    """Gaussians in and around the view, some cut by the image border."""
    rng = np.random.default_rng(seed)
    z = rng.uniform(0.5, 4, count)
    u, v = rng.uniform(-6, 54, count), rng.uniform(-6, 46, count)
    x, y = (u - CAMERA.cx) / CAMERA.fx * z, (v - CAMERA.cy) / CAMERA.fy * z
    points = np.stack([x, y, z], axis=1)
    means = (points - T_CAMERA_WORLD[:3, 3]) @ T_CAMERA_WORLD[:3, :3]
    arrays = (
        means,
        2 * rng.normal(size=(count, 4)),
        np.log(rng.uniform(0.01, 0.25, (count, 3))),
        2 * rng.normal(size=count),
        rng.uniform(size=(count, 3)),
        rng.uniform(size=count),
    )
    return Gaussians(*(a.astype(np.float32) for a in arrays))


def make_target(g: Gaussians, seed: int = 1) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Colour near the rendering, depth with holes, weights with masked pixels."""
    rng = np.random.default_rng(seed)
    shape = CAMERA.shape
    noise = rng.uniform(size=(*shape, 3))
    color = 0.8 * render(g, T_CAMERA_WORLD, CAMERA, backend='torch').color + 0.2 * noise + 0.03
    depth = rng.uniform(1, 4, shape) * (rng.uniform(size=shape) > 0.2)
    weight = rng.uniform(size=shape) * (rng.uniform(size=shape) > 0.2)
    return color.astype(np.float32), depth.astype(np.float32), weight.astype(np.float32)


def step(g: Gaussians, target: tuple[np.ndarray, ...], **options: object) -> FusedResult:
    """Call fused_step with this file's camera, pose, weights and exposure."""
    defaults: dict[str, object] = {'exposure': EXPOSURE, 'backend': NATIVES[0], **options}
    weights = defaults.pop('weights', WEIGHTS)
    return fused_step(g, T_CAMERA_WORLD, CAMERA, *target, weights, **defaults)


def error(a: np.ndarray, b: np.ndarray) -> float:
    """Return max |a - b| / max |b|."""
    return float(np.abs(a - b).max() / np.abs(b).max())


def assert_gradients_agree(a: Gradients, b: Gradients, limit: float) -> None:
    """Compare all gradients."""
    for name in (*PARAMETERS, 'pose'):
        assert error(getattr(a, name), getattr(b, name)) < limit, name


def assert_same(a: Gradients, b: Gradients) -> None:
    """Compare all gradients bit by bit."""
    for name in (*PARAMETERS, 'pose'):
        np.testing.assert_array_equal(getattr(a, name), getattr(b, name), err_msg=name)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('name', NATIVES)
def test_images_and_statistics_agree_with_twin(name: str, seed: int) -> None:
    """Forward; measured at most 9e-7."""
    g = make_gaussians(seed=seed)
    ours = render(g, T_CAMERA_WORLD, CAMERA, statistics=True, backend=name)
    twin = render(g, T_CAMERA_WORLD, CAMERA, statistics=True, backend='torch')
    for field in Rendered.__dataclass_fields__:
        assert error(getattr(ours, field), getattr(twin, field)) < 1e-5, field
    assert twin.silhouette.mean() > 0.5


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('name', NATIVES)
def test_gradients_agree_with_autograd(name: str, seed: int) -> None:
    """Backward from arbitrary image derivatives; measured at most 6e-6."""
    g = make_gaussians(seed=seed)
    rng = np.random.default_rng(seed)
    shape = CAMERA.shape
    given = [rng.normal(size=s).astype(np.float32) for s in ((*shape, 3), shape, shape)]
    ours = backward(g, T_CAMERA_WORLD, CAMERA, *given, backend=name)
    twin = backward(g, T_CAMERA_WORLD, CAMERA, *given, backend='torch')
    assert_gradients_agree(ours, twin, 1e-4)


@pytest.mark.parametrize('seed', range(3))
@pytest.mark.parametrize('name', NATIVES)
def test_fused_step_agrees_with_autograd(name: str, seed: int) -> None:
    """Measured: 1 - SSIM 8e-6 (variances cancel in float32), gradients 8e-6, exposure 2e-5."""
    g = make_gaussians(seed=seed)
    target = make_target(g)
    ours, twin = step(g, target, backend=name), step(g, target, backend='torch')
    for field in ('loss', 'l1', 'ssim', 'depth', 'smooth', 'empty'):
        assert getattr(ours, field) == pytest.approx(getattr(twin, field), rel=3e-5), field
    assert_gradients_agree(ours.gradients, twin.gradients, 1e-4)
    assert error(ours.exposure_gradient, twin.exposure_gradient) < 1e-4
    assert error(ours.visibility, twin.visibility) < 1e-5


@pytest.mark.parametrize('size', [(17, 5), (2, 2), (33, 70), (100, 3), (257, 12)])
@pytest.mark.parametrize('name', NATIVES)
def test_odd_sizes_agree(name: str, size: tuple[int, int]) -> None:
    """Images smaller than a window, no multiples of tiles or vectors; measured at most 3e-5."""
    width, height = size
    camera = PinholeCamera(width, height, 50.0, 50.0, width / 2, height / 2)
    rng = np.random.default_rng(width)
    count = 150
    z = rng.uniform(1, 3, count)
    u, v = rng.uniform(0, width, count), rng.uniform(0, height, count)
    g = replace(
        make_gaussians(count),
        means=np.stack([(u - camera.cx) / 50 * z, (v - camera.cy) / 50 * z, z], 1).astype('f4'),
    )
    shape = camera.shape
    color, depth = rng.uniform(size=(*shape, 3)), rng.uniform(1, 3, shape)
    weight = rng.uniform(size=shape) * (rng.uniform(size=shape) > 0.2)
    target = [a.astype(np.float32) for a in (color, depth, weight)]
    twin = fused_step(g, np.eye(4), camera, *target, WEIGHTS, backend='torch')
    ours = fused_step(g, np.eye(4), camera, *target, WEIGHTS, backend=name)
    assert ours.loss == pytest.approx(twin.loss, rel=3e-5)
    assert_gradients_agree(ours.gradients, twin.gradients, 1e-4)
    for threads in (2, 5):
        again = fused_step(g, np.eye(4), camera, *target, WEIGHTS, threads=threads, backend=name)
        assert_same(again.gradients, ours.gradients)


@native
@pytest.mark.parametrize('term', ['color', 'ssim', 'depth', 'smooth', 'empty'])
def test_each_loss_term_agrees_alone(term: str) -> None:
    """No term hides behind another; measured at most 4e-5 (SSIM)."""
    weights = {
        'color': LossWeights(1.0, 0.0, 0.0),
        'ssim': LossWeights(1.0, 1.0, 0.0),
        'depth': LossWeights(0.0, 0.0, 1.0),
        'smooth': LossWeights(0.0, 0.0, 0.0, 1.0),
        'empty': LossWeights(0.0, 0.0, 0.0, 0.0, 1.0),
    }[term]
    g = make_gaussians(seed=3)
    target = make_target(g)
    ours = step(g, target, weights=weights)
    twin = step(g, target, weights=weights, backend='torch')
    assert ours.loss == pytest.approx(twin.loss, rel=3e-5)
    for name in ('means', 'quats', 'log_scales', 'logit_opacities', 'pose'):
        a, b = getattr(ours.gradients, name), getattr(twin.gradients, name)
        assert error(a, b) < 1e-4, name


def slanted_wall(camera: PinholeCamera) -> Gaussians:
    """Flat discs, 1.5 px wide, on the plane z = 2 + x that they all lie in."""
    v, u = np.mgrid[-6 : camera.height + 6, -6 : camera.width + 6].reshape(2, -1)
    rays = np.stack([(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, 0 * u + 1], 1)
    z = 2 / (1 - rays[:, 0])
    count, half = len(z), np.pi / 8
    arrays = (
        rays * z[:, None],
        np.tile([np.cos(half), 0, -np.sin(half), 0], (count, 1)),
        np.log(np.stack([1.5 * z / camera.fx] * 2 + [0 * z + 1e-3], axis=1)),
        np.full(count, 1.0),
        np.full((count, 3), 0.5),
        np.zeros(count),
    )
    return Gaussians(*(a.astype(np.float32) for a in arrays))


@pytest.mark.parametrize('name', ON_CPU)
def test_smoothness_wants_planes_and_leaves_edges(name: str) -> None:
    """A slanted wall is smooth, a step is not, a step under an edge of the target is less."""
    camera = PinholeCamera(32, 24, 40.0, 40.0, 16.0, 12.0)
    ones = np.ones(camera.shape, np.float32)
    plain = np.full((*camera.shape, 3), 0.5, np.float32)
    edged = plain.copy()
    edged[:, 16:] = 1.0

    def smooth(g: Gaussians, color: np.ndarray) -> float:
        weights = LossWeights(0.0, 0.0, 0.0, 1.0)
        return fused_step(g, np.eye(4), camera, color, ones, ones, weights, backend=name).smooth

    wall = slanted_wall(camera)
    nearer = wall.means * np.where(wall.means[:, :1] > 0, 0.7, 1.0).astype(np.float32)
    step = replace(wall, means=nearer)
    slope = 2 / camera.fx  # of the wall, metres per px
    assert smooth(wall, plain) < 0.02 * slope
    assert smooth(step, plain) > 20 * smooth(wall, plain)
    assert smooth(step, edged) < 0.7 * smooth(step, plain)


@pytest.mark.parametrize('name', ON_CPU)
def test_holes_are_not_rough(name: str) -> None:
    """Where less than half is covered there is no surface."""
    camera = PinholeCamera(32, 24, 40.0, 40.0, 16.0, 12.0)
    ones = np.ones(camera.shape, np.float32)
    weights = LossWeights(0.0, 0.0, 0.0, 1.0)
    g = slanted_wall(camera)
    left = Gaussians(*(a[g.means[:, 0] < 0] for a in g.arrays()))
    color = np.full((*camera.shape, 3), 0.5, np.float32)
    result = fused_step(left, np.eye(4), camera, color, ones, ones, weights, backend=name)
    whole = fused_step(g, np.eye(4), camera, color, ones, ones, weights, backend=name)
    assert 0 < result.smooth < 3 * whole.smooth  # to black would be a cliff of 2 m


def test_twin_pose_gradient_agrees_with_finite_differences(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without the step at alpha = 1/255 and with the smooth SSIM term alone; measured 4e-6."""
    monkeypatch.setattr(rasterize_torch, 'MIN_ALPHA', 1e-9)
    g = make_gaussians(60, seed=5)
    g = replace(g, logit_opacities=np.minimum(g.logit_opacities, 2))  # nothing saturates
    target = make_target(g)
    smooth = LossWeights(1.0, 1.0, 0.0)
    analytic = step(g, target, weights=smooth, backend='torch').gradients.pose

    def loss(xi: np.ndarray) -> float:
        pose = se3.exp(xi) @ T_CAMERA_WORLD
        return fused_step(
            g, pose, CAMERA, *target, smooth, exposure=EXPOSURE, backend='torch'
        ).loss

    steps = 1e-4 * np.eye(6)
    numeric = np.array([(loss(xi) - loss(-xi)) / 2e-4 for xi in steps])
    assert error(analytic, numeric) < 1e-4


def test_twin_ssim_is_the_usual_one_without_mask() -> None:
    """Interior of the map against a direct evaluation of the definition at one pixel."""
    rng = np.random.default_rng(0)
    x, y = rng.uniform(size=(2, 3, 20, 24))
    ones = torch.ones(20, 24, dtype=torch.float64)
    ssim = rasterize_torch.masked_ssim(torch.from_numpy(x), torch.from_numpy(y), ones).numpy()
    d = np.arange(-5, 6)
    window = np.exp(-(d[:, None] ** 2 + d[None] ** 2) / (2 * 1.5**2))
    window /= window.sum()
    a, b = x[1, 4:15, 7:18], y[1, 4:15, 7:18]
    ma, mb = (window * a).sum(), (window * b).sum()
    va, vb = (window * (a - ma) ** 2).sum(), (window * (b - mb) ** 2).sum()
    cov = (window * (a - ma) * (b - mb)).sum()
    expected = (2 * ma * mb + 1e-4) * (2 * cov + 9e-4)
    expected /= (ma**2 + mb**2 + 1e-4) * (va + vb + 9e-4)
    assert ssim[1, 9, 12] == pytest.approx(expected, rel=1e-9)


@pytest.mark.parametrize('name', ON_CPU)
def test_masked_pixels_have_no_influence(name: str) -> None:
    """Whatever the target holds where the weight is 0, NaN included, nothing changes."""
    g = make_gaussians()
    color, depth, weight = make_target(g)
    weight[10:30, 5:25] = 0
    hidden = weight == 0
    before = step(g, (color, depth, weight), backend=name)
    color, depth = color.copy(), depth.copy()
    color[hidden], depth[hidden] = np.nan, np.nan
    after = step(g, (color, depth, weight), backend=name)
    assert after.loss == before.loss
    assert_same(before.gradients, after.gradients)
    nothing = step(g, (color, depth, np.zeros_like(weight)), backend=name)
    assert nothing.loss == 0
    assert not any(a.any() for a in nothing.gradients.parameters())


@pytest.mark.parametrize('name', NATIVES)
def test_result_does_not_depend_on_repetition_or_threads(name: str) -> None:
    """Bit by bit, also after the workspace served another size."""
    g = make_gaussians(3000, seed=2)
    target = make_target(g)
    first = step(g, target, backend=name, with_images=True)
    render(make_gaussians(10), T_CAMERA_WORLD, CAMERA.scaled(0.5), backend=name)
    for threads in (1, 2, 3):
        again = step(g, target, backend=name, threads=threads, with_images=True)
        assert again.loss == first.loss
        assert_same(again.gradients, first.gradients)
        assert first.rendered is not None and again.rendered is not None
        np.testing.assert_array_equal(again.rendered.color, first.rendered.color)


@pytest.mark.parametrize('name', ON_CPU)
def test_inactive_gaussians_are_as_if_absent(name: str) -> None:
    """M_g of Eq. 11."""
    g = make_gaussians()
    active = np.random.default_rng(0).uniform(size=len(g)) > 0.4
    kept = Gaussians(*(a[active] for a in g.arrays()))
    target = make_target(g)
    masked = step(g, target, active=active, backend=name, with_images=True)
    absent = step(kept, target, backend=name, with_images=True)
    assert masked.rendered is not None and absent.rendered is not None
    assert error(masked.rendered.depth, absent.rendered.depth) < 1e-6
    for a, b in zip(masked.gradients.parameters(), absent.gradients.parameters(), strict=True):
        assert error(a[active], b) < 1e-6
        assert not a[~active].any()
    assert not masked.visibility[~active].any()


@pytest.mark.parametrize('name', ON_CPU)
def test_empty_and_unseen_maps_render_black(name: str) -> None:
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
        seen = render(gaussians, pose, CAMERA, statistics=True, backend=name)
        assert not seen.color.any() and not seen.silhouette.any()
        assert seen.radius is not None and not seen.radius.any()
        result = fused_step(gaussians, pose, CAMERA, *zeros, WEIGHTS, backend=name)
        assert not any(a.any() for a in result.gradients.parameters())
        assert not result.gradients.pose.any()


@pytest.mark.parametrize('name', ON_CPU)
def test_one_opaque_gaussian_is_where_it_should_be(name: str) -> None:
    """Centre on a pixel, alpha clamped to 0.99, depth along z; integer coordinates are centres."""
    camera = PinholeCamera(32, 24, 40.0, 40.0, 16.0, 12.0)
    row = ([[0.0, 0.0, 2.0]], [[1, 0, 0, 0]], [[-3.0] * 3], [20.0], [[0.2, 0.4, 0.6]], [0.5])
    g = Gaussians(*(np.array(a, np.float32) for a in row))
    seen = render(g, np.eye(4), camera, statistics=True, backend=name)
    assert np.unravel_index(seen.silhouette.argmax(), camera.shape) == (12, 16)
    np.testing.assert_allclose(seen.color[12, 16], 0.99 * g.colors[0], rtol=1e-6)
    assert seen.depth[12, 16] == pytest.approx(1.98)
    assert seen.p_dynamic[12, 16] == pytest.approx(0.495)
    # alpha at 2 px: sigma^2 = (40 e^-3 / 2)^2 + 0.3 px^2
    variance = (40 * np.exp(-3.0) / 2) ** 2 + 0.3
    assert seen.silhouette[12, 18] == pytest.approx(np.exp(-2 / variance), rel=1e-5)
    assert seen.max_weight is not None and seen.visibility is not None
    assert seen.max_weight[0] == pytest.approx(0.99)
    assert seen.visibility[0] == pytest.approx(seen.silhouette.sum(), rel=1e-5)
    assert seen.radius is not None
    assert seen.radius[0] == pytest.approx(np.sqrt(2 * np.log(255) * variance), rel=1e-5)


def slanted_disc(log_scales: tuple[float, float, float]) -> Gaussians:
    """One Gaussian 2 m ahead, turned by 45 degrees about y: its own x-axis goes away from us."""
    half = np.pi / 8
    quat = [np.cos(half), 0, -np.sin(half), 0]
    row = ([[0.0, 0.0, 2.0]], [quat], [log_scales], [20.0], [[0.2, 0.4, 0.6]], [0.5])
    return Gaussians(*(np.array(a, np.float32) for a in row))


@pytest.mark.parametrize('name', ON_CPU)
def test_depth_of_a_slanted_disc_is_its_plane(name: str) -> None:
    """Mean of z given the pixel: the plane's slope, 2 m / 40 px, but for the low-pass filter."""
    camera = PinholeCamera(32, 24, 40.0, 40.0, 16.0, 12.0)
    g = slanted_disc((np.log(0.3), np.log(0.2), -9.0))
    seen = render(g, np.eye(4), camera, backend=name)
    depth = seen.depth / np.maximum(seen.silhouette, 1e-9)
    variance_z = 0.3**2 / 2
    variance_u = variance_z * (40 / 2) ** 2
    slope = variance_z * (40 / 2) / (variance_u + 0.3)
    assert slope == pytest.approx(2 / 40, rel=0.02)
    columns = np.arange(9, 24)
    np.testing.assert_allclose(depth[12, columns], 2 + slope * (columns - 16), rtol=1e-5)
    np.testing.assert_allclose(depth[8:17, 16], 2, rtol=1e-5)


@pytest.mark.parametrize('name', ON_CPU)
def test_depth_of_a_disc_seen_edge_on_is_bounded(name: str) -> None:
    """Its plane runs along the ray: |z - centre| <= sigma_z sqrt(2 ln(255 o)), here 3.33 sigma."""
    camera = PinholeCamera(32, 24, 40.0, 40.0, 16.0, 12.0)
    half = np.pi / 4 - 1e-3
    quat = np.array([[np.cos(half), 0, -np.sin(half), 0]], np.float32)
    g = replace(slanted_disc((np.log(0.3), np.log(0.2), -9.0)), quats=quat)
    seen = render(g, np.eye(4), camera, backend=name)
    drawn = seen.silhouette > 0
    depth = seen.depth[drawn] / seen.silhouette[drawn]
    assert drawn.sum() > 20
    assert np.abs(depth - 2).max() < 3.33 * 0.3


@pytest.mark.parametrize('name', ON_CPU)
@pytest.mark.parametrize('log_scales', [(1.0, -12.0, -12.0), (-12.0, -12.0, -12.0), (2, 2, -20.0)])
def test_depth_gradients_of_needles_and_sheets_are_finite(
    name: str, log_scales: tuple[float, float, float]
) -> None:
    """Metres long and micrometres thick."""
    g = slanted_disc(log_scales)
    zeros, ones = np.zeros((*CAMERA.shape, 3)), np.ones(CAMERA.shape)
    result = backward(g, np.eye(4), CAMERA, zeros, ones, 0 * ones, backend=name)
    assert all(np.isfinite(a).all() for a in result.parameters())
    assert np.isfinite(result.pose).all() and result.pose.any()


@native
@pytest.mark.parametrize('argument', ['means', 'quats', 'colors', 'p_dynamic'])
def test_wrong_gaussian_shape_is_named(argument: str) -> None:
    """ValueError with the argument, expected and received shape."""
    g = replace(make_gaussians(5), **{argument: np.zeros((5, 7), np.float32)})
    with pytest.raises(ValueError, match=rf'g\.{argument}: expected shape .*received \(5, 7\)'):
        render(g, T_CAMERA_WORLD, CAMERA)


@native
def test_wrong_shapes_and_values_are_named() -> None:
    """The other arguments."""
    g = make_gaussians(5)
    color, depth, weight = make_target(g)
    with pytest.raises(ValueError, match='T_camera_world'):
        render(g, np.eye(3), CAMERA)
    with pytest.raises(ValueError, match='active'):
        render(g, np.eye(4), CAMERA, active=np.ones(4, bool))
    with pytest.raises(ValueError, match='threads'):
        render(g, np.eye(4), CAMERA, threads=0)
    for k, name in enumerate(('target_color', 'target_depth', 'pixel_weight')):
        wrong = [color, depth, weight]
        wrong[k] = wrong[k][1:]
        with pytest.raises(ValueError, match=name):
            step(g, tuple(wrong))
    with pytest.raises(ValueError, match='dL_ddepth'):
        backward(g, np.eye(4), CAMERA, color, depth[1:], weight)


def test_unknown_backend_is_refused() -> None:
    """The error lists what there is."""
    with pytest.raises(MapError, match=r"'metal'.*torch"):
        render(make_gaussians(1), np.eye(4), CAMERA, backend='metal')


def test_without_native_build_the_twin_serves(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    """One warning, then torch."""
    monkeypatch.setattr(rasterize, 'available_backends', lambda: ('torch',))
    rasterize._backend.cache_clear()
    g = make_gaussians(5)
    try:
        with caplog.at_level(logging.WARNING):
            render(g, T_CAMERA_WORLD, CAMERA)
            render(g, T_CAMERA_WORLD, CAMERA)
        with pytest.raises(MapError, match='native'):
            render(g, T_CAMERA_WORLD, CAMERA, backend='native')
    finally:
        rasterize._backend.cache_clear()
    assert sum('no compiled rasteriser' in r.message for r in caplog.records) == 1


@native
def test_a_build_the_processor_lacks_is_not_loaded(monkeypatch: pytest.MonkeyPatch) -> None:
    """The base build decides."""
    from bdgs_ros import _rasterizer_base  # type: ignore[attr-defined]

    assert _rasterizer_base.supports('base') and not _rasterizer_base.supports('sse9')
    monkeypatch.setattr(_rasterizer_base, 'supports', lambda name: name == 'base')
    assert rasterize_native.load_module('avx512') is None
    assert rasterize_native.load_module('base') is not None


@pytest.mark.parametrize('name', ON_CPU)
@pytest.mark.parametrize('shape', [(301,), (101, 3), (57, 4)])
def test_adam_agrees_with_torch(name: str, shape: tuple[int, ...]) -> None:
    """Five steps; measured 1e-7."""
    rng = np.random.default_rng(0)
    params = rng.normal(size=shape).astype(np.float32)
    first, second = np.zeros_like(params), np.zeros_like(params)
    leaf = torch.from_numpy(params.astype(np.float64)).requires_grad_()
    adam = torch.optim.Adam([leaf], lr=0.01, eps=1e-8)
    for number in range(1, 6):
        grads = rng.normal(size=shape).astype(np.float32)
        leaf.grad = torch.from_numpy(grads.astype(np.float64))
        adam.step()
        adam_step(params, grads, first, second, rate=0.01, step=number, eps=1e-8, backend=name)
    assert error(params, leaf.detach().numpy()) < 2e-6


@pytest.mark.parametrize('name', ON_CPU)
@pytest.mark.parametrize('shape', [(301,), (101, 3)])
def test_sparse_adam_touches_only_its_rows(name: str, shape: tuple[int, ...]) -> None:
    """Chosen rows as in the full update without bias correction, the others bit by bit."""
    rng = np.random.default_rng(0)
    start, grads = rng.normal(size=(2, *shape)).astype(np.float32)
    rows = rng.uniform(size=shape[0]) > 0.3
    rows[32:96] = True
    params, first, second = start.copy(), np.zeros_like(start), np.zeros_like(start)
    adam_step(params, grads, first, second, rate=0.1, rows=rows, backend=name)
    wanted = start - 0.1 * 0.1 * grads / (np.sqrt(0.001) * np.abs(grads))
    np.testing.assert_allclose(params[rows], wanted[rows], rtol=1e-4, atol=1e-6)
    np.testing.assert_array_equal(params[~rows], start[~rows])
    assert not first[~rows].any() and not second[~rows].any()


@pytest.mark.parametrize('name', ON_CPU)
def test_adam_on_several_arrays_is_adam_on_each(name: str) -> None:
    """Rows wanted all, some and none of a vector, a number of columns without a fast path."""
    rng = np.random.default_rng(0)
    count = 203
    shapes = ((count, 3), (count, 4), (count,), (count, 2))
    rows = rng.uniform(size=count) > 0.5
    rows[32:64], rows[64:96] = True, False
    arrays = [[rng.uniform(0.1, 1, s).astype(np.float32) for _ in range(4)] for s in shapes]
    together = [AdamGroup(*(a.copy() for a in g), rate=0.1 * k) for k, g in enumerate(arrays)]
    adam_steps(together, rows=rows, step=3, threads=2, backend=name)
    for k, (group, alone) in enumerate(zip(together, arrays, strict=True)):
        adam_step(*alone, rate=0.1 * k, rows=rows, step=3, backend='torch')
        for ours, twin in zip(group[:4], alone, strict=True):
            np.testing.assert_allclose(ours, twin, rtol=1e-6)
    with pytest.raises(ValueError, match='params'):
        adam_steps([together[0], AdamGroup(*(a[1:] for a in together[1][:4]), 0.1)], backend=name)


def test_adam_refuses_what_it_cannot_change_in_place() -> None:
    """Other types, other layouts, other shapes, step 0."""
    a = np.zeros((4, 3), np.float32)
    with pytest.raises(ValueError, match='params'):
        adam_step(a.astype(np.float64), a, a, a, rate=0.1)
    with pytest.raises(ValueError, match='first'):
        adam_step(a, a, np.zeros((3, 4), np.float32).T, a, rate=0.1)
    with pytest.raises(ValueError, match='rows'):
        adam_step(a, a, a, a, rate=0.1, rows=np.ones(3, bool))
    with pytest.raises(ValueError, match='step'):
        adam_step(a, a, a, a, rate=0.1, step=0)
