"""
Render Gaussians and differentiate the rendering, by the fastest backend that runs here.

The native backend is `src/rasterizer.cpp`, which explains the algorithm; that for a card is
`src/cuda`. The readable twin of both is `rasterize_torch`, which the tests hold them to and which
serves where nothing was compiled.
"""

from __future__ import annotations

import logging
from collections.abc import Sequence
from functools import lru_cache
from importlib.util import find_spec
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import MapError
from bdgs_ros.mapping.rasterize_native import VARIANTS, NativeBackend, load_module
from bdgs_ros.mapping.rasterize_types import (
    AdamConstants,
    AdamGroup,
    Array,
    Backend,
    FusedResult,
    Gaussians,
    Gradients,
    LossWeights,
    Pose,
    Rendered,
    Scene,
    Target,
    as_float32,
    expect_shape,
    on_card,
)

if TYPE_CHECKING:
    from bdgs_ros.mapping.cuda.kernels import Device

__all__ = [
    'AdamGroup',
    'FusedResult',
    'Gaussians',
    'Gradients',
    'LossWeights',
    'Rendered',
    'adam_step',
    'adam_steps',
    'available_backends',
    'backward',
    'fused_step',
    'map_device',
    'render',
]

_LOGGER = logging.getLogger(__name__)


@lru_cache(maxsize=1)
def available_backends() -> tuple[str, ...]:
    """Return the names of the backends that run here, fastest first; 'torch' is always there."""
    natives = tuple(v for v in VARIANTS if load_module(v) is not None)
    return (*_cards(), *natives, 'torch')


def _cards() -> tuple[str, ...]:
    """Return ('cuda',) where there is a card with kernels for it."""
    if find_spec('bdgs_ros._rasterizer_cuda') is None:  # asked first: torch loads for seconds
        return ()
    from bdgs_ros.mapping.cuda.kernels import obstacle

    reason = obstacle()
    if reason is not None:
        _LOGGER.info('the kernels for CUDA are there but cannot be used: %s', reason)
    return () if reason else ('cuda',)


def map_device(backend: str) -> Device | None:
    """Return the card that the map is optimised on; None where parameters are numpy's."""
    chosen = _backend(backend)
    return getattr(chosen, 'device', None)


@lru_cache(maxsize=16)
def _backend(name: str) -> Backend:
    """Resolve 'auto', 'native', or one of `available_backends()`."""
    available = available_backends()
    if name == 'auto':
        return _fastest(available)
    natives = [v for v in available if v in VARIANTS]
    if name == 'native' and natives:
        name = natives[0]
    if name not in available:
        raise MapError(
            f'rasteriser backend {name!r} cannot run here; available: {", ".join(available)}'
        )
    return _open(name)


def _fastest(available: tuple[str, ...]) -> Backend:
    """Return the fastest backend that starts, and log which."""
    if available[0] == 'cuda':
        try:
            return _open(available[0])
        except MapError as error:
            _LOGGER.warning('%s; the map stays on the CPU instead', error)
            return _fastest(available[1:])
    if available[0] == 'torch':
        _LOGGER.warning(
            'no compiled rasteriser: using its torch twin, about 100 times slower; '
            'install a C++17 compiler with OpenMP and reinstall bdgs_ros'
        )
    else:
        _LOGGER.info('rasteriser: native, the fastest of %s', ', '.join(available))
    return _open(available[0])


def _open(name: str) -> Backend:
    """Start one of `available_backends()`; torch, which takes seconds to import, only if used."""
    if name == 'cuda':
        from bdgs_ros.mapping.cuda.backend import CudaBackend
        from bdgs_ros.mapping.cuda.kernels import device

        return CudaBackend(device())
    if name == 'torch':
        from bdgs_ros.mapping.rasterize_torch import TorchBackend

        return TorchBackend()
    module = load_module(name)
    assert module is not None
    return NativeBackend(module)


def render(
    g: Gaussians,
    T_camera_world: Pose,
    camera: PinholeCamera,
    *,
    active: NDArray[np.bool_] | None = None,
    statistics: bool = False,
    threads: int = 1,
    backend: str = 'auto',
) -> Rendered:
    """
    Render one view on black.

    Parameters
    ----------
    g : Gaussians
        What to draw.
    T_camera_world : ndarray, shape (4, 4)
        Rigid; maps world to the camera's optical frame.
    camera : PinholeCamera
        Rectified.
    active : ndarray of bool, shape (N,), optional
        M_g of Eq. 11: others are not drawn. All by default.
    statistics : bool
        Also return visibility, largest weight and radius of each Gaussian.
    threads : int
        Of the native backend. Results do not depend on it.
    backend : str
        'auto', 'native', 'torch', or one of `available_backends()`.

    Returns
    -------
    Rendered

    Raises
    ------
    ValueError
        If an array has the wrong shape.
    MapError
        If the backend cannot run here.

    """
    chosen = _backend(backend)
    scene = _scene(g, T_camera_world, camera, active, threads, chosen)
    return chosen.render(scene, statistics)


def backward(
    g: Gaussians,
    T_camera_world: Pose,
    camera: PinholeCamera,
    dL_dcolor: Array,
    dL_ddepth: Array,
    dL_dsilhouette: Array,
    *,
    active: NDArray[np.bool_] | None = None,
    threads: int = 1,
    backend: str = 'auto',
) -> Gradients:
    """
    Carry derivatives by the rendered images back to the Gaussians and the camera.

    Parameters
    ----------
    g, T_camera_world, camera, active, threads, backend
        As for `render`.
    dL_dcolor : ndarray, shape (H, W, 3)
        By `Rendered.color`.
    dL_ddepth, dL_dsilhouette : ndarray, shape (H, W)
        By `Rendered.depth` and `Rendered.silhouette`.

    Returns
    -------
    Gradients

    Raises
    ------
    ValueError
        If an array has the wrong shape.
    MapError
        If the backend cannot run here.

    """
    chosen = _backend(backend)
    scene = _scene(g, T_camera_world, camera, active, threads, chosen)
    images = (
        as_float32('dL_dcolor', dL_dcolor, (*camera.shape, 3)),
        as_float32('dL_ddepth', dL_ddepth, camera.shape),
        as_float32('dL_dsilhouette', dL_dsilhouette, camera.shape),
    )
    return chosen.backward(scene, images)


def fused_step(
    g: Gaussians,
    T_camera_world: Pose,
    camera: PinholeCamera,
    target_color: Array,
    target_depth: Array,
    pixel_weight: Array,
    weights: LossWeights,
    *,
    exposure: tuple[float, float] = (0.0, 0.0),
    active: NDArray[np.bool_] | None = None,
    with_images: bool = False,
    threads: int = 1,
    backend: str = 'auto',
) -> FusedResult:
    """
    Render, compare with what the camera saw, and differentiate: one optimisation step's work.

    The colour term is Eq. 9 between `exp(log_gain) * color + offset` and the target. SSIM windows
    are cut to the pixels with weight > 0 and normalised over them. The depth term is
    silhouette * |depth / silhouette - D| with a first factor that is not differentiated: what
    hardly shows pulls hardly, and a wrong depth does not make a surface transparent. Beside it, a
    term wants the silhouette 1 where D is known. All are means weighted by `pixel_weight`, and so
    is the smoothness term, the first of Eq. 8: how far depth / silhouette is from locally plane,
    off the target's edges.

    Parameters
    ----------
    g, T_camera_world, camera, active, threads, backend
        As for `render`.
    target_color : ndarray, shape (H, W, 3)
        RGB in [0, 1].
    target_depth : ndarray, shape (H, W)
        Metres; 0 or NaN where unknown.
    pixel_weight : ndarray, shape (H, W)
        Such as P(static); pixels at 0 have no influence at all.
    weights : LossWeights
        Of the terms.
    exposure : (float, float)
        log_gain and offset of this view.
    with_images : bool
        Also return what was rendered.

    Returns
    -------
    FusedResult

    Raises
    ------
    ValueError
        If an array has the wrong shape.
    MapError
        If the backend cannot run here.

    """
    chosen = _backend(backend)
    scene = _scene(g, T_camera_world, camera, active, threads, chosen)
    target = Target(
        as_float32('target_color', target_color, (*camera.shape, 3)),
        as_float32('target_depth', target_depth, camera.shape),
        as_float32('pixel_weight', pixel_weight, camera.shape),
        (float(exposure[0]), float(exposure[1])),
    )
    return chosen.fused_step(scene, target, weights, with_images)


def adam_step(
    params: Array,
    grads: Array,
    first: Array,
    second: Array,
    *,
    rate: float,
    step: int | None = None,
    rows: NDArray[np.bool_] | None = None,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
    threads: int = 1,
    backend: str = 'auto',
) -> None:
    """
    Make one step of Adam in place.

    Parameters
    ----------
    params, first, second : ndarray, float32, shape (N, ...)
        Parameters and their moments; changed. Must lie in rows (C order).
    grads : ndarray, shape (N, ...)
        Gradient by `params`.
    rate : float
        Step size.
    step : int, optional
        Number of this step from 1, for Adam's correction of the young moments' bias. None leaves
        the correction out, as is usual where rows are updated at different times.
    rows : ndarray of bool, shape (N,), optional
        Rows to touch; the others keep parameters and moments.
    betas, eps
        Adam's decay rates, and its guard against division by zero.
    threads, backend
        As for `render`.

    Raises
    ------
    ValueError
        If shapes differ, an array to change is not float32 in C order, or step < 1.

    """
    group = AdamGroup(params, grads, first, second, rate)
    adam_steps(
        [group], step=step, rows=rows, betas=betas, eps=eps, threads=threads, backend=backend
    )


def adam_steps(
    groups: Sequence[AdamGroup],
    *,
    step: int | None = None,
    rows: NDArray[np.bool_] | None = None,
    betas: tuple[float, float] = (0.9, 0.999),
    eps: float = 1e-15,
    threads: int = 1,
    backend: str = 'auto',
) -> None:
    """
    Make one step of Adam in place on several arrays that share their rows, in one call.

    Parameters
    ----------
    groups : sequence of AdamGroup
        Arrays of the same length N, each with its gradient, moments and rate.
    step, rows, betas, eps, threads, backend
        As for `adam_step`.

    Raises
    ------
    ValueError
        If shapes differ, an array to change is not float32 in C order, or step < 1.

    """
    if step is not None and step < 1:
        raise ValueError(f'step: expected 1 or more, received {step}')
    checked = [_checked(group) for group in groups]
    for group in checked:
        expect_shape(
            'params', group.params, (*groups[0].params.shape[:1], *group.params.shape[1:])
        )
    if rows is not None and groups:
        expect_shape('rows', rows, groups[0].params.shape[:1])
        rows = np.ascontiguousarray(rows, dtype=np.bool_)
    constants = AdamConstants(step or 0, betas, eps)
    able = [v for v in available_backends() if v in VARIANTS]  # found once, not every step
    natives = [v for v in able if backend in (v, 'native', 'auto')]
    native = _backend(natives[0]) if natives else None
    if isinstance(native, NativeBackend):
        native.adam_steps(checked, rows, constants, threads)
    else:
        for group in checked:
            _adam_numpy(group, rows, constants)


def _checked(group: AdamGroup) -> AdamGroup:
    shape = group.params.shape
    for name in ('params', 'first', 'second'):
        array = getattr(group, name)
        expect_shape(name, array, shape)
        if array.dtype != np.float32 or not array.flags.c_contiguous:
            raise ValueError(f'{name}: expected float32 in C order, received {array.dtype}')
    return group._replace(grads=as_float32('grads', group.grads, shape))


def _adam_numpy(
    group: AdamGroup, rows: NDArray[np.bool_] | None, constants: AdamConstants
) -> None:
    params, grads, first, second, rate = group
    step, (beta1, beta2), eps = constants
    at = slice(None) if rows is None else rows
    m = beta1 * first[at] + (1 - beta1) * grads[at]
    v = beta2 * second[at] + (1 - beta2) * grads[at] ** 2
    correct1, correct2 = (1 - beta1**step, 1 - beta2**step) if step else (1.0, 1.0)
    first[at], second[at] = m, v
    params[at] -= rate / correct1 * m / (np.sqrt(v / correct2) + eps)


def _scene(
    g: Gaussians,
    T_camera_world: Pose,
    camera: PinholeCamera,
    active: NDArray[np.bool_] | None,
    threads: int,
    backend: Backend,
) -> Scene:
    count = len(g.means)
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3), (count,))
    names = ('means', 'quats', 'log_scales', 'logit_opacities', 'colors', 'p_dynamic')
    check = on_card if hasattr(backend, 'device') else as_float32
    arrays = [
        check(f'g.{name}', array, shape)
        for name, array, shape in zip(names, g.arrays(), shapes, strict=True)
    ]
    expect_shape('T_camera_world', T_camera_world, (4, 4))
    if active is not None:
        expect_shape('active', active, (count,))
        active = np.ascontiguousarray(active, dtype=np.bool_)
    if threads < 1:
        raise ValueError(f'threads: expected 1 or more, received {threads}')
    pose = np.ascontiguousarray(T_camera_world, dtype=np.float64)
    return Scene(Gaussians(*arrays), active, pose, camera, threads)
