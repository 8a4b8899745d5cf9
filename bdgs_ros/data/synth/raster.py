"""
Which surface each pixel sees, and how far it is: exact, one sample per pixel.

A pixel's ray is d = (x, y, 1), so a point at depth z is `z d` and `w = 1 / z` is the quantity
that is linear on planes: for a plane n . p = c it is `w = n . d / c`. Rectangles are filled row
by row between the columns where their edges (linear in x and y too) change sign. Quadrics are
solved per pixel in their bounding box: p' A p + 2 b' p + g = 0 gives
g w^2 + 2 (b.d) w + d'A d = 0, whose larger root is the near side.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.data.synth.shapes import QuadricSet, QuadSet

Array = NDArray[np.float64]
Image = NDArray[np.float32]
_NOTHING = 1e-3  # inverse depth of an empty pixel: a kilometre away
_FLAT = 1e-12


@dataclass(frozen=True)
class SampleGrid:
    """The rays of one sample per pixel: `x` [W] and `y` [H] at z = 1."""

    x: Array
    y: Array
    step: float
    """Difference of neighbouring `x`."""

    @staticmethod
    def of(camera: PinholeCamera, shift: tuple[float, float] = (0.0, 0.0)) -> SampleGrid:
        """Return the grid through pixel centres, or `shift` (right, down) pixels beside them."""
        x: Array = (np.arange(camera.width, dtype=np.float64) + shift[0] - camera.cx) / camera.fx
        y: Array = (np.arange(camera.height, dtype=np.float64) + shift[1] - camera.cy) / camera.fy
        return SampleGrid(x, y, 1 / camera.fx)


@dataclass(frozen=True)
class Visibility:
    """
    What each pixel sees.

    `inv_depth` is 1 / z in 1/m; `surface` indexes the rectangles, then the quadrics; -1 nothing.
    """

    inv_depth: Image
    surface: NDArray[np.int16]

    @staticmethod
    def empty(grid: SampleGrid) -> Visibility:
        """Return an image of nothing."""
        shape = (len(grid.y), len(grid.x))
        return Visibility(np.full(shape, _NOTHING, np.float32), np.full(shape, -1, np.int16))

    def copy(self) -> Visibility:
        """Return an independent copy to draw on."""
        return Visibility(self.inv_depth.copy(), self.surface.copy())

    def put(
        self, rows: slice, columns: slice, w: Image, mask: NDArray[np.bool_], surface: int
    ) -> None:
        """Let a surface win where `mask` allows it and it is nearer than what is there."""
        depth = self.inv_depth[rows, columns]
        mask &= w > depth
        np.copyto(depth, w, where=mask)
        np.copyto(self.surface[rows, columns], np.int16(surface), where=mask)


def draw_quads(
    quads: QuadSet, grid: SampleGrid, target: Visibility, first_surface: int = 0
) -> None:
    """Draw rectangles given in the camera frame; those seen from behind are left out."""
    normal = np.cross(quads.axis_v, quads.axis_u)
    offset = np.einsum('qi,qi->q', normal, quads.origin)
    facing = np.flatnonzero(offset < -1e-6)
    if not len(facing):
        return
    w = (normal / np.where(np.abs(offset) < 1e-9, 1.0, offset)[:, None])[facing]
    low, high = _row_spans(_edges(quads, facing, w), grid)
    used = low <= high
    columns = np.arange(len(grid.x), dtype=np.int32)
    w_row = (w[:, 1:2] * grid.y + w[:, 2:3]).astype(np.float32)
    w_column = (w[:, :1] * grid.x).astype(np.float32)
    for k in np.flatnonzero(used.any(axis=1)):
        row = np.flatnonzero(used[k])
        rows = slice(row[0], row[-1] + 1)
        span_low, span_high = low[k, rows, None], high[k, rows, None]
        across = slice(int(low[k, row].min()), int(high[k, row].max()) + 1)
        mask = columns[across] >= span_low
        mask &= columns[across] <= span_high
        depth = w_row[k, rows, None] + w_column[k, across]
        target.put(rows, across, depth, mask, first_surface + int(facing[k]))


def _edges(quads: QuadSet, facing: NDArray[np.int64], w: Array) -> Array:
    """Return four linear functions of the ray that are >= 0 inside, shape (q, 4, 3)."""
    edges = []
    for axis, size in ((quads.axis_u, quads.size[:, 0]), (quads.axis_v, quads.size[:, 1])):
        start = np.einsum('qi,qi->q', axis, quads.origin)[facing, None]
        edges.append(axis[facing] - start * w)
        edges.append((start + size[facing, None]) * w - axis[facing])
    return np.stack(edges, axis=1)


def _row_spans(edges: Array, grid: SampleGrid) -> tuple[NDArray[np.int32], NDArray[np.int32]]:
    """Return first and last column inside all edges for each row, shape (q, H) each."""
    width = len(grid.x)
    at_row = edges[..., 1:2] * grid.y + edges[..., 2:3]  # [q, 4, H] value at x = 0
    slope = edges[..., 0:1]
    flat = np.abs(slope) < _FLAT
    column = (-at_row / np.where(flat, 1.0, slope) - grid.x[0]) / grid.step
    outside = (flat & (at_row < 0)).any(axis=1)
    low = np.where(slope > _FLAT, np.ceil(column), 0).max(axis=1)
    high = np.where(slope < -_FLAT, np.floor(column), width - 1).min(axis=1)
    low, high = np.clip(low, 0, width), np.clip(high, -1, width - 1)
    low[outside] = width
    return low.astype(np.int32), high.astype(np.int32)


@dataclass(frozen=True)
class QuadricForms:
    """
    Quadrics of the camera frame as polynomials.

    `canonical` maps camera to canonical coordinates [P, 3, 4]; `b` [P, 3], `g` [P] and the
    discriminant `D = (b.d)^2 - g d'A d` as a matrix [P, 3, 3].
    """

    canonical: Array
    b: Array
    g: Array
    discriminant: Array

    @staticmethod
    def of(quadrics: QuadricSet) -> QuadricForms:
        """Return the forms of quadrics given in the camera frame."""
        inverse: Array = np.asarray(np.linalg.inv(quadrics.T), np.float64)
        shape = np.zeros((len(quadrics), 4, 4))
        shape[:, [0, 1], [0, 1]] = 1.0
        k, is_limb = quadrics.taper, quadrics.is_limb
        shape[:, 2, 2] = np.where(is_limb, -(k**2), 1.0)
        shape[:, 2, 3] = shape[:, 3, 2] = np.where(is_limb, -k, 0.0)
        shape[:, 3, 3] = -1.0
        q = np.swapaxes(inverse, 1, 2) @ shape @ inverse
        a, b, g = q[:, :3, :3], q[:, :3, 3], q[:, 3, 3]
        discriminant = b[:, :, None] * b[:, None, :] - g[:, None, None] * a
        return QuadricForms(inverse[:, :3], b, g, discriminant)


def draw_quadrics(
    quadrics: QuadricSet,
    forms: QuadricForms,
    grid: SampleGrid,
    target: Visibility,
    first_surface: int,
) -> None:
    """Draw quadrics given in the camera frame."""
    if not len(quadrics):
        return
    boxes = _pixel_boxes(quadrics, grid)
    for k, (left, top, right, bottom) in enumerate(boxes):
        if right > left and bottom > top and forms.g[k] > 0:
            rows, columns = slice(int(top), int(bottom)), slice(int(left), int(right))
            x, y = grid.x[columns], grid.y[rows]
            w, mask = _near_root(forms, k, x, y)
            if quadrics.is_limb[k]:
                mask &= _between_ends(forms.canonical[k, 2], x, y, w)
            target.put(rows, columns, w, mask, first_surface + k)


def _linear(coefficients: Array, x: Array, y: Array) -> Image:
    column = (coefficients[0] * x).astype(np.float32)
    row = (coefficients[1] * y + coefficients[2]).astype(np.float32)
    return np.asarray(row[:, None] + column)


def _near_root(forms: QuadricForms, k: int, x: Array, y: Array) -> tuple[Image, NDArray[np.bool_]]:
    """Return inverse depth of the near side and where the ray meets the quadric."""
    m = forms.discriminant[k]
    x0, y0 = x[len(x) // 2], y[len(y) // 2]  # about the middle float32 loses nothing
    shift = np.array([[1.0, 0, x0], [0, 1, y0], [0, 0, 1]])
    m = shift.T @ m @ shift
    u, v = x - x0, y - y0
    column = (m[0, 0] * u * u + 2 * m[0, 2] * u).astype(np.float32)
    row = (m[1, 1] * v * v + 2 * m[1, 2] * v + m[2, 2]).astype(np.float32)
    root = (2 * m[0, 1] * v).astype(np.float32)[:, None] * u.astype(np.float32)
    root += column
    root += row[:, None]
    mask = root > 0
    np.maximum(root, 0, out=root)
    np.sqrt(root, out=root)
    root -= _linear(forms.b[k], x, y)
    root *= np.float32(1 / forms.g[k])
    return root, mask


def _between_ends(axis: Array, x: Array, y: Array, w: Image) -> NDArray[np.bool_]:
    along = _linear(axis[:3], x, y) + np.float32(axis[3]) * w
    return np.asarray((along >= 0) & (along <= w))


def _pixel_boxes(quadrics: QuadricSet, grid: SampleGrid) -> NDArray[np.int64]:
    """
    Return left, top, right, bottom (exclusive) of each quadric, shape (P, 4).

    Bounds come from dual conics: of the ellipsoid, or of the discs that close a limb.
    """
    start, end = quadrics.T.copy(), quadrics.T.copy()
    limb = quadrics.is_limb
    start[limb, :, 2] = 0
    end[limb, :, 3] += end[limb, :, 2]
    end[limb, :, :2] *= (1 + quadrics.taper[limb])[:, None, None]
    end[limb, :, 2] = 0
    bounds = [_extent(T, grid) for T in (start, end)]
    low = np.minimum(bounds[0][0], bounds[1][0])
    high = np.maximum(bounds[0][1], bounds[1][1])
    return np.concatenate([low, high + 1], axis=1).astype(np.int64)


def _extent(T: Array, grid: SampleGrid) -> tuple[Array, Array]:
    """Return inclusive pixel bounds (column, row) of unit spheres mapped by T."""
    dual = np.einsum('pij,j,pkj->pik', T, [1.0, 1.0, 1.0, -1.0], T)
    zz, centre_z = dual[:, 2, 2], T[:, 2, 3]
    whole = np.array([len(grid.x) - 1, len(grid.y) - 1])
    low, high = np.zeros((len(T), 2)), np.tile(whole.astype(np.float64), (len(T), 1))
    proper = zz < -1e-6
    steps = (grid.step, float(grid.y[1] - grid.y[0]))
    for i, (first, step) in enumerate(zip((grid.x[0], grid.y[0]), steps, strict=True)):
        spread = np.sqrt(np.maximum(dual[:, i, 2] ** 2 - dual[:, i, i] * zz, 0))
        ends = (dual[:, i, 2] + np.array([[1.0], [-1.0]]) * spread) / np.where(proper, zz, -1)
        pixels = (ends - first) / step
        low[proper, i] = np.floor(pixels[:, proper].min(axis=0))
        high[proper, i] = np.ceil(pixels[:, proper].max(axis=0))
    low, high = np.maximum(low, 0), np.minimum(high, whole)
    high[proper & (centre_z < 0)] = -1
    return low, high
