"""From visible surfaces to colours: one texture lookup for all of them."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.data.synth.atlas import LEVELS, Atlas
from bdgs_ros.data.synth.raster import QuadricForms, SampleGrid, Visibility
from bdgs_ros.data.synth.shapes import QuadricSet, QuadSet

Array = NDArray[np.float64]
Image = NDArray[np.float32]
_SHARPNESS = -0.6  # mip level bias: four samples half a pixel apart share a pixel
_TOWARD_LIGHT = np.array([0.25, 0.15, 0.95]) / np.linalg.norm([0.25, 0.15, 0.95])


@dataclass(frozen=True)
class CameraScene:
    """The surfaces of one time in the camera frame, and where up is."""

    quads: QuadSet
    quadrics: QuadricSet
    forms: QuadricForms
    rotation: Array
    """World to camera, shape (3, 3)."""


def shade(
    scene: CameraScene, seen: Visibility, grid: SampleGrid, atlas: Atlas, dither: float
) -> NDArray[np.uint8]:
    """
    Return the colour of each pixel, RGB uint8 [H, W, 3].

    Parameters
    ----------
    scene, seen, grid
        What is there, which surface each pixel sees, along which rays.
    atlas : Atlas
        The textures.
    dither : float
        In [0, 1): added to the mip level before rounding down, so that samples of one pixel
        with different values blend neighbouring levels.

    """
    x_map, y_map, level = _quad_texels(scene.quads, seen, grid)
    body = _Bodies.of(scene, seen, grid) if len(scene.quadrics) else None
    if body is not None:
        x_map[body.where], y_map[body.where], level[body.where] = body.texels()
    level += np.float32(_SHARPNESS + dither)
    np.clip(level, 0, LEVELS - 1, out=level)
    index = level.astype(np.uint8)
    scale = atlas.scale[index]
    x_map *= scale
    y_map *= scale
    x_map += (atlas.offset_x - np.float32(0.5))[index]
    y_map -= np.float32(0.5)
    colors = cv2.remap(atlas.image, x_map, y_map, cv2.INTER_LINEAR)
    if body is not None:
        lit = colors[body.where] * body.light()[:, None]
        colors[body.where] = np.minimum(lit + 0.5, 255).astype(np.uint8)
    return np.asarray(colors, np.uint8)


def _quad_texels(quads: QuadSet, seen: Visibility, grid: SampleGrid) -> tuple[Image, Image, Image]:
    """Return atlas position (x, y) and mip level of every pixel as if all saw rectangles."""
    index = np.clip(seen.surface, 0, len(quads) - 1)
    x, y = grid.x.astype(np.float32), grid.y.astype(np.float32)[:, None]
    maps = []
    for axis, k in ((quads.axis_u, 0), (quads.axis_v, 1)):
        density = quads.density[:, k]
        slope = (axis * density[:, None]).astype(np.float32)
        start = np.einsum('qi,qi->q', axis, quads.origin) * density
        constant = (quads.texel0[:, k] - start).astype(np.float32)
        texel = slope[:, 0][index] * x
        texel += slope[:, 1][index] * y
        texel += slope[:, 2][index]
        texel /= seen.inv_depth
        texel += constant[index]
        maps.append(texel)
    offset = np.einsum('qi,qi->q', np.cross(quads.axis_v, quads.axis_u), quads.origin)
    offset = np.maximum(np.abs(offset), 1e-3)
    # texels per pixel: density z / f, times 1 / sqrt(cos) for the slant, cos = offset w / |d|
    base = np.log2(quads.density.max(axis=1) * grid.step / np.sqrt(offset)).astype(np.float32)
    level = np.float32(-1.5) * np.log2(seen.inv_depth)
    level += base[index]
    return maps[0], maps[1], level


@dataclass(frozen=True)
class _Bodies:
    """The pixels that see quadrics: `where` indexes the image, `part` the quadric of each."""

    where: tuple[NDArray[np.int64], NDArray[np.int64]]
    part: NDArray[np.int64]
    local: Image
    """Canonical coordinates, shape (3, n)."""
    w: Image
    scene: CameraScene
    step: float

    @staticmethod
    def of(scene: CameraScene, seen: Visibility, grid: SampleGrid) -> _Bodies | None:
        rows, columns = np.nonzero(seen.surface >= len(scene.quads))
        if not len(rows):
            return None
        part = seen.surface[rows, columns].astype(np.int64) - len(scene.quads)
        w = seen.inv_depth[rows, columns]
        x, y = (grid.x[columns] / w).astype(np.float32), (grid.y[rows] / w).astype(np.float32)
        m = scene.forms.canonical.astype(np.float32)
        local = np.stack(
            [
                m[:, i, 0][part] * x
                + m[:, i, 1][part] * y
                + m[:, i, 2][part] / w
                + m[:, i, 3][part]
                for i in range(3)
            ]
        )
        return _Bodies((rows, columns), part, local, w, scene, grid.step)

    def texels(self) -> tuple[Image, Image, Image]:
        """Return atlas position (x, y) and mip level: azimuth and height unrolled."""
        quadrics = self.scene.quadrics
        region = quadrics.region.astype(np.float32)
        lx, ly, lz = self.local
        azimuth = np.arctan2(ly, lx) * np.float32(0.5 / np.pi) + np.float32(0.5)
        height = np.where(quadrics.is_limb[self.part], 1 - lz, np.float32(0.5) - lz / 2)
        radius = np.linalg.norm(quadrics.T[:, :3, :2], axis=1).mean(axis=1)
        density = quadrics.region[:, 2] / (2 * np.pi * radius)
        base = np.log2(density * self.step).astype(np.float32)
        return (
            region[:, 0][self.part] + azimuth * region[:, 2][self.part],
            region[:, 1][self.part] + np.clip(height, 0, 1) * region[:, 3][self.part],
            base[self.part] - np.log2(self.w),
        )

    def light(self) -> Image:
        """Return Lambert light of one far lamp and of the room, shape (n,)."""
        quadrics, forms = self.scene.quadrics, self.scene.forms
        taper = quadrics.taper.astype(np.float32)[self.part]
        lx, ly, lz = self.local
        gz = np.where(quadrics.is_limb[self.part], -taper * (1 + taper * lz), lz)
        inverse = forms.canonical[:, :, :3]
        toward = (inverse @ (self.scene.rotation @ _TOWARD_LIGHT)).astype(np.float32)
        metric = (inverse @ np.swapaxes(inverse, 1, 2)).astype(np.float32)
        g = (lx, ly, gz)
        along = sum(toward[:, i][self.part] * g[i] for i in range(3))
        square = sum(
            (1 if i == j else 2) * metric[:, i, j][self.part] * g[i] * g[j]
            for i in range(3)
            for j in range(i, 3)
        )
        cosine = along / np.sqrt(np.maximum(square, 1e-12))
        return np.asarray(0.72 + 0.42 * cosine - 0.1 * np.abs(cosine), np.float32)
