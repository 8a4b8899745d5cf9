"""Light of the room, baked into its textures so that no surface changes with the view."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.data.synth.shapes import Quad

Array = NDArray[np.float64]
Image = NDArray[np.float32]
AMBIENT = 0.42
_LUXEL_M = 0.12
_FALLOFF_M = 3.0


@dataclass(frozen=True)
class Occluder:
    """A box that casts shadows: T_box_world with the box filling [-1, 1]^3."""

    T_box_world: Array


@dataclass(frozen=True)
class Lighting:
    """Lamps under the ceiling as points, shape (L, 3), that share one unit of light."""

    lamps: Array
    occluders: Sequence[Occluder] = ()

    def bake(self, quad: Quad, cast_shadows: bool) -> Quad:
        """
        Return the rectangle with albedo times light as its texture.

        Without `cast_shadows` the light depends on the direction alone: a thing that will be
        moved keeps its look, and the colours of the static world stay true after the move.
        """
        light = self._at(quad) if cast_shadows else self._of_direction(quad)
        height, width = quad.texture.shape[:2]
        smooth = cv2.resize(
            light.astype(np.float32), (width, height), interpolation=cv2.INTER_LINEAR
        )
        return replace(quad, texture=quad.texture * smooth[..., None])

    def _of_direction(self, quad: Quad) -> Array:
        toward = np.array([0.25, 0.15, 0.95])
        cosine = max(float(quad.normal @ toward) / float(np.linalg.norm(toward)), 0.0)
        return np.full((1, 1), AMBIENT + 0.5 * cosine + 0.1)

    def _at(self, quad: Quad) -> Array:
        rows, columns = (max(2, round(s / _LUXEL_M)) for s in quad.size[::-1])
        v, u = ((np.arange(n) + 0.5) / n for n in (rows, columns))
        points = quad.origin + u[None, :, None] * quad.edge_u + v[:, None, None] * quad.edge_v
        points = points.reshape(-1, 3) + 0.02 * quad.normal
        total = np.zeros(len(points))
        for lamp in self.lamps:
            ray = lamp - points
            distance = np.linalg.norm(ray, axis=1)
            cosine = np.clip(ray @ quad.normal / distance, 0, 1)
            reach = 2.2 / (1 + (distance / _FALLOFF_M) ** 2)
            total += cosine * reach * self._visible(points, ray)
        return AMBIENT + (total / len(self.lamps)).reshape(rows, columns)

    @cached_property
    def _T_box_world(self) -> Image:
        """All occluders, float32 [O, 4, 4]."""
        return np.array([o.T_box_world for o in self.occluders], np.float32).reshape(-1, 4, 4)

    def _visible(self, points: Array, rays: Array) -> Array:
        """Tell which segments points + t rays, t in [0, 1], miss every box (slab method)."""
        T = self._T_box_world
        rotation = T[:, :3, :3]
        start = rotation @ points.T.astype(np.float32) + T[:, :3, 3:]  # [O, 3, n]
        step = rotation @ rays.T.astype(np.float32)
        step[np.abs(step) < 1e-9] = 1e-9
        inverse = 1 / step
        middle, half = -start * inverse, np.abs(inverse)
        enter, leave = (middle - half).max(axis=1), (middle + half).min(axis=1)
        hit = (enter < np.minimum(leave, 1)) & (leave > 0)
        return np.asarray(~hit.any(axis=0), np.float64)


def occluder_of_box(centre: Array, size: Array, T_world_object: Array) -> Occluder:
    """Return the shadow caster of a box given in the frame of its object."""
    T_object_box = np.eye(4)
    T_object_box[:3, :3] = np.diag(np.asarray(size) / 2 * 0.98)
    T_object_box[:3, 3] = centre
    return Occluder(np.asarray(np.linalg.inv(T_world_object @ T_object_box), np.float64))
