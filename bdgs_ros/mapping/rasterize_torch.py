"""
The rasteriser in torch, float64: the readable twin of `src/rasterizer.cpp`.

Same formulas, same order of Gaussians, derivatives by autograd. Tiles of pixels are rendered one
after the other and differentiated one after the other, so memory stays bounded.
"""

from __future__ import annotations

from dataclasses import dataclass, fields
from typing import NamedTuple

import numpy as np
import torch
from torch import Tensor
from torch.nn.functional import conv2d

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.mapping.rasterize_types import (
    Array,
    FusedResult,
    Gradients,
    LossWeights,
    Rendered,
    Scene,
    Target,
)

NEAR_M = 0.05
LOW_PASS_PX2 = 0.3
MIN_ALPHA = 1 / 255
MAX_ALPHA = 0.99
MIN_TRANSMITTANCE = 1e-4
CLAMP_MARGIN = 0.15  # of the image size on each side: 1.3 times the field of view
SSIM_RADIUS, SSIM_SIGMA = 5, 1.5
SSIM_C1, SSIM_C2 = 0.01**2, 0.03**2
EDGE_DECAY = 10.0  # as in MonoGS
MIN_SILHOUETTE = 0.5  # less than half covered has no surface to be smooth

_TILE = 16
_COLOR, _DEPTH, _SILHOUETTE, _DYNAMIC = slice(0, 3), 3, 4, 5


@dataclass(frozen=True)
class Splats:
    """Gaussians in the image."""

    centre: Tensor  # [N, 2] px
    conic: Tensor  # [N, 3] inverse covariance: xx, xy, yy
    opacity: Tensor  # [N]
    values: Tensor  # [N, 6] what is blended: colour, depth at the centre, 1, p_dynamic
    depth_slope: Tensor  # [N, 2] metres per px: change of depth with the pixel
    half: Tensor  # [N, 2] half sizes of the box in which alpha >= 1/255, px
    visible: Tensor  # [N] bool


def rotation_matrices(quats: Tensor) -> Tensor:
    """Return rotations, [N, 3, 3], of quaternions wxyz of any length, [N, 4]."""
    norm = quats.norm(dim=1, keepdim=True).clamp_min(1e-12)
    w, x, y, z = (quats / norm).unbind(1)
    rows = [
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    ]
    return torch.stack([torch.stack(row, dim=1) for row in rows], dim=1)


def perturbed_pose(T_camera_world: Tensor, xi: Tensor) -> tuple[Tensor, Tensor]:
    """Return rotation and translation of exp(xi) T to first order in xi = (rho, phi), [6]."""
    zero = torch.zeros((), dtype=xi.dtype)
    x, y, z = xi[3], xi[4], xi[5]
    hat = torch.stack([zero, -z, y, z, zero, -x, -y, x, zero]).reshape(3, 3)
    R, t = T_camera_world[:3, :3], T_camera_world[:3, 3]
    return R + hat @ R, t + hat @ t + xi[:3]


def project(
    params: tuple[Tensor, ...], pose: tuple[Tensor, Tensor], camera: PinholeCamera, active: Tensor
) -> Splats:
    """Project Gaussians (the six arrays of `Gaussians`) to ellipses in the image."""
    means, quats, log_scales, logits, colors, p_dynamic = params
    R, t = pose
    points = means @ R.T + t
    z = torch.where(points[:, 2] > NEAR_M, points[:, 2], torch.ones_like(points[:, 2]))
    slope = points[:, :2] / z[:, None]
    focal = torch.tensor([camera.fx, camera.fy], dtype=means.dtype)
    offset = torch.tensor([camera.cx, camera.cy], dtype=means.dtype)
    size = torch.tensor([camera.width, camera.height], dtype=means.dtype)
    margin = CLAMP_MARGIN * size / focal
    held = torch.maximum(slope, -offset / focal - margin)
    held = torch.minimum(held, (size - offset) / focal + margin)
    M = R @ rotation_matrices(quats) * log_scales.exp()[:, None, :]
    U = (focal / z[:, None])[..., None] * (M[:, :2] - held[..., None] * M[:, 2:])
    covariance = U @ U.transpose(1, 2) + LOW_PASS_PX2 * torch.eye(2, dtype=means.dtype)
    xx, xy, yy = covariance[:, 0, 0], covariance[:, 0, 1], covariance[:, 1, 1]
    det = xx * yy - xy * xy
    centre = focal * slope + offset
    opacity = torch.sigmoid(logits)
    conic = torch.stack([yy, -xy, xx], dim=1) / det[:, None]
    half = _half_sizes(opacity, torch.stack([xx, yy], dim=1)).detach()
    first = (centre - half).detach().ceil().clamp_min(0)  # pixel centres in the box
    last = torch.minimum((centre + half).detach().floor(), size - 1)
    inside = (first <= last).all(dim=1)
    visible = active & (points[:, 2] > NEAR_M) & (opacity > MIN_ALPHA) & inside
    values = [colors, z[:, None], torch.ones_like(z)[:, None], p_dynamic[:, None]]
    return Splats(
        centre,
        conic,
        opacity,
        torch.cat(values, dim=1),
        _depth_slope(conic, U, M[:, 2]),
        half,
        visible,
    )


def _depth_slope(conic: Tensor, U: Tensor, M_z: Tensor) -> Tensor:
    """Return S^-1 cov(image position, z): z given the pixel moves by this much per px, [N, 2]."""
    c = (U @ M_z[..., None])[..., 0]
    along_u = conic[:, 0] * c[:, 0] + conic[:, 1] * c[:, 1]
    along_v = conic[:, 1] * c[:, 0] + conic[:, 2] * c[:, 1]
    return torch.stack([along_u, along_v], dim=1)


def _half_sizes(opacity: Tensor, variances: Tensor) -> Tensor:
    reach = 2 * torch.log((opacity / MIN_ALPHA).clamp_min(1.0))
    return torch.sqrt(variances * reach[:, None])


def blend(splats: Splats, order: Tensor, pixels: Tensor) -> tuple[Tensor, Tensor]:
    """
    Blend Gaussians front to back.

    Parameters
    ----------
    splats : Splats
        All of them.
    order : Tensor, shape (n,), int64
        Those that matter here, near to far.
    pixels : Tensor, shape (P, 2)
        Image coordinates (u, v).

    Returns
    -------
    values : Tensor, shape (P, 6)
        Colour, depth, silhouette, p_dynamic.
    weights : Tensor, shape (P, n)
        alpha_i T_i.

    """
    d = pixels[:, None, :] - splats.centre[order][None]
    conic = splats.conic[order]
    power = -0.5 * (conic[:, 0] * d[..., 0] ** 2 + conic[:, 2] * d[..., 1] ** 2)
    power = power - conic[:, 1] * d[..., 0] * d[..., 1]
    alpha = splats.opacity[order] * torch.exp(power)
    alpha = torch.where(alpha >= MIN_ALPHA, alpha.clamp_max(MAX_ALPHA), torch.zeros_like(alpha))
    through = torch.cumprod(1 - alpha, dim=1)
    before = torch.cat([torch.ones_like(through[:, :1]), through[:, :-1]], dim=1)
    weights = torch.where(before >= MIN_TRANSMITTANCE, alpha * before, torch.zeros_like(alpha))
    values = weights @ splats.values[order]
    beside = (weights * (d * splats.depth_slope[order]).sum(dim=2)).sum(dim=1)
    depth = values[:, _DEPTH] + beside
    return torch.cat([values[:, _COLOR], depth[:, None], values[:, _SILHOUETTE:]], dim=1), weights


@dataclass(frozen=True)
class _Tile:
    rows: slice
    columns: slice
    pixels: Tensor  # [P, 2]
    order: Tensor  # [n]


def _tiles(splats: Splats, camera: PinholeCamera) -> list[_Tile]:
    """Cut the image into tiles, each with the Gaussians whose boxes touch it, near to far."""
    depth = splats.values[:, _DEPTH].detach()
    visible = torch.nonzero(splats.visible)[:, 0]
    order = visible[torch.argsort(depth[visible], stable=True)]
    low = (splats.centre - splats.half).detach()[order]
    high = (splats.centre + splats.half).detach()[order]
    tiles = []
    for y in range(0, camera.height, _TILE):
        for x in range(0, camera.width, _TILE):
            y1, x1 = min(y + _TILE, camera.height), min(x + _TILE, camera.width)
            touch = (low[:, 0] <= x1 - 1) & (high[:, 0] >= x)
            touch &= (low[:, 1] <= y1 - 1) & (high[:, 1] >= y)
            v, u = torch.meshgrid(torch.arange(y, y1), torch.arange(x, x1), indexing='ij')
            pixels = torch.stack([u, v], dim=-1).reshape(-1, 2).to(low.dtype)
            tiles.append(_Tile(slice(y, y1), slice(x, x1), pixels, order[touch]))
    return tiles


def masked_ssim(x: Tensor, y: Tensor, mask: Tensor) -> Tensor:
    """
    Return SSIM maps of images [3, H, W], with windows normalised over `mask`, [H, W] in {0, 1}.

    Window and constants of Wang et al., "Image quality assessment", 2004.
    """
    d = torch.arange(-SSIM_RADIUS, SSIM_RADIUS + 1, dtype=x.dtype)
    line = torch.exp(-(d**2) / (2 * SSIM_SIGMA**2))
    line = (line / line.sum())[None, None]

    def blur(image: Tensor) -> Tensor:
        across = conv2d(image[:, None], line[..., None, :], padding=(0, SSIM_RADIUS))
        return conv2d(across, line[..., None], padding=(SSIM_RADIUS, 0))[:, 0]

    n = blur(mask[None]).clamp_min(1e-6)
    x, y = x * mask, y * mask
    mx, my = blur(x) / n, blur(y) / n
    variances = blur(x * x + y * y) / n - mx**2 - my**2
    covariance = blur(x * y) / n - mx * my
    upper = (2 * mx * my + SSIM_C1) * (2 * covariance + SSIM_C2)
    return upper / ((mx**2 + my**2 + SSIM_C1) * (variances + SSIM_C2))


def smoothness(images: Tensor, wanted: Tensor, share: Tensor) -> Tensor:
    """
    Return how far the rendered depth is from locally plane, off the edges of the target.

    The first term of Eq. 8 in the edge-aware form of `depth_reg` in MonoGS, Matsuki et al.,
    "Gaussian Splatting SLAM", 2024: exp(-10 |grad T|^2) |grad z|. A first difference would turn
    walls towards the camera; here a pixel's depth is compared with that of the line through its
    two neighbours, 2 z_- z_+ / (z_- + z_+), which is exact on any plane.

    Parameters
    ----------
    images : Tensor, shape (H, W, 6)
        As rendered. Pixels count where the silhouette is above one half.
    wanted : Tensor, shape (H, W, 3)
        RGB of the target.
    share : Tensor, shape (H, W)
        Weight of each pixel; triples with a 0 do not count.

    """
    silhouette = images[..., _SILHOUETTE]
    counts = (silhouette > MIN_SILHOUETTE) & (share > 0)
    z = torch.where(counts, images[..., _DEPTH] / silhouette.clamp_min(MIN_SILHOUETTE), 0.0)
    total = torch.zeros((), dtype=images.dtype)
    for axis in (0, 1):
        length = images.shape[axis]
        if length < 3:
            continue

        def triple(image: Tensor, axis: int = axis, length: int = length) -> tuple[Tensor, ...]:
            return tuple(image.narrow(axis, k, length - 2) for k in range(3))

        before, middle, after = triple(z)
        known = (before > 0) & (middle > 0) & (after > 0)
        left, here, right = triple(wanted)
        edge = ((here - left) ** 2 + (here - right) ** 2).mean(dim=2)
        weight = torch.where(known, torch.exp(-EDGE_DECAY * edge) * triple(share)[1], 0.0)
        bend = middle - 2 * before * after / (before + after).clamp_min(1e-6)
        total = total + (weight * bend.abs()).sum()
    return total


class ImageLoss(NamedTuple):
    """The loss of one view and its terms, scalars; see `fused_step`."""

    total: Tensor
    l1: Tensor
    ssim: Tensor  # 1 - SSIM
    depth: Tensor
    smooth: Tensor
    empty: Tensor  # 1 - silhouette where depth is known


def image_loss(
    images: Tensor, exposure: Tensor, target: Target, weights: LossWeights
) -> ImageLoss:
    """Compare `images`, [H, W, 6] as `blend` orders them, with the target; see `fused_step`."""
    weight = torch.from_numpy(target.weight).to(images)
    mask = weight > 0
    weight = torch.where(mask, weight, torch.zeros_like(weight))
    share = weight / weight.sum().clamp_min(1e-30)
    wanted = torch.from_numpy(target.color).to(images)
    wanted = torch.where(mask[..., None], wanted, torch.zeros_like(wanted))
    seen = torch.exp(exposure[0]) * images[..., _COLOR] + exposure[1]
    l1 = (share * (seen - wanted).abs().mean(dim=2)).sum()
    ssim = masked_ssim(seen.permute(2, 0, 1), wanted.permute(2, 0, 1), mask.to(images.dtype))
    dissimilarity = (share * (1 - ssim.mean(dim=0))).sum()
    smooth = smoothness(images, wanted, share) if weights.smooth > 0 else torch.zeros_like(l1)
    depth = torch.from_numpy(target.depth).to(images)
    known = (depth > 0) & (depth < 1e30)
    depth = torch.where(known, depth, torch.zeros_like(depth))
    share = known * weight / (known * weight).sum().clamp_min(1e-30)
    silhouette = images[..., _SILHOUETTE]
    shown = images[..., _DEPTH] / silhouette.clamp_min(1e-6)
    # what hardly shows pulls hardly; src/rasterizer_loss.hpp says why that has no derivative
    error = (share * silhouette.detach() * (shown - depth).abs()).sum()
    empty = (share * (1 - silhouette)).sum()
    color = (1 - weights.ssim) * l1 + weights.ssim * dissimilarity
    total = weights.color * color + weights.depth * error + weights.smooth * smooth
    total = total + weights.empty * empty
    return ImageLoss(total, l1, dissimilarity, error, smooth, empty)


class _View:
    """One scene as torch tensors, ready to be rendered and differentiated."""

    def __init__(self, scene: Scene) -> None:
        self.camera = scene.camera
        self.leaves = tuple(
            torch.from_numpy(a).to(torch.float64).requires_grad_(k < 5)
            for k, a in enumerate(scene.gaussians.arrays())
        )
        self.xi = torch.zeros(6, dtype=torch.float64, requires_grad=True)
        flat = [leaf.detach()[:, None].flatten(1) for leaf in self.leaves]
        drawn = torch.cat(flat, dim=1).isfinite().all(dim=1)
        params = tuple(_zero_unless(drawn, leaf) for leaf in self.leaves)
        if scene.active is not None:
            drawn = drawn & torch.from_numpy(scene.active.copy())
        pose = perturbed_pose(torch.from_numpy(scene.T_camera_world.copy()), self.xi)
        self.splats = project(params, pose, scene.camera, drawn)
        self.tiles = _tiles(self.splats, scene.camera)

    def images(self) -> tuple[Tensor, Tensor, Tensor]:
        """Return images, [H, W, 6], and sum and maximum of each Gaussian's weights, [N]."""
        images = torch.zeros((*self.camera.shape, 6), dtype=torch.float64)
        total = torch.zeros(len(self.splats.opacity), dtype=torch.float64)
        largest = torch.zeros_like(total)
        with torch.no_grad():
            for tile in self.tiles:
                if len(tile.order) == 0:
                    continue
                values, weights = blend(self.splats, tile.order, tile.pixels)
                part = images[tile.rows, tile.columns]
                part.copy_(values.reshape(part.shape))
                total[tile.order] += weights.sum(dim=0)
                largest[tile.order] = torch.maximum(largest[tile.order], weights.max(dim=0).values)
        return images, total, largest

    def differentiate(self, dL_dimages: Tensor) -> Gradients:
        """Carry derivatives by the images, [H, W, 6], back to the parameters and the pose."""
        names = [f.name for f in fields(Splats)]
        cut = {name: getattr(self.splats, name).detach() for name in names}
        differentiated = ('centre', 'conic', 'opacity', 'values', 'depth_slope')
        for name in differentiated:
            cut[name].requires_grad_()
        splats = Splats(**cut)
        for tile in self.tiles:
            if len(tile.order) > 0:
                values, _ = blend(splats, tile.order, tile.pixels)
                given = dL_dimages[tile.rows, tile.columns].reshape(values.shape)
                torch.autograd.backward(values, given)
        seen = [n for n in differentiated if cut[n].grad is not None]
        if seen:
            torch.autograd.backward(
                [getattr(self.splats, n) for n in seen], [cut[n].grad for n in seen]
            )
        gradients = [_gradient(leaf) for leaf in self.leaves[:5]]
        return Gradients.of(gradients, _pose_gradient(self.xi))


def _zero_unless(mask: Tensor, leaf: Tensor) -> Tensor:
    return torch.where(mask.reshape(-1, *[1] * (leaf.dim() - 1)), leaf, torch.zeros_like(leaf))


def _gradient(leaf: Tensor) -> Array:
    if leaf.grad is None:
        return np.zeros(leaf.shape, np.float32)
    return np.asarray(leaf.grad.numpy(), np.float32)


def _pose_gradient(xi: Tensor) -> np.ndarray[tuple[int, ...], np.dtype[np.float64]]:
    return np.zeros(6) if xi.grad is None else np.asarray(xi.grad.numpy(), np.float64)


def _rendered(images: Tensor) -> Rendered:
    a = images.detach().numpy().astype(np.float32)
    color = np.ascontiguousarray(a[..., _COLOR])
    return Rendered(
        color, a[..., _DEPTH].copy(), a[..., _SILHOUETTE].copy(), a[..., _DYNAMIC].copy()
    )


class TorchBackend:
    """The twin behind the `Backend` protocol."""

    def render(self, scene: Scene, statistics: bool) -> Rendered:
        """Render `scene`."""
        view = _View(scene)
        images, total, largest = view.images()
        plain = _rendered(images)
        if not statistics:
            return plain
        radius = view.splats.half.max(dim=1).values * view.splats.visible
        extra = (t.numpy().astype(np.float32) for t in (total, largest, radius))
        return Rendered(plain.color, plain.depth, plain.silhouette, plain.p_dynamic, *extra)

    def backward(self, scene: Scene, dL_dimages: tuple[Array, Array, Array]) -> Gradients:
        """Return derivatives, given those by color, depth and silhouette."""
        given = torch.zeros((*scene.camera.shape, 6), dtype=torch.float64)
        color, depth, silhouette = (torch.from_numpy(a).to(torch.float64) for a in dL_dimages)
        given[..., _COLOR] = color
        given[..., _DEPTH] = depth
        given[..., _SILHOUETTE] = silhouette
        return _View(scene).differentiate(given)

    def fused_step(
        self, scene: Scene, target: Target, weights: LossWeights, with_images: bool
    ) -> FusedResult:
        """Render, compare and differentiate."""
        view = _View(scene)
        images, total, _ = view.images()
        images.requires_grad_()
        exposure = torch.tensor(target.exposure, dtype=torch.float64, requires_grad=True)
        loss = image_loss(images, exposure, target, weights)
        torch.autograd.backward(loss.total)
        assert images.grad is not None and exposure.grad is not None
        return FusedResult(
            loss.total.item(),
            loss.l1.item(),
            loss.ssim.item(),
            loss.depth.item(),
            view.differentiate(images.grad),
            exposure.grad.numpy().astype(np.float32),
            total.numpy().astype(np.float32),
            _rendered(images) if with_images else None,
            loss.smooth.item(),
            loss.empty.item(),
        )
