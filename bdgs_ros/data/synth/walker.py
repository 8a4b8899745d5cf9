"""
People-like walkers: where their limbs are as they walk, stand and carry.

The frame of a walker stands on the floor between the feet: x ahead, y to the left, z up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.data.synth import textures
from bdgs_ros.data.synth.paths import FloorPath
from bdgs_ros.data.synth.scene import Body, Part
from bdgs_ros.data.synth.shapes import ellipsoid, limb
from bdgs_ros.data.synth.textures import Texture

Array = NDArray[np.float64]
_SHIRT, _TROUSERS, _SKIN, _HEAD, _SHOE = range(5)
_STRIDE_M = 1.35  # two steps
_SWING_RAD = 0.42
_FRONT = np.array([1.0, 0.0, 0.0])
Hands = Callable[[float], 'tuple[Array, Array] | None']
"""Time to left and right hand in the walker's frame; None while they swing freely."""


def clothes(rng: np.random.Generator) -> list[Texture]:
    """Dress a walker: textures of shirt, trousers, skin, head and shoes."""
    state = rng.integers(2**31)
    skin = textures.skin_color(np.random.default_rng(state))
    trousers = textures.color(rng, 0.08, 0.4)
    return [
        textures.cloth(rng, 224, 384, textures.color(rng, 0.12, 0.75)),
        textures.cloth(rng, 192, 160, trousers)
        if rng.random() < 0.3
        else textures.grainy(rng, 192, 160, trousers, 40, 0.18),
        textures.grainy(rng, 64, 64, skin, 30, 0.06),
        textures.head(np.random.default_rng(state), 160, 256),
        textures.grainy(rng, 48, 96, textures.color(rng, 0.05, 0.3), 12, 0.2),
    ]


@dataclass(frozen=True)
class Gait:
    """The state of the limbs: phase of the stride, how much they swing, what the hands do."""

    phase_rad: float
    swing: float
    hands: tuple[Array, Array] | None = None
    """Left and right hand in the walker's frame when they hold something."""


@dataclass(frozen=True)
class Walker:
    """A person of some height on a path; `hands` says over time what the hands reach for."""

    path: FloorPath
    scale: float
    hands: Hands | None = None
    phase0_rad: float = 0.0

    def gait(self, time_s: float) -> Gait:
        """Return the state of the limbs at a time."""
        speed = self.path.speed(time_s)
        phase = self.phase0_rad + 2 * np.pi * self.path.distance(time_s) / _STRIDE_M
        held = None if self.hands is None else self.hands(time_s)
        return Gait(float(phase), float(np.clip(speed / 1.0, 0, 1)), held)

    def parts(self, time_s: float) -> list[Part]:
        """Return the surfaces of the body at a time, in the walker's frame."""
        return body_parts(self.gait(time_s), self.scale)


def make_body(rng: np.random.Generator, walker: Walker) -> Body:
    """Return a dressed walker as a body for the scene."""
    return Body(clothes(rng), walker.parts)


def body_parts(gait: Gait, scale: float) -> list[Part]:
    """Return every surface of a body of a height of 1.75 m times `scale`."""
    bob = 0.02 * gait.swing * abs(np.sin(gait.phase_rad))
    pelvis = np.array([0.0, 0.0, 0.92 - bob])
    parts = _trunk(pelvis)
    for side, phase in ((1.0, gait.phase_rad), (-1.0, gait.phase_rad + np.pi)):
        parts += _leg(pelvis, side, phase, gait.swing)
        held = None if gait.hands is None else gait.hands[0 if side > 0 else 1] / scale
        parts += _arm(pelvis, side, phase, gait.swing, held)
    stretch = np.diag([scale, scale, scale, 1.0])
    return [Part(stretch @ p.T, p.is_limb, p.taper, p.texture) for p in parts]


def _ball(centre: Array, radii: tuple[float, float, float], texture: int) -> Part:
    return Part(ellipsoid(centre, np.array(radii)), False, 0.0, texture)


def _limb(a: Array, b: Array, r_a: float, r_b: float, texture: int, flat: float = 1.0) -> Part:
    front = _FRONT if abs((b - a)[0]) < 0.9 * np.linalg.norm(b - a) else np.array([0, 0, 1.0])
    return Part(limb(a, b, r_a, front, flat), True, r_b / r_a - 1.0, texture)


def _trunk(pelvis: Array) -> list[Part]:
    up = np.array([0.0, 0.0, 1.0])
    neck = pelvis + 0.53 * up
    return [
        _ball(pelvis + 0.02 * up, (0.115, 0.165, 0.14), _TROUSERS),
        _limb(pelvis + 0.06 * up, pelvis + 0.46 * up, 0.108, 0.122, _SHIRT, 1.45),
        _ball(pelvis + 0.46 * up, (0.118, 0.20, 0.085), _SHIRT),
        _limb(neck - 0.03 * up, neck + 0.1 * up, 0.058, 0.052, _SKIN),
        _ball(neck + np.array([0.02, 0, 0.18]), (0.098, 0.078, 0.125), _HEAD),
        _ball(neck + np.array([0.115, 0, 0.165]), (0.02, 0.013, 0.022), _SKIN),
        _ball(neck + np.array([0.01, 0.076, 0.17]), (0.014, 0.008, 0.024), _SKIN),
        _ball(neck + np.array([0.01, -0.076, 0.17]), (0.014, 0.008, 0.024), _SKIN),
    ]


def _turned(angle_rad: float) -> Array:
    """Return the downward direction swung ahead by an angle."""
    return np.array([np.sin(angle_rad), 0.0, -np.cos(angle_rad)])


def _leg(pelvis: Array, side: float, phase: float, swing: float) -> list[Part]:
    hip = pelvis + np.array([0, 0.088 * side, -0.02])
    angle = _SWING_RAD * swing * np.sin(phase)
    bend = 0.06 + swing * (0.08 + 0.85 * max(0.0, np.cos(phase)) ** 2)
    knee = hip + 0.43 * _turned(angle + 0.3 * bend)
    ankle = knee + 0.42 * _turned(angle - 0.7 * bend)
    pitch = angle - 0.7 * bend
    ahead = np.array([np.cos(pitch), 0, np.sin(pitch)])
    axes = np.column_stack([ahead, [0, 1, 0], np.cross(ahead, [0, 1, 0])])
    shoe = ellipsoid(
        ankle + 0.075 * ahead - 0.02 * axes[:, 2], np.array([0.135, 0.048, 0.05]), axes
    )
    return [
        _ball(hip, (0.09, 0.09, 0.09), _TROUSERS),
        _limb(hip, knee, 0.09, 0.062, _TROUSERS),
        _ball(knee, (0.062, 0.062, 0.062), _TROUSERS),
        _limb(knee, ankle, 0.061, 0.05, _TROUSERS),
        Part(shoe, False, 0.0, _SHOE),
    ]


def _arm(pelvis: Array, side: float, phase: float, swing: float, held: Array | None) -> list[Part]:
    shoulder = pelvis + np.array([0, 0.205 * side, 0.465])
    if held is None:
        angle = -0.45 * swing * np.sin(phase)
        elbow = shoulder + 0.29 * _turned(angle) + np.array([0, 0.045 * side, 0])
        hand = elbow + 0.26 * _turned(angle + 0.25 + 0.2 * swing)
    else:
        elbow, hand = _reach(shoulder, held, side)
    return [
        _ball(shoulder, (0.062, 0.062, 0.062), _SHIRT),
        _limb(shoulder, elbow, 0.06, 0.047, _SHIRT),
        _ball(elbow, (0.046, 0.046, 0.046), _SHIRT),
        _limb(elbow, hand, 0.044, 0.032, _SKIN),
        _ball(hand, (0.048, 0.04, 0.055), _SKIN),
    ]


def _reach(shoulder: Array, hand: Array, side: float) -> tuple[Array, Array]:
    """Bend the elbow outwards and down so that the hand is where it should be, if it can."""
    upper, fore = 0.29, 0.26
    line = hand - shoulder
    distance = float(np.clip(np.linalg.norm(line), 0.1, 0.985 * (upper + fore)))
    ahead = line / np.linalg.norm(line)
    along = (upper**2 - fore**2 + distance**2) / (2 * distance)
    out = np.array([-0.2, 0.5 * side, -1.0])
    out -= (out @ ahead) * ahead
    out /= np.linalg.norm(out)
    elbow = shoulder + along * ahead + np.sqrt(max(upper**2 - along**2, 0.0)) * out
    return elbow, shoulder + distance * ahead
