"""The room and its furniture: where things stand in the layout of a seed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bdgs_ros.data.synth import textures
from bdgs_ros.data.synth.lighting import Lighting, Occluder, occluder_of_box
from bdgs_ros.data.synth.scene import SceneObject
from bdgs_ros.data.synth.shapes import Quad, box_faces
from bdgs_ros.data.synth.textures import Texture

Array = NDArray[np.float64]
Paint = Callable[[int, int], Texture]
WALL_DENSITY = 220.0  # texels per metre
FURNITURE_DENSITY = 320.0
PRINT_DENSITY = 480.0
TABLE_HEIGHT_M = 0.74


def at(x: float, y: float, z: float = 0.0, yaw_rad: float = 0.0) -> Array:
    """Return the pose of a thing that stands upright in the room."""
    T = np.eye(4)
    T[:3, :3] = Rotation.from_euler('z', yaw_rad).as_matrix()
    T[:3, 3] = x, y, z
    return T


def rectangle(origin: Array, edge_u: Array, edge_v: Array, density: float, paint: Paint) -> Quad:
    """Return a rectangle with a texture painted to its size."""
    width, height = (max(4, round(float(np.linalg.norm(e)) * density)) for e in (edge_u, edge_v))
    return Quad(origin, edge_u, edge_v, paint(height, width))


@dataclass
class Furniture:
    """Boxes put together in the frame of one thing, then placed in the room."""

    T_world_object: Array
    quads: list[Quad] = field(default_factory=list)
    occluders: list[Occluder] = field(default_factory=list)

    def box(
        self,
        centre: tuple[float, float, float],
        size: tuple[float, float, float],
        paint: Paint,
        *,
        faces: dict[str, Paint] | None = None,
        skip: str = '',
    ) -> None:
        """Add a box; `faces` paints some of its faces differently."""
        T = self.T_world_object
        for name, origin, u, v in box_faces(np.array(centre), np.array(size), skip):
            chosen = (faces or {}).get(name, paint)
            corner = T[:3, :3] @ origin + T[:3, 3]
            self.quads.append(
                rectangle(corner, T[:3, :3] @ u, T[:3, :3] @ v, FURNITURE_DENSITY, chosen)
            )
        self.occluders.append(occluder_of_box(np.array(centre), np.array(size), T))


def table(rng: np.random.Generator, T: Array, size: tuple[float, float]) -> Furniture:
    """Return a table with four legs; `size` is its top in metres."""
    item = Furniture(T)
    legs = textures.wood(rng, 300, 60)
    item.box((0, 0, TABLE_HEIGHT_M - 0.02), (*size, 0.04), lambda h, w: textures.wood(rng, h, w))
    for x in (-1, 1):
        for y in (-1, 1):
            foot = (x * (size[0] / 2 - 0.06), y * (size[1] / 2 - 0.06), 0.35)
            item.box(foot, (0.06, 0.06, 0.70), lambda h, w: legs[:h, :w], skip='z+ z-')
    return item


def chair(rng: np.random.Generator, T: Array) -> Furniture:
    """Return a chair that faces +x, its back at -x."""
    item = Furniture(T)
    rgb = textures.color(rng, 0.2, 0.7)
    timber = textures.wood(rng, 320, 320)
    item.box((0, 0, 0.45), (0.42, 0.42, 0.05), lambda h, w: textures.cloth(rng, h, w, rgb))
    item.box((-0.20, 0, 0.76), (0.03, 0.42, 0.34), lambda h, w: textures.cloth(rng, h, w, rgb))
    for x, top in ((-0.19, 0.62), (0.19, 0.43)):
        for y in (-0.19, 0.19):
            item.box(
                (x, y, top / 2), (0.035, 0.035, top), lambda h, w: timber[:h, :w], skip='z+ z-'
            )
    return item


def shelf(rng: np.random.Generator, T: Array, width: float, height: float) -> Furniture:
    """Return an open shelf that faces +x, with books and boxes on its boards."""
    item = Furniture(T)
    timber: Paint = lambda h, w: textures.wood(rng, h, w)  # noqa: E731
    depth = 0.3
    item.box((-depth / 2, 0, height / 2), (0.02, width, height), timber, skip='x- z-')
    for y in (-1, 1):
        item.box((0, y * width / 2, height / 2), (depth, 0.03, height), timber, skip='x- z-')
    levels = np.linspace(0.1, height - 0.015, 5)
    for z in levels:
        item.box((0, 0, z), (depth, width - 0.03, 0.03), timber, skip='x- y+ y-')
    for z in levels[:-1]:
        _fill_board(rng, item, float(z) + 0.015, width, float(levels[1] - levels[0]) - 0.06)
    return item


def _fill_board(
    rng: np.random.Generator, item: Furniture, z: float, width: float, room: float
) -> None:
    y = -width / 2 + 0.05
    while y < width / 2 - 0.15:
        w = float(min(rng.uniform(0.15, 0.5), width / 2 - 0.05 - y))
        h = float(room * rng.uniform(0.6, 0.95))
        paint = textures.books if rng.random() < 0.7 else textures.carton
        item.box(
            (rng.uniform(0.0, 0.05), y + w / 2, z + h / 2),
            (0.2, w, h),
            lambda hh, ww, p=paint: p(rng, hh, ww),  # type: ignore[misc]
            skip='x- z-',
        )
        y += w + float(rng.uniform(0.02, 0.15))


def crate(rng: np.random.Generator, T: Array, size: tuple[float, float, float]) -> Furniture:
    """Return a cardboard box that stands on the origin of its frame."""
    item = Furniture(T)
    item.box((0, 0, size[2] / 2), size, lambda h, w: textures.carton(rng, h, w), skip='z-')
    return item


def cabinet(rng: np.random.Generator, T: Array, size: tuple[float, float, float]) -> Furniture:
    """Return a cabinet with painted doors that faces +x."""
    item = Furniture(T)
    rgb = textures.color(rng, 0.3, 0.7)

    def doors(h: int, w: int) -> Texture:
        texture = textures.grainy(rng, h, w, rgb, 50, 0.1)
        for x in range(0, w, max(w // 3, 1)):
            texture[:, x : x + 3] *= 0.4
            texture[h // 3 : h // 2, x + 12 : x + 18] *= 0.3
        return texture

    item.box(
        (0, 0, size[2] / 2),
        size,
        lambda h, w: textures.wood(rng, h, w),
        faces={'x+': doors},
        skip='z- x-',
    )
    return item


def clutter(
    rng: np.random.Generator, T: Array, size: tuple[float, float], side: float
) -> Furniture:
    """Return a screen, books and small boxes on one half of a table top: +y or -y."""
    item = Furniture(T)
    dark: Paint = lambda h, w: textures.grainy(rng, h, w, (0.1, 0.1, 0.11), 20, 0.2)  # noqa: E731
    z = TABLE_HEIGHT_M
    y = side * size[1] * 0.27
    picture = {'x-': lambda h, w: textures.poster(rng, h, w)}
    item.box((0.12, y, z + 0.24), (0.04, 0.52, 0.32), dark, faces=picture)
    item.box((0.14, y, z + 0.05), (0.12, 0.16, 0.10), dark, skip='z-')
    spots = [(-0.22, side * 0.1), (0.2, side * 0.0), (-0.25, side * 0.52)]
    for x, spot in spots:
        height = float(rng.uniform(0.05, 0.2))
        box = (float(rng.uniform(0.12, 0.22)), float(rng.uniform(0.1, 0.22)), height)
        item.box((x, spot, z + height / 2), box, lambda h, w: textures.books(rng, h, w), skip='z-')
    return item


@dataclass(frozen=True)
class Layout:
    """The static part of a scene and the places that scenarios need."""

    objects: list[SceneObject]
    lighting: Lighting
    size: tuple[float, float, float]
    table_centre: tuple[float, float]
    table_size: tuple[float, float]
    free_end: float
    """The end of the table without things on it: 1 at +y, -1 at -y."""

    @property
    def next_id(self) -> int:
        """The first object id that is free."""
        return max(o.object_id for o in self.objects) + 1


def make_layout(rng: np.random.Generator) -> Layout:
    """Furnish a room; the camera will stand near x = 1 and look along +x."""
    size = (float(rng.uniform(5.8, 6.3)), float(rng.uniform(4.9, 5.3)), 2.7)
    middle = size[1] / 2
    table_centre = (float(rng.uniform(3.5, 3.8)), middle + float(rng.uniform(-0.1, 0.1)))
    table_size = (0.8, float(rng.uniform(1.4, 1.6)))
    free_end = float(rng.choice([-1.0, 1.0]))
    furniture = _furniture(rng, size, table_centre, table_size, -free_end)
    lamps = _lamps(rng, size)
    lighting = Lighting(lamps, [o for _, item in furniture for o in item.occluders])
    objects = [SceneObject(1, 'room', 'room', _shell(rng, size))]
    for index, (kind, item) in enumerate(furniture, start=2):
        objects.append(SceneObject(index, f'{kind}_{index}', kind, item.quads))
    return Layout(objects, lighting, size, table_centre, table_size, free_end)


def _furniture(
    rng: np.random.Generator,
    size: tuple[float, float, float],
    table_centre: tuple[float, float],
    table_size: tuple[float, float],
    clutter_side: float,
) -> list[tuple[str, Furniture]]:
    x, y = table_centre
    T = at(x, y)
    back, side = size[0], float(rng.choice([-1.0, 1.0]))
    wall_y = size[1] / 2 + side * rng.uniform(0.9, 1.2)
    other_y = size[1] / 2 - side * rng.uniform(0.8, 1.2)
    cabinet_size = (0.4, float(rng.uniform(0.9, 1.2)), float(rng.uniform(0.7, 0.9)))
    items = [
        ('table', table(rng, T, table_size)),
        ('clutter', clutter(rng, T, table_size, clutter_side)),
        ('shelf', shelf(rng, at(back - 0.2, wall_y, 0, np.pi), 1.5, rng.uniform(1.7, 2.0))),
        ('cabinet', cabinet(rng, at(back - 0.22, other_y, 0, np.pi), cabinet_size)),
    ]
    for offset in (-0.35, 0.4):
        turn = np.pi + rng.uniform(-0.4, 0.4)
        items.append(('chair', chair(rng, at(x + 0.62, y + offset, 0, turn))))
    top = (back - 0.25, other_y + rng.uniform(-0.2, 0.2), cabinet_size[2], rng.uniform(-0.3, 0.3))
    items.append(('crate', crate(rng, at(*top), (0.3, 0.4, 0.28))))
    for corner in (0.35, size[1] - 0.35):
        for _ in range(2):
            place = at(rng.uniform(2.6, 5.2), corner, 0, rng.uniform(-0.3, 0.3))
            box = tuple(float(s) for s in rng.uniform(0.3, 0.5, 3))
            items.append(('crate', crate(rng, place, (box[0], box[1], box[2]))))
    return items


def _lamps(rng: np.random.Generator, size: tuple[float, float, float]) -> Array:
    """Two lamps, each three points wide so that shadows are soft."""
    centres = np.array([[size[0] * 0.35, size[1] * 0.3], [size[0] * 0.65, size[1] * 0.7]])
    centres += rng.uniform(-0.3, 0.3, centres.shape)
    spread = np.array([[-0.25, -0.1], [0.0, 0.2], [0.25, -0.1]])
    points = (centres[:, None] + spread).reshape(-1, 2)
    return np.column_stack([points, np.full(len(points), size[2] - 0.15)])


def _shell(rng: np.random.Generator, size: tuple[float, float, float]) -> list[Quad]:
    """Return floor, ceiling, walls, and the flat things that lie or hang on them."""
    lx, ly, lz = size
    d = WALL_DENSITY
    wall: Paint = lambda h, w: textures.wall(rng, h, w, d)  # noqa: E731
    down = np.array([0, 0, -lz])
    corner = np.array
    quads = [
        rectangle(corner([0, ly, 0.0]), corner([lx, 0, 0.0]), corner([0, -ly, 0.0]), d,
                  lambda h, w: textures.planks(rng, h, w, d)),
        rectangle(corner([0, 0.0, lz]), corner([lx, 0, 0.0]), corner([0, ly, 0.0]), 80,
                  lambda h, w: textures.grainy(rng, h, w, (0.7, 0.7, 0.68), 30, 0.04)),
        rectangle(corner([lx, ly, lz]), corner([0, -ly, 0.0]), down, d, wall),
        rectangle(corner([0, 0.0, lz]), corner([0, ly, 0.0]), down, d, wall),
        rectangle(corner([0, ly, lz]), corner([lx, 0, 0.0]), down, d, wall),
        rectangle(corner([lx, 0.0, lz]), corner([-lx, 0, 0.0]), down, d, wall),
    ]  # fmt: skip
    return quads + _hangings(rng, size)


def _hangings(rng: np.random.Generator, size: tuple[float, float, float]) -> list[Quad]:
    """Return posters on three walls and the one behind the camera, and a rug."""
    lx, ly, _ = size
    gap = 0.004
    walls = [  # a corner at floor height, the direction to the right, the length
        (np.array([lx - gap, ly, 0.0]), np.array([0, -1.0, 0]), ly),
        (np.array([0.0, ly - gap, 0]), np.array([1.0, 0, 0]), lx),
        (np.array([lx, gap, 0.0]), np.array([-1.0, 0, 0]), lx),
        (np.array([gap, 0.0, 0]), np.array([0, 1.0, 0]), ly),
    ]
    quads = []
    for start, right, length in walls:
        position = float(rng.uniform(0.2, 0.6))
        while position < length - 1.0:
            width, height = float(rng.uniform(0.4, 0.9)), float(rng.uniform(0.4, 0.8))
            top = float(rng.uniform(1.7, 2.3))
            corner = start + right * position + np.array([0, 0, top])
            quads.append(
                rectangle(corner, right * width, np.array([0, 0, -height]), PRINT_DENSITY,
                          lambda h, w: textures.poster(rng, h, w))
            )  # fmt: skip
            position += width + float(rng.uniform(0.15, 0.9))
    rug_corner = np.array([2.2, ly / 2 + 1.2, 0.004])
    quads.append(
        rectangle(rug_corner, np.array([2.2, 0, 0]), np.array([0, -2.4, 0]), WALL_DENSITY,
                  lambda h, w: textures.rug(rng, h, w))
    )  # fmt: skip
    return quads
