"""
How the camera moves: the motions of TUM's freiburg3 walking sequences, and gentler ones.

Every path starts and rests for a moment, is smooth (sums of sinusoids under a smooth envelope)
and stays at speeds that people reach with a hand-held camera: about 0.2-0.4 m/s and 10-30 deg/s.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Array = NDArray[np.float64]
Motion = Callable[[float, Array], tuple[Array, Array]]
"""Time and the six phases of a seed to (offset right, down, ahead in m; rotation vector)."""

_REST_S = (0.3, 1.3)  # the motion fades in between these times
_TURN_RAD_S = np.radians(30)  # of a camera that turns round: 12 s until it is back
_TURN_RADIUS_M = 0.3
_ASIDE_S, _ASIDE_RAD = (1.5, 4.0), np.radians(95)  # of a camera that starts before a board


def look_at(position: Array, target: Array) -> Array:
    """Return T_world_camera of an upright camera (x right, y down, z ahead) in a z-up world."""
    ahead = (target - position) / np.linalg.norm(target - position)
    right = np.cross(ahead, [0.0, 0.0, 1.0])
    right /= np.linalg.norm(right)
    T = np.eye(4)
    T[:3, :3] = np.column_stack([right, np.cross(ahead, right), ahead])
    T[:3, 3] = position
    return T


def _faded_in(t: float) -> float:
    """Return how much of the time in which motion fades in is over, in [0, 1]."""
    return float(np.clip((t - _REST_S[0]) / (_REST_S[1] - _REST_S[0]), 0, 1))


def _faded_time(t: float) -> float:
    """Return the integral of the fade from 0 to t in seconds."""
    x = _faded_in(t)
    return (_REST_S[1] - _REST_S[0]) * x**4 * (2.5 - 3 * x + x**2) + max(t - _REST_S[1], 0.0)


def _wave(t: float, period_s: float, phase: float) -> float:
    return float(np.sin(2 * np.pi * t / period_s + phase))


def _in_turn(t: float, period_s: float, axes: int) -> Array:
    """Return weights with which each axis leads in turn, the others nearly at rest."""
    angle = 2 * np.pi * (t / period_s - np.arange(axes) / axes)
    return np.asarray(0.15 + 0.85 * (0.5 + 0.5 * np.cos(angle)) ** 2)


def _handheld(t: float, phase: Array) -> tuple[Array, Array]:
    offset = [0.004 * _wave(t, 1.1, phase[0]) + 0.003 * _wave(t, 0.55, phase[3])]
    offset += [0.003 * _wave(t, 0.9, phase[1]), 0.003 * _wave(t, 1.4, phase[2])]
    angles = [0.004 * _wave(t, 0.8, phase[4]) + 0.002 * _wave(t, 0.37, phase[0])]
    angles += [0.006 * _wave(t, 1.3, phase[5]), 0.003 * _wave(t, 1.0, phase[1])]
    return np.array(offset), np.array(angles)


def _xyz(t: float, phase: Array) -> tuple[Array, Array]:
    lead = _in_turn(t, 9.0, 3)
    waves = [_wave(t, p, f) for p, f in zip((5.8, 5.4, 6.1), phase, strict=False)]
    offset = np.array([0.30, 0.22, 0.30]) * lead * waves
    jitter_m, jitter_rad = _handheld(t, phase)
    return offset + jitter_m, 4 * jitter_rad


def _rpy(t: float, phase: Array) -> tuple[Array, Array]:
    lead = _in_turn(t, 9.0, 3)
    waves = [_wave(t, p, f) for p, f in zip((5.2, 5.6, 5.4), phase, strict=False)]
    angles = np.radians(20) * lead * waves
    jitter_m, jitter_rad = _handheld(t, phase)
    return 3 * jitter_m, angles + jitter_rad


def _gentle(t: float, phase: Array) -> tuple[Array, Array]:
    offset = np.array([0.22, 0.07, 0.12]) * [
        _wave(t, p, f) for p, f in zip((6.5, 5.7, 7.9), phase, strict=False)
    ]
    angles = np.radians([3.0, 7.0, 2.0]) * [
        _wave(t, p, f) for p, f in zip((5.1, 7.3, 6.1), phase[3:], strict=False)
    ]
    jitter_m, jitter_rad = _handheld(t, phase)
    return offset + jitter_m, angles + jitter_rad


def _survey(t: float, phase: Array) -> tuple[Array, Array]:
    offset, angles = _gentle(t, phase)
    return 1.15 * offset, 1.6 * angles


_MOTIONS: dict[str, Motion] = {
    'handheld': _handheld,
    'xyz': _xyz,
    'rpy': _rpy,
    'gentle': _gentle,
    'survey': _survey,
}


@dataclass(frozen=True)
class CameraPath:
    """One camera motion about a resting pose that looks at `target`."""

    kind: str
    position: Array
    target: Array
    phase: Array

    def pose(self, time_s: float) -> Array:
        """Return T_world_camera at a time in seconds from the first frame."""
        x = _faded_in(time_s)
        fade = x**3 * (10 - 15 * x + 6 * x**2)
        if self.kind == 'halfsphere':
            return self._on_halfsphere(time_s, fade)
        if self.kind == 'round':
            return self._round(time_s, fade)
        if self.kind == 'turn_in':
            return self._turn_in(time_s, fade)
        offset, angles = _MOTIONS[self.kind](time_s, self.phase)
        T = look_at(self.position, self.target)
        T[:3, 3] += T[:3, :3] @ (fade * offset)
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(fade * angles).as_matrix()
        return T

    def _on_halfsphere(self, t: float, fade: float) -> Array:
        """Move on a half sphere of 1 m diameter before the scene, always looking at it."""
        azimuth = np.radians(65) * fade * _wave(t, 9.0, self.phase[0])
        height = np.radians(10 + fade * (15 + 25 * _wave(t, 6.5, self.phase[1])))
        centre = self.position + np.array([0.5, 0.0, -0.1])
        out = [-np.cos(azimuth) * np.cos(height), -np.sin(azimuth) * np.cos(height)]
        T = look_at(centre + 0.5 * np.array([*out, np.sin(height)]), self.target)
        return self._held(T, t, fade)

    def _round(self, t: float, fade: float) -> Array:
        """Turn round and round on a small circle, looking outwards; first at the target."""
        to_target = self.target - self.position
        turned = _TURN_RAD_S * _faded_time(t) * (1 if self.phase[0] < np.pi else -1)
        azimuth = np.arctan2(to_target[1], to_target[0]) + turned
        dip = np.radians(10 + 4 * fade * _wave(t, 7.0, self.phase[1]))
        out = np.array([np.cos(azimuth), np.sin(azimuth), 0.0])
        centre = self.position + np.array([0.7, 0.0, 0.0])
        at = centre + _TURN_RADIUS_M * out + [0, 0, 0.08 * fade * _wave(t, 5.0, self.phase[2])]
        return self._held(look_at(at, at + out - [0, 0, np.tan(dip)]), t, fade)

    def _turn_in(self, t: float, fade: float) -> Array:
        """Look aside at first, past the right shoulder, then turn to the target."""
        away = 1 - np.clip((t - _ASIDE_S[0]) / (_ASIDE_S[1] - _ASIDE_S[0]), 0, 1)
        x = away * away * (3 - 2 * away)
        T = look_at(self.position, self.target)
        turn = Rotation.from_rotvec([0.0, 0.0, -x * _ASIDE_RAD]).as_matrix()
        T[:3, :3] = turn @ T[:3, :3]
        offset, angles = _gentle(t, self.phase)
        T[:3, 3] += T[:3, :3] @ (fade * offset)
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(fade * angles).as_matrix()
        return T

    def _held(self, T: Array, t: float, fade: float) -> Array:
        """Add the tremor of a hand."""
        jitter_m, jitter_rad = _handheld(t, self.phase)
        T[:3, 3] += fade * jitter_m
        T[:3, :3] = T[:3, :3] @ Rotation.from_rotvec(fade * jitter_rad).as_matrix()
        return T


def camera_path(kind: str, rng: np.random.Generator, position: Array, target: Array) -> CameraPath:
    """Return a camera path of a kind, its place and phases varied a little by the seed."""
    return CameraPath(
        kind,
        position + rng.uniform(-0.12, 0.12, 3) * (0.5, 1, 0.5),
        target + rng.uniform(-0.15, 0.15, 3) * (1, 1, 0.5),
        rng.uniform(0, 2 * np.pi, 6),
    )
