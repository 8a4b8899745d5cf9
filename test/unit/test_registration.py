"""Colour and depth that are apart, in time or by pixels, on boards that hang before a wall."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

import cv2
import numpy as np
import pytest

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.types import RgbdFrame
from bdgs_ros.tracking.registration import RegistrationWatch

CAMERA = PinholeCamera(320, 240, 260.0, 260.0, 159.5, 119.5)
CONFIG = BdgsConfig().tracking.registration
FRAMES = 100
PERIOD_NS = 33_333_333


def images(shake_px: float = 8.0) -> list[tuple[np.ndarray, np.ndarray]]:
    """Colour and depth as a camera sees them that is shaken; everything has a pattern."""
    rng = np.random.default_rng(0)
    noise = rng.normal(0, 1, (300, 400)).astype(np.float32)
    wall = 128 + 60 * cv2.GaussianBlur(noise, (0, 0), 4)
    boards = [
        (rng.integers(40, 320), rng.integers(40, 220), rng.integers(20, 50)) for _ in range(9)
    ]
    grey, depth = wall.copy(), np.full(wall.shape, 3.0, np.float32)
    for i, (x, y, half) in enumerate(boards):
        place = np.s_[y - half : y + half, x - half : x + half]
        depth[place] = 1.0 + 0.1 * i
        grey[place] = np.clip(60 + 20 * i + 10 * noise[place], 0, 255)
    made = []
    for i in range(FRAMES):
        x = 40 + shake_px * (np.sin(i / 6) + 0.5 * np.sin(i / 2.3))
        y = 30 + shake_px * np.cos(i / 7)
        shift = np.array([[1, 0, -x], [0, 1, -y]], np.float32)
        seen = cv2.warpAffine(grey, shift, (320, 240), flags=cv2.INTER_LINEAR)
        near = cv2.warpAffine(depth, shift, (320, 240), flags=cv2.INTER_NEAREST)
        color = np.repeat(np.clip(seen, 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        made.append((color, near))
    return made


def frames(
    late: int = 0, scale: float = 1.0, shift_px: float = 0.0, shake_px: float = 8.0
) -> list[RgbdFrame]:
    """Recordings with depth that is `late` images old, and not where it should be."""
    made = images(shake_px)
    wrong = np.array([
        [1 / scale, 0, 159.5 - (159.5 + shift_px) / scale],
        [0, 1 / scale, 119.5 - 119.5 / scale],
    ])  # fmt: skip
    found = []
    for i in range(late, FRAMES):
        depth = cv2.warpAffine(made[i - late][1], wrong, (320, 240), flags=cv2.INTER_NEAREST)
        found.append(RgbdFrame(i * PERIOD_NS, made[i][0], np.asarray(depth, np.float32), CAMERA))
    return found


def watched(seen: Sequence[RgbdFrame]) -> RegistrationWatch:
    watch = RegistrationWatch(CONFIG)
    for frame in seen:
        watch.add(frame)
    watch.finish()
    assert watch.found is not None
    return watch


def test_what_belongs_together_is_not_objected_to() -> None:
    watch = watched(frames())
    assert watch.objection == ''
    assert abs(watch.found.lag_s) < 0.01  # type: ignore[union-attr]
    assert watch.found.scale == pytest.approx(1, abs=0.01)  # type: ignore[union-attr]


@pytest.mark.parametrize('late', [1, 3, 20])
def test_depth_that_is_late_is_measured_to_milliseconds(late: int) -> None:
    watch = watched(frames(late))
    assert watch.found is not None
    assert watch.found.depth_offset_s == pytest.approx(late / 30, abs=0.012)
    assert not watch.found.is_elsewhere(CONFIG)
    numbers = re.search(r'(\d+) ms earlier .*camera.depth_offset_s to (\d\.\d+)', watch.objection)
    assert numbers is not None
    assert float(numbers[1]) == pytest.approx(1000 * late / 30, abs=12)
    assert float(numbers[2]) == pytest.approx(late / 30, abs=0.012)


def test_stamps_that_are_honest_about_the_delay_need_no_correction() -> None:
    """Depth is an image older than colour, and its stamp says so: there was nothing better."""
    honest = [replace(frame, depth_delay_ns=-PERIOD_NS) for frame in frames(late=1)]
    watch = watched(honest)
    assert watch.found is not None
    assert watch.found.depth_offset_s == pytest.approx(0, abs=0.012)


@pytest.mark.parametrize(('scale', 'shift_px'), [(1.12, 0.0), (0.9, -6.0), (1.0, 12.0)])
def test_depth_that_is_not_registered_is_said_with_its_scale_and_shift(
    scale: float, shift_px: float
) -> None:
    watch = watched(frames(scale=scale, shift_px=shift_px))
    assert watch.found is not None
    assert watch.found.scale == pytest.approx(scale, abs=0.02)
    assert watch.found.shift_px[0] == pytest.approx(shift_px, abs=2.0)
    assert not watch.found.is_late(CONFIG)
    assert 'not registered to colour' in watch.objection
    assert f'scaled by {watch.found.scale:.3f}' in watch.objection


def test_a_camera_at_rest_tells_nothing_of_time() -> None:
    watch = watched(frames(late=2, shake_px=0.0))
    assert watch.found is not None
    assert not watch.found.is_late(CONFIG)


def test_a_plain_wall_tells_nothing() -> None:
    wall = np.full((240, 320), 1.5, np.float32)
    watch = RegistrationWatch(CONFIG)
    for frame in frames():
        watch.add(replace(frame, depth_m=wall))
    watch.finish()
    assert watch.found is None
    assert watch.objection == ''


def test_the_offset_is_measured_in_the_first_seconds_alone() -> None:
    read: list[int] = []

    def recording() -> object:
        for i, frame in enumerate(frames(late=2) * 2):
            read.append(i)
            yield replace(frame, stamp_ns=i * 2 * PERIOD_NS)

    watch = RegistrationWatch(CONFIG)
    offset_s = watch.measured_offset_s(recording())  # type: ignore[arg-type]
    assert offset_s == pytest.approx(4 / 30, abs=0.03)
    assert len(read) * 2 / 30 < CONFIG.window_s + 1
