"""
The rasteriser on CUDA: gsplat [1]_ sorts and blends, torch does what is particular to us.

Projection is the twin's, `rasterize_torch.project`, run on the device: our depth along the ray
needs the same intermediate matrices as the ellipse does, so gsplat's own projection would save
nothing, and one set of formulas is left to be right. gsplat blends eight channels of every
Gaussian,

    r, g, b,  z - zu (u_c - u_0) - zv (v_c - v_0),  zu,  zv,  p_dynamic,  0

where (u_c, v_c) is the Gaussian's centre, (zu, zv) its slope of depth per pixel and (u_0, v_0)
the middle of the image, which keeps the numbers small. Depth at a pixel is then channel 3 plus
(u - u_0) times channel 4 plus (v - v_0) times channel 5: every Gaussian's depth is affine in the
pixel, so the sums may be taken before. Blending a channel of zeros changes nothing, but the
derivative by it of the sum of its image is the sum of each Gaussian's weights: visibility, at no
further pass.

What stays different from the twin (docs/cuda.md has the figures):

- float32 in blending, with the approximate exponential of CUDA: about 1e-6 relative;
- sums of gradients by atomic additions, in no fixed order: results repeat to about 1e-6 only;
- gsplat cuts alpha at 0.999, we at 0.99: alpha differs by at most 0.009, within 0.14 sigma of the
  centre of a Gaussian whose opacity exceeds 0.99;
- gsplat drops the Gaussian that would take transmittance to 1e-4 or below, we blend it and drop
  the next: a pixel may lose a weight of 1e-4 / (1 - alpha).

.. [1] V. Ye et al., "gsplat: An Open-Source Library for Gaussian Splatting", JMLR 2025.
"""

from __future__ import annotations

import importlib
import logging
from dataclasses import dataclass
from importlib.util import find_spec
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import MapError
from bdgs_ros.mapping.rasterize_torch import (
    Splats,
    image_loss,
    perturbed_pose,
    project,
)
from bdgs_ros.mapping.rasterize_types import (
    Array,
    FusedResult,
    Gradients,
    LossWeights,
    Rendered,
    Scene,
    Target,
)

_LOGGER = logging.getLogger(__name__)

_TILE = 16
_MAX_ALPHA = 0.999  # gsplat's
_ALL_BATCHES = 2**31 - 1
_COLOR, _DEPTH, _SILHOUETTE, _DYNAMIC = slice(0, 3), 3, 4, 5  # of the twin's images


def obstacle() -> str | None:
    """Return why gsplat cannot run here, or None if it can; compiles nothing."""
    if not torch.cuda.is_available():
        return 'torch sees no CUDA device'
    try:
        if find_spec('gsplat.csrc') is None and _cuda_home() is None:
            return 'gsplat is not compiled and no CUDA toolkit (nvcc) is there to compile it'
    except ImportError as error:
        return f'gsplat cannot be imported: {error}'
    return None


def _cuda_home() -> str | None:
    from torch.utils.cpp_extension import CUDA_HOME

    return CUDA_HOME


class GsplatBackend:
    """
    gsplat behind the `Backend` protocol.

    Parameters
    ----------
    functions : object, optional
        With gsplat's `isect_tiles`, `isect_offset_encode`, `rasterize_to_pixels` and
        `rasterize_to_indices_in_range`. By default gsplat itself, which on first use compiles its
        kernels if it came without them; that takes minutes, once.
    device : str
        Where tensors live.

    Raises
    ------
    MapError
        If gsplat cannot be imported, compiled or run.

    """

    def __init__(self, functions: Any = None, device: str = 'cuda') -> None:
        self._device = torch.device(device)
        self._gsplat = functions or _load_gsplat(self._device)

    def render(self, scene: Scene, statistics: bool) -> Rendered:
        """Render `scene`."""
        with torch.no_grad():
            view = _View(scene, self._gsplat, self._device)
            images = view.images()
            extra = tuple(_to_numpy(t) for t in view.statistics()) if statistics else ()
        return _rendered(images, *extra)

    def backward(self, scene: Scene, dL_dimages: tuple[Array, Array, Array]) -> Gradients:
        """Return derivatives, given those by color, depth and silhouette."""
        view = _View(scene, self._gsplat, self._device)
        images = view.images()
        color, depth, silhouette = (torch.from_numpy(a).to(images) for a in dL_dimages)
        nothing = torch.zeros_like(depth)
        planes = [depth, silhouette, nothing]
        given = torch.cat([color, *(p[..., None] for p in planes)], dim=2)
        torch.autograd.backward(images, given)
        return view.gradients()

    def fused_step(
        self, scene: Scene, target: Target, weights: LossWeights, with_images: bool
    ) -> FusedResult:
        """Render, compare and differentiate."""
        view = _View(scene, self._gsplat, self._device)
        exposure = torch.tensor(target.exposure, device=self._device, requires_grad=True)
        # TF32, which torch allows in convolutions by default, would spoil the variances of SSIM.
        with torch.backends.cudnn.flags(enabled=True, allow_tf32=False):
            images = view.images()
            with torch.device(self._device):  # the constants that `image_loss` makes
                terms = image_loss(images, exposure, target, weights)
            torch.autograd.backward([terms.total, view.visibility_image.sum()])
        loss, l1, ssim, depth, smooth, empty = torch.stack(terms).detach().tolist()
        assert exposure.grad is not None
        return FusedResult(
            loss=loss,
            l1=l1,
            ssim=ssim,
            depth=depth,
            gradients=view.gradients(),
            exposure_gradient=_to_numpy(exposure.grad),
            visibility=view.visibility(),
            rendered=_rendered(images) if with_images else None,
            smooth=smooth,
            empty=empty,
        )


def _load_gsplat(device: torch.device) -> Any:
    """Import gsplat and make it compile its kernels, on one Gaussian that is not in view."""
    try:
        gsplat = importlib.import_module('gsplat')
        nothing = torch.zeros(1, 1, 2, device=device)
        gsplat.isect_tiles(nothing, nothing.int(), nothing[..., 0], _TILE, 1, 1)
    except Exception as error:  # a compiler, a linker, a driver: no common base
        raise MapError(
            f'gsplat cannot run on {device}: {error}; it needs an NVIDIA driver and either its '
            'compiled kernels or a CUDA toolkit (nvcc) of the version torch was built with'
        ) from error
    card = torch.cuda.get_device_name(device) if device.type == 'cuda' else device
    _LOGGER.info('gsplat %s runs on %s', getattr(gsplat, '__version__', ''), card)
    return gsplat


@dataclass(frozen=True)
class _Packed:
    """What gsplat takes, all contiguous, for one image."""

    means2d: Tensor  # [1, N, 2] px; the centre of the top left pixel is (0.5, 0.5)
    conics: Tensor  # [1, N, 3]
    channels: Tensor  # [1, N, 8] see the top of this file
    opacities: Tensor  # [1, N]
    offsets: Tensor  # [1, rows, columns] int32: where a tile's list begins in `ids`
    ids: Tensor  # [M] int32: Gaussians by tile, near to far


class _View:
    """One scene on the device, tied to its parameters by autograd."""

    def __init__(self, scene: Scene, gsplat: Any, device: torch.device) -> None:
        self.camera = scene.camera
        self._gsplat = gsplat
        self._device = device
        self._leaves = tuple(
            torch.from_numpy(a).to(device).double().requires_grad_(k < 5)
            for k, a in enumerate(scene.gaussians.arrays())
        )
        self._xi = torch.zeros(6, dtype=torch.float64, device=device, requires_grad=True)
        self._probe = torch.zeros(len(scene.gaussians), 1, device=device, requires_grad=True)
        self.splats = self._project(scene)
        self._packed = self._pack()
        self.visibility_image = torch.zeros((), device=device, requires_grad=True)

    def _project(self, scene: Scene) -> Splats:
        flat = [leaf.detach()[:, None].flatten(1) for leaf in self._leaves]
        drawn = torch.cat(flat, dim=1).isfinite().all(dim=1)
        params = tuple(
            torch.where(drawn.reshape(-1, *[1] * (leaf.dim() - 1)), leaf, 0.0)
            for leaf in self._leaves
        )
        if scene.active is not None:
            drawn = drawn & torch.from_numpy(scene.active).to(self._device)
        T_camera_world = torch.from_numpy(scene.T_camera_world).to(self._device)
        with torch.device(self._device):  # the constants that `project` makes
            return project(params, perturbed_pose(T_camera_world, self._xi), self.camera, drawn)

    def _pack(self) -> _Packed | None:
        """Return what gsplat takes, or None where no Gaussian is in view."""
        splats = self.splats
        means2d = (splats.centre + 0.5).float()[None].contiguous()
        offsets, ids = self._sort(means2d.detach())
        if len(ids) == 0:
            return None
        return _Packed(
            means2d,
            splats.conic.float()[None].contiguous(),
            self._channels()[None].contiguous(),
            splats.opacity.float()[None].contiguous(),
            offsets,
            ids,
        )

    def _channels(self) -> Tensor:
        values, slope = self.splats.values, self.splats.depth_slope
        middle = torch.tensor(_middle(self.camera), dtype=slope.dtype, device=self._device)
        depth = values[:, _DEPTH] - (slope * (self.splats.centre - middle)).sum(dim=1)
        columns = [values[:, _COLOR], depth[:, None], slope, values[:, _DYNAMIC, None]]
        return torch.cat([*(c.float() for c in columns), self._probe], dim=1)

    def _sort(self, means2d: Tensor) -> tuple[Tensor, Tensor]:
        """Return tile offsets and the ids of the Gaussians in each tile, near to far."""
        splats = self.splats
        columns, rows = -(-self.camera.width // _TILE), -(-self.camera.height // _TILE)
        radii = torch.where(splats.visible[:, None], splats.half.ceil(), 0.0).int()[None]
        depths = splats.values[:, _DEPTH].detach().float()[None].contiguous()
        _, keys, ids = self._gsplat.isect_tiles(
            means2d, radii.contiguous(), depths, _TILE, columns, rows
        )
        offsets = self._gsplat.isect_offset_encode(keys, 1, columns, rows)
        return offsets.reshape(1, rows, columns), ids

    def images(self) -> Tensor:
        """Return images as the twin does, [H, W, 6], float32."""
        height, width = self.camera.shape
        p = self._packed
        if p is None:
            return torch.zeros(height, width, 6, device=self._device, requires_grad=True)
        blended, alphas = self._gsplat.rasterize_to_pixels(
            p.means2d, p.conics, p.channels, p.opacities, width, height, _TILE, p.offsets, p.ids
        )
        blended, silhouette = blended[0], alphas[0]
        self.visibility_image = blended[..., 7]
        u_0, v_0 = _middle(self.camera)
        u = torch.arange(width, dtype=torch.float32, device=self._device) - u_0
        v = torch.arange(height, dtype=torch.float32, device=self._device)[:, None] - v_0
        depth = blended[..., 3] + u * blended[..., 4] + v * blended[..., 5]
        return torch.cat(
            [blended[..., _COLOR], depth[..., None], silhouette, blended[..., 6, None]], dim=2
        )

    def statistics(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return sum and maximum of each Gaussian's weights and its radius in px, all [N]."""
        total = torch.zeros(len(self.splats.opacity), dtype=torch.float64, device=self._device)
        largest = torch.zeros_like(total)
        if self._packed is not None:
            ids, weights = self._weights(self._packed)
            total.index_add_(0, ids, weights)
            largest.scatter_reduce_(0, ids, weights, 'amax')
        return total, largest, self.splats.half.max(dim=1).values * self.splats.visible

    def _weights(self, p: _Packed) -> tuple[Tensor, Tensor]:
        """Return the Gaussian of every pair of pixel and Gaussian, and its weight there."""
        height, width = self.camera.shape
        ids, pixels, _ = self._gsplat.rasterize_to_indices_in_range(
            0,
            _ALL_BATCHES,
            torch.ones(1, height, width, device=self._device),
            *(p.means2d, p.conics, p.opacities, width, height, _TILE, p.offsets, p.ids),
        )
        at = torch.stack([pixels % width, pixels // width], dim=1) + 0.5
        d = at - p.means2d[0, ids]
        xx, xy, yy = p.conics[0, ids].unbind(1)
        power = -0.5 * (xx * d[:, 0] ** 2 + yy * d[:, 1] ** 2) - xy * d[:, 0] * d[:, 1]
        alpha = (p.opacities[0, ids] * power.exp()).clamp_max(_MAX_ALPHA).double()
        return ids, alpha * _transmittance(alpha, pixels)

    def gradients(self) -> Gradients:
        """Return what backward passes have left at the parameters and the pose."""
        gradients = [_gradient(leaf) for leaf in self._leaves[:5]]
        pose: NDArray[np.float64] = _gradient(self._xi).astype(np.float64)
        if self._xi.grad is not None:
            pose = self._xi.grad.cpu().numpy()
        return Gradients.of(gradients, pose)

    def visibility(self) -> Array:
        """Return the sums of the Gaussians' weights once `visibility_image` was differentiated."""
        return _gradient(self._probe)[:, 0].copy()


def _middle(camera: PinholeCamera) -> tuple[float, float]:
    return (camera.width - 1) / 2, (camera.height - 1) / 2


def _transmittance(alpha: Tensor, pixels: Tensor) -> Tensor:
    """Return what passes the Gaussians before each pair; pairs lie by pixel, near to far."""
    passed = torch.log1p(-alpha)
    before = passed.cumsum(0) - passed
    _, counts = torch.unique_consecutive(pixels, return_counts=True)
    first = counts.cumsum(0) - counts
    return torch.exp(before - before[first].repeat_interleave(counts))


def _to_numpy(tensor: Tensor) -> Array:
    return tensor.detach().float().cpu().numpy()


def _gradient(leaf: Tensor) -> Array:
    return np.zeros(leaf.shape, np.float32) if leaf.grad is None else _to_numpy(leaf.grad)


def _rendered(images: Tensor, *statistics: Array) -> Rendered:
    a = _to_numpy(images)
    color = np.ascontiguousarray(a[..., _COLOR])
    planes = (a[..., k].copy() for k in (_DEPTH, _SILHOUETTE, _DYNAMIC))
    return Rendered(color, *planes, *statistics)
