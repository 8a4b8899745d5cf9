"""A rolling shutter: images are straightened, and alignment takes the rows' times into account."""

from __future__ import annotations

import numpy as np
import pytest
from test_align import BACKENDS, CAMERA, MOTION, cast, errors, needs_native

from bdgs_ros.core import se3
from bdgs_ros.core.config.tracking import AlignConfig
from bdgs_ros.core.types import RgbdFrame
from bdgs_ros.tracking.align import Aligner
from bdgs_ros.tracking.shutter import straightened

SWEEP = np.array([0.004, -0.003, 0.006, 0.02, 0.04, -0.015])
BOXES: list = []


def rolling(T_world_camera: np.ndarray, sweep: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return grey uint8 and depth, every row from where the camera is when it is read out."""
    grey = np.zeros(CAMERA.shape)
    depth_m = np.zeros(CAMERA.shape, np.float32)
    for first in range(0, CAMERA.height, 4):
        share = (first + 2) / CAMERA.height - 0.5
        image, depth = cast(T_world_camera @ se3.exp(share * sweep), CAMERA, BOXES)
        grey[first : first + 4], depth_m[first : first + 4] = (
            image[first : first + 4],
            depth[first : first + 4],
        )
    return np.rint(255 * grey).astype(np.uint8), depth_m


@pytest.fixture(scope='module')
def images() -> dict[str, tuple[np.ndarray, np.ndarray]]:
    still = cast(np.eye(4), CAMERA, BOXES)
    return {
        'still': (np.rint(255 * still[0]).astype(np.uint8), still[1]),
        'turning': rolling(se3.exp(MOTION), SWEEP),
        'turning_too': rolling(np.eye(4), -0.7 * SWEEP),
    }


@pytest.mark.parametrize('backend', BACKENDS)
@pytest.mark.parametrize(
    ('reference', 'of_reference', 'current', 'of_current'),
    [
        ('still', 0.0, 'turning', 1.0),
        ('turning_too', -0.7, 'turning', 1.0),
    ],
)
def test_alignment_knows_when_rows_were_read(
    images: dict,
    backend: str,
    reference: str,
    of_reference: float,
    current: str,
    of_current: float,
) -> None:
    aligner = Aligner(AlignConfig(backend=backend))

    def error_m(*sweeps: np.ndarray) -> float:
        pyramids = [
            aligner.pyramid(*images[name], None, CAMERA, sweep)
            for name, sweep in zip((reference, current), sweeps, strict=True)
        ]
        return errors(aligner.align(*pyramids, np.eye(4)).T_current_reference)[0]

    known = error_m(of_reference * SWEEP, of_current * SWEEP)
    unknown = error_m(np.zeros(6), np.zeros(6))
    assert known < 3e-3
    assert unknown > 10 * known


@needs_native
def test_twins_agree_on_a_rolling_shutter(images: dict) -> None:
    results, maps = [], []
    for backend in ('native', 'numpy'):
        aligner = Aligner(AlignConfig(backend=backend))
        reference = aligner.pyramid(*images['turning_too'], None, CAMERA, -0.7 * SWEEP)
        unmasked = aligner.pyramid(*images['turning'], None, CAMERA)
        nothing = np.zeros(CAMERA.shape, np.uint8)
        current = aligner.with_dynamic(unmasked, nothing, SWEEP)
        results.append(aligner.align(reference, current, np.eye(4)))
        T = results[0].T_current_reference
        maps.append(aligner.residual_maps(reference, current, T))
    assert np.allclose(results[0].T_current_reference, results[1].T_current_reference, atol=1e-5)
    assert np.abs(maps[0].valid ^ maps[1].valid).mean() < 1e-3
    assert (np.abs(maps[0].depth_sigma - maps[1].depth_sigma) > 0.01).mean() < 1e-3


def test_a_straightened_image_is_that_of_a_global_shutter() -> None:
    turning = np.concatenate([np.zeros(3), SWEEP[3:]])
    grey, depth_m = rolling(np.eye(4), turning)
    frame = RgbdFrame(1, np.repeat(grey[..., None], 3, axis=2), depth_m, CAMERA)
    mask = np.where(grey > 140, 255, 0).astype(np.uint8)
    straight, straight_mask = straightened(frame, mask, turning)
    true, true_depth = cast(np.eye(4), CAMERA, BOXES)
    inner = np.s_[12:-12, 12:-12]
    error = np.abs(straight.color[..., 0] / 255.0 - true)[inner]
    assert error.mean() < 0.25 * np.abs(grey / 255.0 - true)[inner].mean()
    assert np.abs(straight.depth_m - true_depth)[inner].mean() < 0.01
    agree = (straight_mask > 0) == (straight.color[..., 0] > 140)
    assert agree[inner].mean() > 0.99


def test_a_camera_at_rest_keeps_its_images() -> None:
    frame = RgbdFrame(
        1, np.zeros((240, 320, 3), np.uint8), np.ones((240, 320), np.float32), CAMERA
    )
    mask = np.zeros(CAMERA.shape, np.uint8)
    straight, same_mask = straightened(frame, mask, np.array([0.1, 0, 0, 1e-4, 0, 0]))
    assert straight is frame and same_mask is mask
