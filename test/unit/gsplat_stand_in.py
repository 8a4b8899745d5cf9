"""
gsplat's functions in torch on the CPU, after its documentation and kernels (release 1.5.3).

They check what the kernels take for granted (types, layouts, channel counts), blend in float32
with gsplat's constants (alpha cut at 0.999; a pixel ends before the Gaussian that would take its
transmittance to 1e-4) and are differentiated by autograd.
"""

from __future__ import annotations

import torch
from torch import Tensor

CHANNELS = {1, 2, 3, 4, 5, 8, 9, 16, 17, 32, 33}  # for which kernels are compiled; others: padded
MAX_ALPHA, MIN_ALPHA, MIN_TRANSMITTANCE = 0.999, 1 / 255, 1e-4


def isect_tiles(
    means2d: Tensor, radii: Tensor, depths: Tensor, tile_size: int, columns: int, rows: int
) -> tuple[Tensor, Tensor, Tensor]:
    """List the tiles that boxes touch, by tile, then by the bits of the depth."""
    count = means2d.shape[1]
    _expect(means2d, (1, count, 2), torch.float32)
    _expect(radii, (1, count, 2), torch.int32)
    _expect(depths, (1, count), torch.float32)
    low = torch.floor((means2d - radii)[0] / tile_size).int()
    high = torch.ceil((means2d + radii)[0] / tile_size).int()
    limit = torch.tensor([columns, rows], dtype=torch.int32)
    low, high = low.clamp_min(0).minimum(limit), high.clamp_min(0).minimum(limit)
    keys, ids = [], []
    bits = depths[0].view(torch.int32).tolist()
    for k in range(count):
        if not bool((radii[0, k] > 0).all()):
            continue
        for y in range(int(low[k, 1]), int(high[k, 1])):
            for x in range(int(low[k, 0]), int(high[k, 0])):
                keys.append((y * columns + x) << 32 | bits[k])
                ids.append(k)
    sorted_keys, order = torch.sort(torch.tensor(keys, dtype=torch.int64), stable=True)
    sizes = (high - low).prod(dim=1) * (radii[0] > 0).all(dim=1)
    return sizes[None].int(), sorted_keys, torch.tensor(ids, dtype=torch.int32)[order]


def isect_offset_encode(isect_ids: Tensor, n_images: int, columns: int, rows: int) -> Tensor:
    """Return where each tile's list begins."""
    assert n_images == 1
    tiles = torch.arange(rows * columns)
    return torch.searchsorted(isect_ids >> 32, tiles).int().reshape(1, rows, columns)


def rasterize_to_pixels(
    means2d: Tensor,
    conics: Tensor,
    colors: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    tile_size: int,
    offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor]:
    """Blend; returns [1, H, W, channels] and [1, H, W, 1]."""
    count = means2d.shape[1]
    assert colors.shape[-1] in CHANNELS
    _expect(colors, (1, count, colors.shape[-1]), torch.float32)
    images = torch.zeros(height, width, colors.shape[-1])
    alphas = torch.zeros(height, width, 1)
    tiles = _blend(means2d, conics, opacities, width, height, tile_size, offsets, flatten_ids)
    for (v, u), ids, weights in tiles:
        images = images.index_put((v, u), weights @ colors[0, ids])
        alphas = alphas.index_put((v, u), weights.sum(dim=1, keepdim=True))
    return images[None], alphas[None]


def rasterize_to_indices_in_range(
    range_start: int,
    range_end: int,
    transmittances: Tensor,
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    tile_size: int,
    offsets: Tensor,
    flatten_ids: Tensor,
) -> tuple[Tensor, Tensor, Tensor]:
    """Return Gaussian, pixel and image of every blended pair, by pixel, near to far."""
    assert range_start == 0 and flatten_ids.numel() < range_end < 2**32
    _expect(transmittances, (1, height, width), torch.float32)
    assert bool((transmittances == 1).all())
    found: dict[int, list[int]] = {}
    tiles = _blend(means2d, conics, opacities, width, height, tile_size, offsets, flatten_ids)
    for (v, u), ids, weights in tiles:
        for pixel, row in zip((v * width + u).tolist(), weights > 0, strict=True):
            found[pixel] = ids[row].tolist()
    pairs = [(g, pixel) for pixel in sorted(found) for g in found[pixel]]
    table = torch.tensor(pairs, dtype=torch.int64).reshape(-1, 2)
    return table[:, 0], table[:, 1], torch.zeros(len(pairs), dtype=torch.int64)


def _blend(
    means2d: Tensor,
    conics: Tensor,
    opacities: Tensor,
    width: int,
    height: int,
    tile_size: int,
    offsets: Tensor,
    flatten_ids: Tensor,
) -> list[tuple[tuple[Tensor, Tensor], Tensor, Tensor]]:
    """Return pixels (v, u), Gaussians, [n], and weights, [P, n], of every tile."""
    count = means2d.shape[1]
    rows, columns = -(-height // tile_size), -(-width // tile_size)
    _expect(means2d, (1, count, 2), torch.float32)
    _expect(conics, (1, count, 3), torch.float32)
    _expect(opacities, (1, count), torch.float32)
    _expect(offsets, (1, rows, columns), torch.int32)
    _expect(flatten_ids, (len(flatten_ids),), torch.int32)
    ends = [*offsets.flatten().tolist(), len(flatten_ids)]
    found = []
    for tile in range(rows * columns):
        ids = flatten_ids[ends[tile] : ends[tile + 1]].long()
        y, x = divmod(tile, columns)
        v, u = torch.meshgrid(
            torch.arange(y * tile_size, min((y + 1) * tile_size, height)),
            torch.arange(x * tile_size, min((x + 1) * tile_size, width)),
            indexing='ij',
        )
        v, u = v.flatten(), u.flatten()
        d = means2d[0, ids] - torch.stack([u, v], dim=1)[:, None] - 0.5
        conic = conics[0, ids]
        sigma = 0.5 * (conic[:, 0] * d[..., 0] ** 2 + conic[:, 2] * d[..., 1] ** 2)
        sigma = sigma + conic[:, 1] * d[..., 0] * d[..., 1]
        alpha = (opacities[0, ids] * torch.exp(-sigma)).clamp_max(MAX_ALPHA)
        alpha = torch.where((sigma >= 0) & (alpha >= MIN_ALPHA), alpha, 0.0)
        after = torch.cumprod(1 - alpha, dim=1)
        before = torch.cat([torch.ones_like(after[:, :1]), after[:, :-1]], dim=1)
        done = (after <= MIN_TRANSMITTANCE).cumsum(dim=1) > 0
        found.append(((v, u), ids, torch.where(done, 0.0, alpha * before)))
    return found


def _expect(tensor: Tensor, shape: tuple[int, ...], dtype: torch.dtype) -> None:
    assert tensor.shape == shape and tensor.dtype == dtype and tensor.is_contiguous(), (
        f'expected contiguous {dtype} {shape}, received {tensor.dtype} {tuple(tensor.shape)}'
    )
