"""The scenarios: which movers and which camera motion go into the room of a seed."""

from __future__ import annotations

import zlib
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any, NamedTuple

import numpy as np

from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.synth import field
from bdgs_ros.data.synth.camera_path import CameraPath, camera_path
from bdgs_ros.data.synth.movers import (
    BOX_SIZE_M,
    CHAIR_REACH_M,
    REACH_M,
    Handover,
    Push,
    carried_box,
    person,
    pushed_chair,
    rolling_ball,
)
from bdgs_ros.data.synth.paths import KeyedPath, LoopPath
from bdgs_ros.data.synth.room import TABLE_HEIGHT_M, Layout, at, make_layout
from bdgs_ros.data.synth.scene import Scene, SceneObject

Cast = Callable[[Layout, np.random.Generator, float], list[SceneObject]]
"""Layout, generator and duration in seconds to the movers of a scenario."""


@dataclass(frozen=True)
class World:
    """All that a recording shows: the scene and the way of the camera through it."""

    scene: Scene
    camera_path: CameraPath


def _table_loop(layout: Layout, rng: np.random.Generator, phase: float) -> LoopPath:
    """Return a way round the table."""
    (x, y), grow = layout.table_centre, rng.uniform(0.95, 1.05)
    turn = float(rng.choice([-1.0, 1.0]))
    angles = turn * np.linspace(0, 2 * np.pi, 8, endpoint=False)
    points = [(x + 1.25 * grow * np.cos(a), y + 1.6 * grow * np.sin(a)) for a in angles]
    return LoopPath(points, float(rng.uniform(0.8, 1.15)), phase, 0.0)


def _near_loop(
    layout: Layout, near_x: float, speed: float, phase: float, start_s: float, turn: float
) -> LoopPath:
    """Return a long narrow loop across the view, close to the camera: to +y near, back behind."""
    low, high = 0.95, layout.size[1] - 0.95
    lane, gap = np.linspace(low, high, 4), 0.5
    points = [(near_x, y) for y in lane] + [(near_x + gap / 2, high + 0.3)]
    points += [(near_x + gap, y) for y in lane[::-1]] + [(near_x + gap / 2, low - 0.3)]
    middle = layout.size[1] / 2
    return LoopPath([(x, middle + turn * (y - middle)) for x, y in points], speed, phase, start_s)


def _camera_loop(layout: Layout, rng: np.random.Generator, phase: float) -> LoopPath:
    """Return a way round a camera that turns, between it and the walls."""
    turn, middle = float(rng.choice([-1.0, 1.0])), layout.size[1] / 2
    angles = turn * np.linspace(0, 2 * np.pi, 8, endpoint=False)
    points = [(1.7 + 1.25 * np.cos(a), middle + 1.5 * np.sin(a)) for a in angles]
    return LoopPath(points, float(rng.uniform(0.8, 1.1)), phase, 0.0)


def _walkers_all_round(
    layout: Layout, rng: np.random.Generator, duration_s: float
) -> list[SceneObject]:
    """One walks round the camera, one round the table."""
    first = layout.next_id
    return [
        person(first, rng, _camera_loop(layout, rng, float(rng.uniform(0, 1)))),
        person(first + 1, rng, _table_loop(layout, rng, float(rng.uniform(0, 1)))),
    ]


def _two_walkers_and_ball(
    layout: Layout, rng: np.random.Generator, duration_s: float
) -> list[SceneObject]:
    first = layout.next_id
    turn, phase = float(rng.choice([-1.0, 1.0])), float(rng.uniform(0.85, 1.0))
    near = _near_loop(layout, 1.9, float(rng.uniform(0.85, 1.1)), phase, 0.0, turn)
    ball_at = (2.75, layout.size[1] / 2)
    return [
        person(first, rng, _table_loop(layout, rng, float(rng.uniform(0, 1)))),
        person(first + 1, rng, near),
        rolling_ball(first + 2, rng, ball_at, 1.0),
    ]


def _crowd(layout: Layout, rng: np.random.Generator, duration_s: float) -> list[SceneObject]:
    """Two walk behind from the start; after 30 % two groups cross close to the camera."""
    first, start = layout.next_id, 0.3 * duration_s
    turn = float(rng.choice([-1.0, 1.0]))
    paths = [_table_loop(layout, rng, phase) for phase in rng.uniform(0, 1, 2)]
    for phase in (-0.05, 0.0, 0.05, 0.1):  # waits beside the near lane
        shift = float(rng.uniform(-0.006, 0.006))
        paths.append(_near_loop(layout, 1.64, 1.1, phase + shift, start, turn))
    for phase in (0.46, 0.52, 0.58):  # waits at the other side, comes along the lane behind
        shift = float(rng.uniform(-0.006, 0.006))
        paths.append(_near_loop(layout, 1.70, 1.1, phase + shift, start, turn))
    return [person(first + k, rng, path) for k, path in enumerate(paths)]


def _unknown_box(layout: Layout, rng: np.random.Generator, duration_s: float) -> list[SceneObject]:
    """A walker brings a box, puts it on the table, goes, comes back and takes it away."""
    first, m = layout.next_id, layout.free_end
    x, y = layout.table_centre
    edge = y + m * layout.table_size[1] / 2
    stand = (x - 0.05, edge + m * (REACH_M - 0.19))
    away = (1.25, layout.size[1] / 2 + m * 2.15)
    between = (2.3, stand[1] + m * 0.25)
    inwards = -m * np.pi / 2
    coming, going = _heading(away, between), _heading(between, away)
    keys = [
        (0.00, *away, coming),
        (0.16, *between, (coming + inwards) / 2),
        (0.25, *stand, inwards),
        (0.35, *stand, inwards),
        (0.44, *between, inwards - m * np.pi / 2),
        (0.54, *away, going),
        (0.60, *away, coming),
        (0.70, *between, (coming + inwards) / 2),
        (0.77, *stand, inwards),
        (0.85, *stand, inwards),
        (0.93, *between, inwards - m * np.pi / 2),
        (1.00, *away, going),
    ]
    path = KeyedPath([(share * duration_s, px, py, angle) for share, px, py, angle in keys])
    rest = at(stand[0], stand[1] - m * REACH_M, TABLE_HEIGHT_M + BOX_SIZE_M[2] / 2, inwards)
    put, take = ((a * duration_s, b * duration_s) for a, b in ((0.26, 0.33), (0.78, 0.84)))
    handover = Handover(path, rest, put, take)
    return [
        person(first, rng, path, handover.hands),
        carried_box(first + 1, rng, handover),
    ]


def _chair_moved(layout: Layout, rng: np.random.Generator, duration_s: float) -> list[SceneObject]:
    """A walker comes, pushes a chair across the view, and goes."""
    first, m = layout.next_id, float(rng.choice([-1.0, 1.0]))
    middle, x = layout.size[1] / 2, float(rng.uniform(2.8, 2.92))
    way = float(rng.uniform(0.85, 1.0))
    chair_y = middle + m * float(rng.uniform(0.42, 0.52))
    ahead = -m * np.pi / 2
    start, end = chair_y + m * CHAIR_REACH_M, chair_y + m * (CHAIR_REACH_M - way)
    enter, leave = (1.25, middle + m * 2.15), (1.25, middle - m * 2.15)
    past = (2.0, middle - m * 0.6)
    keys = [
        (0.00, *enter, _heading(enter, (x, start))),
        (0.24, *enter, _heading(enter, (x, start))),
        (0.38, x, start, ahead),
        (0.43, x, start, ahead),
        (0.60, x, end, ahead),
        (0.65, x, end, ahead),
        (0.76, *past, _heading(past, leave)),
        (0.88, *leave, _heading(past, leave)),
        (1.00, *leave, _heading(past, leave)),
    ]
    path = KeyedPath([(share * duration_s, px, py, angle) for share, px, py, angle in keys])
    interval = (0.43 * duration_s, 0.60 * duration_s)
    push = Push(path, at(x, chair_y, 0.0, ahead), way, interval)
    return [person(first, rng, path, push.hands), pushed_chair(first + 1, rng, push)]


def _heading(a: tuple[float, float], b: tuple[float, float]) -> float:
    return float(np.arctan2(b[1] - a[1], b[0] - a[0]))


def _nobody(layout: Layout, rng: np.random.Generator, duration_s: float) -> list[SceneObject]:
    return []


class Scenario(NamedTuple):
    """How the camera moves, who else does, and what the recording is like."""

    motion: str
    cast: Cast
    scale: float = 1.0
    """Metres per metre of the room: a hall, or a corner of a table, with a sensor for that."""
    rate_hz: float = 30.0


_PAPER = {
    'static': Scenario('survey', _nobody),
    'walking_static': Scenario('handheld', _two_walkers_and_ball),
    'walking_xyz': Scenario('xyz', _two_walkers_and_ball),
    'walking_rpy': Scenario('rpy', _two_walkers_and_ball),
    'walking_halfsphere': Scenario('halfsphere', _two_walkers_and_ball),
    'crowd': Scenario('gentle', _crowd),
    'unknown_box': Scenario('gentle', _unknown_box),
    'chair_moved': Scenario('gentle', _chair_moved),
    'loop_room': Scenario('round', _walkers_all_round),
}
_FIELD = {
    'door': Scenario('gentle', field.door),
    'crowded_start': Scenario('gentle', field.crowded_start),
    'blank_start': Scenario('turn_in', field.board),
    'low_rate': Scenario('xyz', _two_walkers_and_ball, rate_hz=5.0),
    'hall': Scenario('survey', _nobody, scale=4.0),
    'close_up': Scenario('survey', _nobody, scale=0.15),
}
_SCENARIOS: dict[str, tuple[Any, ...]] = {**_PAPER, **_FIELD}


def scenarios() -> tuple[str, ...]:
    """Return the names of the scenarios that are like the recordings of the paper."""
    return tuple(_PAPER)


def field_scenarios() -> tuple[str, ...]:
    """Return the names of those that are like reports from the field."""
    return tuple(_FIELD)


def find_scenario(name: str) -> Scenario:
    """Return a scenario; `DatasetError` if there is none of this name."""
    if name not in _SCENARIOS:
        raise DatasetError(f"no scenario '{name}'; there are: {', '.join(_SCENARIOS)}")
    return Scenario(*_SCENARIOS[name])


def make_world(scenario: str, seed: int, duration_s: float) -> World:
    """
    Return the world of a scenario; the room depends on the seed alone.

    Parameters
    ----------
    scenario : str
        One of `scenarios()` or `field_scenarios()`.
    seed : int
        Not negative; varies room, textures, people, paths and camera.
    duration_s : float
        Length of the recording. Events of a story (a box put down, a chair pushed) happen at
        fixed shares of it; walkers and camera keep their own speed.

    Raises
    ------
    DatasetError
        If there is no such scenario.

    """
    found = find_scenario(scenario)
    layout = make_layout(np.random.default_rng([seed, 0]))
    rng = np.random.default_rng([seed, 1, zlib.crc32(scenario.encode())])
    scene = Scene([*layout.objects, *found.cast(layout, rng, duration_s)], layout.lighting)
    position = np.array([1.0, layout.size[1] / 2, 1.4])
    path = camera_path(found.motion, rng, position, np.array([*layout.table_centre, 0.85]))
    return World(scene, path)
