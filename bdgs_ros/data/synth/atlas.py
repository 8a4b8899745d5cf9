"""All textures of a scene in one image with its mipmaps side by side."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.data.synth.shapes import Quad, QuadSet

LEVELS = 5
_GUTTER = 1 << (LEVELS - 1)  # one texel of margin is left at the coarsest level
_WIDTH = 4096


@dataclass(frozen=True)
class Atlas:
    """
    The image and where its levels lie.

    A texel position (x, y) of level 0, measured from outer corners, is
    `(x * scale[l] - 0.5 + offset_x[l], y * scale[l] - 0.5)` in the coordinates of `cv2.remap`.
    """

    image: NDArray[np.uint8]
    scale: NDArray[np.float32]
    offset_x: NDArray[np.float32]


class AtlasBuilder:
    """Collect textures, pack them on shelves, then say where each one went."""

    def __init__(self) -> None:
        self._textures: list[NDArray[np.float32]] = []
        self._quads: dict[int, tuple[Sequence[Quad], int]] = {}
        self._bodies: dict[int, tuple[int, int]] = {}
        self._corners: list[tuple[int, int]] = []

    def reserve_quads(self, object_id: int, quads: Sequence[Quad]) -> None:
        """Add the textures of an object made of rectangles."""
        self._quads[object_id] = (quads, len(self._textures))
        self._textures.extend(quad.texture for quad in quads)

    def reserve_body(self, object_id: int, textures: Sequence[NDArray[np.float32]]) -> None:
        """Add the textures of an object made of quadrics."""
        self._bodies[object_id] = (len(self._textures), len(textures))
        self._textures.extend(textures)

    def build(self) -> Atlas:
        """Pack everything that was reserved and make the mipmaps."""
        height = self._pack()
        level = np.zeros((height, _WIDTH, 3), np.uint8)
        for texture, (x, y) in zip(self._textures, self._corners, strict=True):
            level[
                y - _GUTTER : y + texture.shape[0] + _GUTTER,
                x - _GUTTER : x + texture.shape[1] + _GUTTER,
            ] = _with_gutter(texture)
        return _with_mipmaps(level)

    def _pack(self) -> int:
        self._corners = [(0, 0)] * len(self._textures)
        x = y = shelf = 0
        for index in sorted(range(len(self._textures)), key=lambda i: -len(self._textures[i])):
            cell_h, cell_w = (_cell(s) for s in self._textures[index].shape[:2])
            if x + cell_w > _WIDTH:
                x, y, shelf = 0, y + shelf, 0
            self._corners[index] = (x + _GUTTER, y + _GUTTER)
            x, shelf = x + cell_w, max(shelf, cell_h)
        return y + shelf

    def quad_set(self, object_id: int) -> QuadSet:
        """Return the rectangles of an object, in its frame."""
        quads, first = self._quads[object_id]
        size = np.array([q.size for q in quads])
        texels = np.array([q.texture.shape[1::-1] for q in quads])
        return QuadSet(
            origin=np.array([q.origin for q in quads], dtype=np.float64),
            axis_u=np.array([q.edge_u for q in quads]) / size[:, :1],
            axis_v=np.array([q.edge_v for q in quads]) / size[:, 1:],
            size=size,
            texel0=np.array(self._corners[first : first + len(quads)], dtype=np.float64),
            density=texels / size,
            object_id=np.full(len(quads), object_id),
        )

    def regions(self, object_id: int) -> NDArray[np.float64]:
        """Return x, y, width and height of each texture of a body, shape (n, 4)."""
        first, count = self._bodies[object_id]
        return np.array(
            [
                (*self._corners[i], *self._textures[i].shape[1::-1])
                for i in range(first, first + count)
            ],
            dtype=np.float64,
        )


def _cell(texels: int) -> int:
    return -(-(texels + 2 * _GUTTER) // _GUTTER) * _GUTTER


def _with_gutter(texture: NDArray[np.float32]) -> NDArray[np.uint8]:
    image = np.clip(texture * 255 + 0.5, 0, 255).astype(np.uint8)
    g = _GUTTER
    return np.asarray(cv2.copyMakeBorder(image, g, g, g, g, cv2.BORDER_REPLICATE), np.uint8)


def _with_mipmaps(level: NDArray[np.uint8]) -> Atlas:
    height = -(-level.shape[0] // _GUTTER) * _GUTTER
    image = np.zeros((height, 2 * _WIDTH, 3), np.uint8)
    offsets, x = [], 0
    for _ in range(LEVELS):
        h, w = level.shape[:2]
        image[:h, x : x + w] = level
        offsets.append(x)
        x += w
        level = np.asarray(
            cv2.resize(level, (w // 2, h // 2), interpolation=cv2.INTER_AREA), np.uint8
        )
    scale = 0.5 ** np.arange(LEVELS, dtype=np.float32)
    return Atlas(image, scale, np.array(offsets, np.float32))
