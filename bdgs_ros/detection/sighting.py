"""Between boxes in the image and objects in space: where a detection is, how an object looks."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.detection import CutConfig, TracksConfig
from bdgs_ros.core.types import DepthImage, Detection, Pose
from bdgs_ros.detection.mask import object_depths

Vector = NDArray[np.float64]

_NOMINAL_M, _NOMINAL_SIGMA_M = 0.5, 0.3  # nearer than a structured-light camera sees
_BORDER_PX = 3.0
_CUT_OFF = 5.0  # times the noise, of a box that the image border cuts


@dataclass(frozen=True)
class Sighting:
    """One detection with its place in the camera's frame."""

    detection: Detection
    centre: Vector
    """Of the box, at the object's depth, metres, shape (3,)."""
    size_m: tuple[float, float]
    """Width and height."""
    has_depth: bool
    cut_off: tuple[bool, bool]
    """Whether the border of the image cuts it: left or right; above or below."""

    def measurement(self, T_odom_camera: Pose, config: TracksConfig) -> tuple[Vector, Vector]:
        """
        Return (x y z w h) in the odometry frame and its covariance, shapes (5,) and (5, 5).

        The noise of a box grows with its size. Where the image cuts it, neither its centre nor
        its size is what is seen.
        """
        scale = [_CUT_OFF if cut else 1.0 for cut in self.cut_off]
        sigma_w, sigma_h = (config.box_sigma * s * k for s, k in zip(self.size_m, scale, strict=True))
        sigma_z = config.depth_sigma if self.has_depth else _NOMINAL_SIGMA_M
        rotation = T_odom_camera[:3, :3]
        R = np.zeros((5, 5))
        R[:3, :3] = rotation @ np.diag([sigma_w**2, sigma_h**2, sigma_z**2]) @ rotation.T
        R[3, 3], R[4, 4] = 2 * sigma_w**2, 2 * sigma_h**2
        position = rotation @ self.centre + T_odom_camera[:3, 3]
        return np.array([*position, *self.size_m]), R


@dataclass(frozen=True)
class Shown:
    """How an object appears in an image."""

    box: tuple[float, float, float, float]
    """x0 y0 x1 y1 in pixels; may reach beyond the image."""
    clipped: tuple[float, float, float, float]
    """The part inside."""
    depth_m: float

    @property
    def visible(self) -> float:
        """Share of the box inside the image."""
        return _area(self.clipped) / max(_area(self.box), 1e-9)


def sightings(
    detections: Sequence[Detection], depth_m: DepthImage, camera: PinholeCamera, config: CutConfig
) -> list[Sighting]:
    """
    Return the detections that can move, with their places.

    Parameters
    ----------
    detections : sequence of Detection
        In pixels of the image.
    depth_m : ndarray, shape (H, W), float32
        Metres; 0 where invalid.
    camera : PinholeCamera
        Of both.
    config : CutConfig
        How the object is found in its box.

    """
    movers = [d for d in detections if d.p_dynamic > 0]
    depths = object_depths(movers, depth_m, config)
    return [_sighting(d, z, camera) for d, z in zip(movers, depths, strict=True)]


def _sighting(detection: Detection, depth_m: float | None, camera: PinholeCamera) -> Sighting:
    z = _NOMINAL_M if depth_m is None else depth_m
    x0, y0, x1, y1 = detection.box_xyxy
    u, v = (x0 + x1) / 2, (y0 + y1) / 2
    centre = np.array([(u - camera.cx) / camera.fx * z, (v - camera.cy) / camera.fy * z, z])
    size_m = ((x1 - x0) * z / camera.fx, (y1 - y0) * z / camera.fy)
    far = _BORDER_PX
    cut_off = (
        x0 < far or x1 > camera.width - far,
        y0 < far or y1 > camera.height - far,
    )
    return Sighting(detection, centre, size_m, depth_m is not None, cut_off)


def shown_as(state: Vector, camera: PinholeCamera, T_odom_camera: Pose) -> Shown | None:
    """Return how an object with state (x y z w h ...) appears; None behind the camera."""
    x, y, z = T_odom_camera[:3, :3].T @ (state[:3] - T_odom_camera[:3, 3])
    if z < 0.1:
        return None
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    # A filter that is told of clipped boxes may shrink below nothing.
    half_w, half_h = (0.5 * f * max(s, 0.05) / z for f, s in zip((camera.fx, camera.fy), state[3:5], strict=True))
    box = (u - half_w, v - half_h, u + half_w, v + half_h)
    limit = [camera.width, camera.height, camera.width, camera.height]
    a, b, c, d = np.clip(box, 0, limit).tolist()
    return Shown(box, (a, b, c, d), float(z))


def _area(box: tuple[float, float, float, float]) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])
