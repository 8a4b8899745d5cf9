"""
Casts of the scenarios from the field: what people report of systems of this kind.

A door that was mapped and opens, people who fill the view when the camera starts, a start before
a plain board. The other ones are known rooms at another size or rate, see `scenarios`.
"""

from __future__ import annotations

import numpy as np

from bdgs_ros.data.synth import textures
from bdgs_ros.data.synth.movers import person, smooth_step
from bdgs_ros.data.synth.paths import KeyedPath
from bdgs_ros.data.synth.room import PRINT_DENSITY, Layout, at, rectangle
from bdgs_ros.data.synth.scene import SceneObject
from bdgs_ros.data.synth.shapes import box_faces

_DOOR_M = (0.04, 0.9, 2.0)
_OPENS = (0.5, 0.65)  # shares of the recording between which the door swings
_OPEN_RAD = np.radians(80)
_LEAVE = 0.3  # share of the recording after which the view becomes free


def door(layout: Layout, rng: np.random.Generator, duration_s: float) -> list[SceneObject]:
    """A printed door stands across half of the view; half way it swings open, and rests."""
    hinge_y = layout.size[1] / 2 - _DOOR_M[1] / 2 + float(rng.uniform(-0.1, 0.1))
    x, way = float(rng.uniform(2.5, 2.7)), float(rng.choice([-1.0, 1.0]))
    centre = np.array([0.0, _DOOR_M[1] / 2, _DOOR_M[2] / 2])
    faces = [
        rectangle(
            origin, u, v, PRINT_DENSITY, lambda height, width: textures.poster(rng, height, width)
        )
        for _, origin, u, v in box_faces(centre, np.array(_DOOR_M))
    ]
    start, end = (share * duration_s for share in _OPENS)

    def pose(t: float) -> np.ndarray:
        turned = way * _OPEN_RAD * smooth_step((t - start) / (end - start))
        return at(x, hinge_y, 0.0, turned)

    return [SceneObject(layout.next_id, 'door', 'door', faces, pose=pose, moving=((start, end),))]


def crowded_start(
    layout: Layout, rng: np.random.Generator, duration_s: float
) -> list[SceneObject]:
    """Three stand before the camera when it starts, and leave after a third of the recording."""
    middle, facing = layout.size[1] / 2, -np.pi
    stands = [
        (1.62, -0.05, 1.0, _LEAVE + 0.04, 0.50),
        (1.75, 0.50, 1.0, _LEAVE + 0.06, 0.46),
        (1.75, -0.60, -1.0, _LEAVE + 0.06, 0.46),
    ]
    people = []
    for k, (x, aside, side, turned, gone) in enumerate(stands):
        y = middle + aside + float(rng.uniform(-0.05, 0.05))
        out = middle + side * 2.3
        keys = [
            (0.0, x, y, facing),
            (_LEAVE, x, y, facing),
            (turned, x, y, side * np.pi / 2),
            (gone, 1.5, out, side * np.pi / 2),
            (1.0, 1.2, middle + side * 2.6, side * np.pi / 2),
        ]
        path = KeyedPath([(share * duration_s, px, py, angle) for share, px, py, angle in keys])
        people.append(person(layout.next_id + k, rng, path))
    return people


def board(layout: Layout, rng: np.random.Generator, duration_s: float) -> list[SceneObject]:
    """A plain board stands beside the camera, which looks at nothing else when it starts."""
    rgb = textures.color(rng, 0.45, 0.75)
    origin = np.array([-0.4, layout.size[1] / 2 - 0.95, 0.0])
    face = rectangle(
        origin, np.array([2.6, 0.0, 0.0]), np.array([0.0, 0.0, 2.7]), 20.0,
        lambda height, width: textures.plain(height, width, rgb),
    )  # fmt: skip
    return [SceneObject(layout.next_id, 'board', 'board', [face])]
