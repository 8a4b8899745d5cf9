"""
A scene: objects with surfaces, some of which move, and the textures of all in one atlas.

The world frame of a scene is the room: z up, the floor at z = 0, a corner at the origin.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.data.synth.atlas import Atlas, AtlasBuilder
from bdgs_ros.data.synth.lighting import Lighting
from bdgs_ros.data.synth.shapes import Quad, QuadricSet, QuadSet

Matrix = NDArray[np.float64]
PoseOfTime = Callable[[float], Matrix]
Interval = tuple[float, float]  # seconds from the first frame
ALWAYS: tuple[Interval, ...] = ((-np.inf, np.inf),)


@dataclass(frozen=True)
class Part:
    """A quadric before its texture is in the atlas: `texture` indexes the body's textures."""

    T: Matrix
    is_limb: bool
    taper: float
    texture: int


@dataclass(frozen=True)
class Body:
    """What is made of quadrics: a walker or a ball."""

    textures: Sequence[NDArray[np.float32]]
    parts: Callable[[float], Sequence[Part]]
    """Time in seconds to the parts in the object's frame, always the same number of them."""


@dataclass(frozen=True)
class SceneObject:
    """One thing with an id: furniture, a box, a person."""

    object_id: int
    name: str
    kind: str
    quads: Sequence[Quad] = ()
    body: Body | None = None
    pose: PoseOfTime | None = None
    """T_world_object over time; None: the object stands still at the identity."""
    moving: tuple[Interval, ...] = ()
    """When it moves. Living things and the ball count as moving throughout."""

    @property
    def is_mover(self) -> bool:
        """Whether it moves at any time of the recording."""
        return bool(self.moving)

    def is_moving(self, time_s: float) -> bool:
        """Whether it moves at a time."""
        return any(start <= time_s < end for start, end in self.moving)

    def T_world_object(self, time_s: float) -> Matrix:
        """Return its pose at a time."""
        return np.eye(4) if self.pose is None else self.pose(time_s)


@dataclass(frozen=True)
class Surfaces:
    """Everything visible at one time, in the world frame."""

    quads: QuadSet
    quadrics: QuadricSet


@dataclass
class Scene:
    """The objects of a recording, ready to be rendered at any time."""

    objects: Sequence[SceneObject]
    lighting: Lighting
    atlas: Atlas = field(init=False)

    def __post_init__(self) -> None:
        """Bake the light of the room into the textures and pack them."""
        builder = AtlasBuilder()
        self._quads: dict[int, QuadSet] = {}
        self._regions: dict[int, NDArray[np.float64]] = {}
        for item in self.objects:
            if item.quads:
                builder.reserve_quads(item.object_id, self._lit(item))
            if item.body is not None:
                builder.reserve_body(item.object_id, item.body.textures)
        self.atlas = builder.build()
        for item in self.objects:
            if item.quads:
                self._quads[item.object_id] = builder.quad_set(item.object_id)
            if item.body is not None:
                self._regions[item.object_id] = builder.regions(item.object_id)
        still = [self._quads[o.object_id] for o in self.objects if o.quads and not o.is_mover]
        self._still = QuadSet.concatenate(still)

    def _lit(self, item: SceneObject) -> list[Quad]:
        return [self.lighting.bake(quad, cast_shadows=not item.is_mover) for quad in item.quads]

    def surfaces(self, time_s: float, at_rest_of_s: float | None = None) -> Surfaces:
        """
        Return what is visible at a time.

        Parameters
        ----------
        time_s : float
            Seconds from the first frame.
        at_rest_of_s : float, optional
            Leave out whatever moves at this time: the static world.

        """
        quads, quadrics = [self._still], [QuadricSet.empty()]
        for item in self.objects:
            if not item.is_mover or (at_rest_of_s is not None and item.is_moving(at_rest_of_s)):
                continue
            pose = item.T_world_object(time_s)
            if item.quads:
                quads.append(self._quads[item.object_id].transformed(pose))
            if item.body is not None:
                quadrics.append(self._quadrics(item, item.body, time_s).transformed(pose))
        return Surfaces(QuadSet.concatenate(quads), QuadricSet.concatenate(quadrics))

    def _quadrics(self, item: SceneObject, body: Body, time_s: float) -> QuadricSet:
        parts = body.parts(time_s)
        regions = self._regions[item.object_id]
        return QuadricSet(
            np.array([p.T for p in parts]),
            np.array([p.is_limb for p in parts]),
            np.array([p.taper for p in parts], dtype=np.float64),
            regions[[p.texture for p in parts]],
            np.full(len(parts), item.object_id),
        )

    def moving_ids(self, time_s: float) -> list[int]:
        """Return the ids of the objects that move at a time."""
        return [o.object_id for o in self.objects if o.is_moving(time_s)]
