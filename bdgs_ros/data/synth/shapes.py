"""
The two kinds of surface of a scene: textured rectangles and textured quadrics.

Both exist in sets of arrays, so that a whole scene is moved and projected in a few operations.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.data.synth.textures import Texture

Array = NDArray[np.float64]
Matrix = NDArray[np.float64]


@dataclass(frozen=True)
class Quad:
    """
    A rectangle seen from the side on which `edge_u` runs right when `edge_v` runs down.

    Texture columns run along `edge_u` and rows along `edge_v`, from `origin`; all in metres in
    the frame of the object.
    """

    origin: Array
    edge_u: Array
    edge_v: Array
    texture: Texture

    @property
    def size(self) -> tuple[float, float]:
        """The lengths of both edges in metres."""
        return float(np.linalg.norm(self.edge_u)), float(np.linalg.norm(self.edge_v))

    @property
    def normal(self) -> Array:
        """The unit normal on the visible side, shape (3,)."""
        n = np.cross(self.edge_v, self.edge_u)
        return np.asarray(n / np.linalg.norm(n))


@dataclass(frozen=True)
class QuadSet:
    """
    `Q` rectangles in one frame, their textures in an atlas.

    `axis_u`, `axis_v` are unit vectors [Q, 3]; `size` metres [Q, 2]; `texel0` atlas position of
    the first texel's outer corner [Q, 2]; `density` texels per metre [Q, 2].
    """

    origin: Array
    axis_u: Array
    axis_v: Array
    size: Array
    texel0: Array
    density: Array
    object_id: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of rectangles."""
        return len(self.origin)

    def transformed(self, T_a_b: Matrix) -> QuadSet:
        """Move the set from frame b to frame a."""
        rotation = T_a_b[:3, :3].T
        return replace(
            self,
            origin=self.origin @ rotation + T_a_b[:3, 3],
            axis_u=self.axis_u @ rotation,
            axis_v=self.axis_v @ rotation,
        )

    @staticmethod
    def concatenate(sets: Sequence[QuadSet]) -> QuadSet:
        """Join sets that are in one frame."""
        names = ('origin', 'axis_u', 'axis_v', 'size', 'texel0', 'density', 'object_id')
        return QuadSet(*(np.concatenate([getattr(s, name) for s in sets]) for name in names))


@dataclass(frozen=True)
class QuadricSet:
    """
    `P` ellipsoids and tapered limbs in one frame, their textures in an atlas.

    `T` maps canonical to frame coordinates [P, 4, 4]. An ellipsoid is canonically the unit
    sphere; a limb is `x^2 + y^2 = (1 + taper z)^2` for z in [0, 1], open at both ends. `region`
    is the texture: first texel's outer corner, then width and height in texels [P, 4].
    """

    T: Array
    is_limb: NDArray[np.bool_]
    taper: Array
    region: Array
    object_id: NDArray[np.int64]

    def __len__(self) -> int:
        """Return the number of quadrics."""
        return len(self.T)

    def transformed(self, T_a_b: Matrix) -> QuadricSet:
        """Move the set from frame b to frame a."""
        return replace(self, T=T_a_b @ self.T)

    @staticmethod
    def empty() -> QuadricSet:
        """Return a set of nothing."""
        return QuadricSet(
            np.zeros((0, 4, 4)),
            np.zeros(0, bool),
            np.zeros(0),
            np.zeros((0, 4)),
            np.zeros(0, np.int64),
        )

    @staticmethod
    def concatenate(sets: Sequence[QuadricSet]) -> QuadricSet:
        """Join sets that are in one frame."""
        names = ('T', 'is_limb', 'taper', 'region', 'object_id')
        return QuadricSet(*(np.concatenate([getattr(s, name) for s in sets]) for name in names))


def ellipsoid(centre: Array, radii: Array, axes: Matrix | None = None) -> Matrix:
    """Return the canonical-to-frame map of an ellipsoid; `axes` columns are its directions."""
    T = np.eye(4)
    T[:3, :3] = (np.eye(3) if axes is None else axes) * radii
    T[:3, 3] = centre
    return T


def limb(start: Array, end: Array, radius: float, front: Array, flatness: float = 1.0) -> Matrix:
    """
    Return the canonical-to-frame map of a limb from `start`, where its radius is `radius`.

    `front` is the direction that texture's middle faces; `flatness` is the radius sideways over
    that to the front.
    """
    axis = end - start
    side = np.cross(axis, front)
    side /= np.linalg.norm(side)
    forward = np.cross(side, axis)
    forward /= np.linalg.norm(forward)
    T = np.eye(4)
    T[:3, 0], T[:3, 1], T[:3, 2] = radius * forward, radius * flatness * side, axis
    T[:3, 3] = start
    return T


_FACES = (  # origin corner, edge u, edge v: signs and axes, seen from outside
    ('x+', (1, -1, 1), (0, 1, 0), (0, 0, -1)),
    ('x-', (-1, 1, 1), (0, -1, 0), (0, 0, -1)),
    ('y+', (1, 1, 1), (-1, 0, 0), (0, 0, -1)),
    ('y-', (-1, -1, 1), (1, 0, 0), (0, 0, -1)),
    ('z+', (-1, 1, 1), (1, 0, 0), (0, -1, 0)),
    ('z-', (-1, -1, -1), (1, 0, 0), (0, 1, 0)),
)


def box_faces(centre: Array, size: Array, skip: str = '') -> list[tuple[str, Array, Array, Array]]:
    """
    Return the outward faces of an axis-aligned box as (name, origin, edge u, edge v).

    `skip` lists the names of faces that nobody sees, parted by blanks; rows of the texture of
    an upright face run downwards.
    """
    half = np.asarray(size) / 2
    faces = []
    for name, corner, u, v in _FACES:
        if name not in skip.split():
            u_edge, v_edge = np.array(u) * size, np.array(v) * size
            faces.append((name, centre + np.array(corner) * half, u_edge, v_edge))
    return faces
