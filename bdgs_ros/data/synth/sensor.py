"""
What an RGB-D camera of the Kinect kind makes of true colour and depth.

Axial noise is that of Nguyen, Izadi and Lovell, "Modeling Kinect Sensor Noise for Improved 3D
Reconstruction and Tracking" (2012): sigma_z = 0.0012 + 0.0019 (z - 0.4)^2 metres. Disparity is
read in eighths of a pixel; the projector beside the camera leaves shadows; steep, near and far
surfaces give nothing.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera

Image = NDArray[np.float32]
DEPTH_SCALE = 5000  # units of a depth PNG per metre, as TUM and BONN have it


@dataclass(frozen=True)
class DepthSensor:
    """Constants of the structured-light camera."""

    baseline_m: float = 0.075
    disparity_focal_px: float = 535.4
    """Focal length in which disparity is quantised, whatever the size of the image."""
    disparity_steps: int = 8
    near_m: float = 0.4
    far_m: float = 8.0
    steepest: float = 7.0
    """Tangent of the angle between ray and normal beyond which nothing comes back."""
    edge_jitter_px: float = 0.5
    dropout: float = 0.006
    """Share of pixels that are lost in small patches for no reason."""


@dataclass(frozen=True)
class ColorSensor:
    """Constants of the colour camera and of its automatic exposure."""

    read_noise: float = 1.0
    shot_noise: float = 0.018
    """Variance per 8-bit unit of signal."""
    gain_limits: tuple[float, float] = (0.72, 1.35)
    reaction: float = 0.7
    """Exponent with which the gain answers a change of brightness; 1 would undo it."""
    settle_s: float = 0.6


def auto_exposure(
    brightness: NDArray[np.float64], period_s: float, sensor: ColorSensor
) -> NDArray[np.float64]:
    """
    Return the gain of each frame; 1 at the first, then a slow answer to its brightness.

    Parameters
    ----------
    brightness : ndarray, shape (N,)
        Mean light of each frame at gain 1.
    period_s : float
        Time between frames.
    sensor : ColorSensor
        How fast and how far the gain goes.

    """
    wanted = np.clip((brightness[0] / brightness) ** sensor.reaction, *sensor.gain_limits)
    step = 1 - np.exp(-period_s / sensor.settle_s)
    gains = np.ones(len(brightness))
    for k in range(1, len(gains)):
        gains[k] = gains[k - 1] + step * (wanted[k - 1] - gains[k - 1])
    return gains


def sense_color(
    light: Image, gain: float, sensor: ColorSensor, rng: np.random.Generator
) -> NDArray[np.uint8]:
    """Return the recorded colour, uint8 RGB [H, W, 3], of light in 8-bit units at gain 1."""
    signal = light * np.float32(gain)
    sigma = np.sqrt(np.float32(sensor.read_noise**2) + np.float32(sensor.shot_noise) * signal)
    signal += sigma * rng.standard_normal(signal.shape, dtype=np.float32)
    signal += np.float32(0.5)
    return np.asarray(np.clip(signal, 0, 255, out=signal).astype(np.uint8))


def sense_depth(
    depth_m: Image, camera: PinholeCamera, sensor: DepthSensor, rng: np.random.Generator
) -> NDArray[np.uint16]:
    """Return the recorded depth in units of 1 / DEPTH_SCALE metres, 0 where there is none."""
    valid = ~(
        _shadow(depth_m, camera, sensor)
        | _too_steep(depth_m, camera, sensor)
        | _dropout(depth_m.shape, sensor, rng)
    )
    z, valid = _jitter(depth_m, valid, sensor, rng)
    valid &= (z > sensor.near_m) & (z < sensor.far_m)
    sigma = np.float32(0.0012) + np.float32(0.0019) * (z - np.float32(0.4)) ** 2
    noisy = np.maximum(z + sigma * _patchy_noise(z.shape, rng), np.float32(0.1))
    steps = np.float32(sensor.baseline_m * sensor.disparity_focal_px * sensor.disparity_steps)
    measured = steps / np.maximum(np.rint(steps / noisy), 1)
    units = np.where(valid, measured * DEPTH_SCALE + np.float32(0.5), 0)
    return np.asarray(np.minimum(units, 65535).astype(np.uint16))


def _shadow(depth_m: Image, camera: PinholeCamera, sensor: DepthSensor) -> NDArray[np.bool_]:
    """Tell which points the projector, `baseline` to the right, cannot see for a nearer one."""
    # The projector has column u of the camera at u - f b / z. A point is hidden where something
    # to its right in the camera's image is to its left in the projector's.
    reach = np.float32(camera.fx * sensor.baseline_m)
    column = np.arange(camera.width, dtype=np.float32) - reach / depth_m
    nearest = np.minimum.accumulate(column[:, ::-1], axis=1)[:, ::-1]
    return np.asarray(column > nearest + np.float32(0.5))


def _too_steep(depth_m: Image, camera: PinholeCamera, sensor: DepthSensor) -> NDArray[np.bool_]:
    dx = cv2.Sobel(depth_m, cv2.CV_32F, 1, 0, ksize=1)
    dy = cv2.Sobel(depth_m, cv2.CV_32F, 0, 1, ksize=1)
    slope = cv2.magnitude(dx, dy)  # over two pixels
    return np.asarray(slope * np.float32(camera.fx / 2) > np.float32(sensor.steepest) * depth_m)


def _coarse(shape: tuple[int, ...], cell: int, rng: np.random.Generator) -> Image:
    small = rng.standard_normal((shape[0] // cell + 2, shape[1] // cell + 2), dtype=np.float32)
    return np.asarray(
        cv2.resize(small, (shape[1], shape[0]), interpolation=cv2.INTER_LINEAR), np.float32
    )


def _dropout(
    shape: tuple[int, ...], sensor: DepthSensor, rng: np.random.Generator
) -> NDArray[np.bool_]:
    # a bilinear blend of unit normals has a standard deviation of about 2/3
    limit = 0.67 * np.sqrt(2 * np.log(1 / (2.5 * sensor.dropout)))
    return np.asarray(_coarse(shape, 5, rng) > limit)


def _jitter(
    depth_m: Image, valid: NDArray[np.bool_], sensor: DepthSensor, rng: np.random.Generator
) -> tuple[Image, NDArray[np.bool_]]:
    """Read depth a fraction of a pixel aside, which frays the edges of things."""
    height, width = depth_m.shape
    amount = sensor.edge_jitter_px / 0.67
    moves = [_coarse(depth_m.shape, 3, rng) * np.float32(amount) for _ in range(2)]
    columns = np.arange(width, dtype=np.float32) + moves[0]
    rows = np.arange(height, dtype=np.float32)[:, None] + moves[1]
    columns = np.clip(np.rint(columns), 0, width - 1).astype(np.int32)
    index = np.clip(np.rint(rows), 0, height - 1).astype(np.int32) * width + columns
    return depth_m.ravel()[index], valid.ravel()[index]


def _patchy_noise(shape: tuple[int, ...], rng: np.random.Generator) -> Image:
    """Return unit noise whose neighbours are alike, as the sensor's matching window makes it."""
    white = rng.standard_normal(shape, dtype=np.float32)
    smooth = cv2.GaussianBlur(white, (5, 5), 0.8)
    return np.asarray(smooth * np.float32(2 * np.sqrt(np.pi) * 0.8 * 0.97), np.float32)
