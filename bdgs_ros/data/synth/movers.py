"""Things that move: walkers on paths, a ball that rolls, a box that is carried, a pushed chair."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bdgs_ros.data.synth import textures
from bdgs_ros.data.synth.paths import FloorPath
from bdgs_ros.data.synth.room import PRINT_DENSITY, at, chair, rectangle
from bdgs_ros.data.synth.scene import ALWAYS, Body, Part, SceneObject
from bdgs_ros.data.synth.shapes import Quad, box_faces, ellipsoid
from bdgs_ros.data.synth.walker import Hands, Walker, make_body

Array = NDArray[np.float64]
BALL_RADIUS_M = 0.13
BOX_SIZE_M = (0.28, 0.36, 0.26)
REACH_M = 0.40  # from a walker to the centre of the box in its hands
CHAIR_REACH_M = 0.50  # from a walker to the centre of the chair that it pushes


def smooth_step(x: float) -> float:
    """Rise from 0 to 1 over [0, 1] with no jump in speed."""
    x = float(np.clip(x, 0, 1))
    return x * x * (3 - 2 * x)


def floor_pose(path: FloorPath, time_s: float) -> Array:
    """Return T_world_walker of whoever follows a path."""
    x, y, heading = path.place(time_s)
    return at(x, y, 0.0, heading)


def person(
    object_id: int, rng: np.random.Generator, path: FloorPath, hands: Hands | None = None
) -> SceneObject:
    """Return a dressed walker on a path."""
    walker = Walker(path, float(rng.uniform(0.94, 1.06)), hands, float(rng.uniform(0, 2 * np.pi)))
    return SceneObject(
        object_id,
        f'person_{object_id}',
        'person',
        body=make_body(rng, walker),
        pose=lambda t: floor_pose(path, t),
        moving=ALWAYS,
    )


def rolling_ball(
    object_id: int, rng: np.random.Generator, start: tuple[float, float], reach: float
) -> SceneObject:
    """Return a ball that rolls to and fro along y about `start`."""
    period, phase = float(rng.uniform(4.5, 6.0)), float(rng.uniform(0, 2 * np.pi))

    def pose(t: float) -> Array:
        way = reach * np.sin(2 * np.pi * t / period + phase)
        T = at(start[0], start[1] + way, BALL_RADIUS_M)
        T[:3, :3] = Rotation.from_euler('x', -way / BALL_RADIUS_M).as_matrix()
        return T

    part = Part(ellipsoid(np.zeros(3), np.full(3, BALL_RADIUS_M)), False, 0.0, 0)
    body = Body([textures.ball(rng, 128, 256)], lambda t: [part])
    return SceneObject(object_id, 'ball', 'ball', body=body, pose=pose, moving=ALWAYS)


@dataclass(frozen=True)
class Handover:
    """
    When a carried box is put down and taken up, and where it rests.

    `put` and `take` are the intervals in seconds in which the hands set it down and lift it.
    """

    path: FloorPath
    T_world_rest: Array
    put: tuple[float, float]
    take: tuple[float, float]

    def moving(self) -> tuple[tuple[float, float], ...]:
        """Return when the box moves."""
        return ((-np.inf, self.put[1]), (self.take[0], np.inf))

    def box_pose(self, t: float) -> Array:
        """Return T_world_box: in the hands, on its way down or up, or at rest."""
        held = floor_pose(self.path, t) @ at(REACH_M, 0.0, 1.02)
        if t < self.take[0]:
            share = smooth_step((t - self.put[0]) / (self.put[1] - self.put[0]))
        else:
            share = 1 - smooth_step((t - self.take[0]) / (self.take[1] - self.take[0]))
        return _between(held, self.T_world_rest, share)

    def hands(self, t: float) -> tuple[Array, Array] | None:
        """Return where the hands are in the walker's frame; they let go at rest."""
        T_walker_box = np.linalg.inv(floor_pose(self.path, t)) @ self.box_pose(t)
        away = min(smooth_step((t - self.put[1]) / 0.5), smooth_step((self.take[0] - t) / 0.5))
        if away >= 1:
            return None
        return _grip(T_walker_box, (-0.06, BOX_SIZE_M[1] / 2 + 0.02, 0.07), away)


def _between(T_a: Array, T_b: Array, share: float) -> Array:
    turn = Rotation.from_matrix(T_a[:3, :3].T @ T_b[:3, :3]).as_rotvec()
    T = np.eye(4)
    T[:3, :3] = T_a[:3, :3] @ Rotation.from_rotvec(share * turn).as_matrix()
    T[:3, 3] = (1 - share) * T_a[:3, 3] + share * T_b[:3, 3]
    return T


def _grip(
    T_walker_item: Array, left: tuple[float, float, float], away: float
) -> tuple[Array, Array]:
    """Return both hands at mirrored points of an item, moved towards hanging by `away`."""
    hands = []
    for side in (1.0, -1.0):
        point = np.array([left[0], side * left[1], left[2]])
        hold = T_walker_item[:3, :3] @ point + T_walker_item[:3, 3]
        hang = np.array([0.08, side * 0.26, 0.84])
        hands.append((1 - away) * hold + away * hang)
    return hands[0], hands[1]


def carried_box(object_id: int, rng: np.random.Generator, handover: Handover) -> SceneObject:
    """Return the box: printed all over, of no class that a detector knows."""
    quads = [
        rectangle(origin, u, v, PRINT_DENSITY, lambda h, w: textures.poster(rng, h, w))
        for _, origin, u, v in box_faces(np.zeros(3), np.array(BOX_SIZE_M))
    ]
    return SceneObject(
        object_id, 'box', 'box', quads, pose=handover.box_pose, moving=handover.moving()
    )


@dataclass(frozen=True)
class Push:
    """A chair pushed straight ahead by the walker behind it during an interval in seconds."""

    path: FloorPath
    T_world_start: Array
    """Pose of the chair before; it is pushed along its x axis."""
    reach_m: float
    interval: tuple[float, float]

    def way(self, t: float) -> float:
        """Return how far the chair has been pushed in metres."""
        if t <= self.interval[0]:
            return 0.0
        if t >= self.interval[1]:
            return self.reach_m
        x, y, _ = self.path.place(t)
        ahead = self.T_world_start[:2, 0]
        gone = float((np.array([x, y]) - self.T_world_start[:2, 3]) @ ahead) + CHAIR_REACH_M
        return float(np.clip(gone, 0, self.reach_m))

    def chair_pose(self, t: float) -> Array:
        """Return T_world_chair."""
        return np.asarray(self.T_world_start @ at(self.way(t), 0.0))

    def hands(self, t: float) -> tuple[Array, Array] | None:
        """Return where the hands are in the walker's frame: on the back rest while pushing."""
        start, end = self.interval
        away = max(smooth_step((start - 0.1 - t) / 0.5), smooth_step((t - end - 0.1) / 0.5))
        if away >= 1:
            return None
        T_walker_chair = np.linalg.inv(floor_pose(self.path, t)) @ self.chair_pose(t)
        return _grip(T_walker_chair, (-0.23, 0.16, 0.95), away)


def pushed_chair(object_id: int, rng: np.random.Generator, push: Push) -> SceneObject:
    """Return the chair; its quads are in its own frame."""
    quads: Sequence[Quad] = chair(rng, np.eye(4)).quads
    return SceneObject(
        object_id, 'moved_chair', 'chair', quads, pose=push.chair_pose, moving=(push.interval,)
    )
