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
_HIDDEN_SIGMA_M = 0.5  # where an edge is that lies beyond the border of the image


@dataclass(frozen=True)
class Sighting:
    """One detection with its place in the camera's frame."""

    detection: Detection
    edges_m: Vector
    """Left, top, right and bottom of the box at the object's depth, metres, shape (4,)."""
    depth_m: float
    has_depth: bool
    """Whether the depth is measured."""
    cut_off: tuple[bool, bool, bool, bool]
    """Which edges are those of the image: left, top, right, bottom; the object goes on beyond."""


@dataclass(frozen=True)
class Measurement:
    """
    What a sighting says about the state of an object: z = H state + noise.

    z is (left, top, right, bottom, depth) in metres in the axes of the camera, relative to the
    odometry frame's origin.
    """

    z: Vector
    """Shape (5,)."""
    H: Vector
    """Shape (5, 8)."""
    R: Vector
    """Shape (5, 5)."""


def measurement(sighting: Sighting, T_odom_camera: Pose, config: TracksConfig) -> Measurement:
    """
    Return the measurement that a sighting is.

    The noise of an edge grows with the size of the box, unless the border of the image cuts it:
    then nearly nothing is known of it. An error of the depth moves the edges along their rays.
    """
    left, top, right, bottom = sighting.edges_m
    sizes = np.array([right - left, bottom - top] * 2)
    sigma = np.where(sighting.cut_off, _HIDDEN_SIGMA_M, config.box_sigma * sizes)
    sigma_z = config.depth_sigma if sighting.has_depth else _NOMINAL_SIGMA_M
    rays = np.append(sighting.edges_m / sighting.depth_m, 1.0)
    R = np.diag(np.append(sigma**2, 0.0)) + sigma_z**2 * np.outer(rays, rays)
    axes = T_odom_camera[:3, :3].T
    H = np.zeros((5, 8))
    H[[0, 2], :3], H[[1, 3], :3], H[4, :3] = axes[0], axes[1], axes[2]
    H[[0, 2], 3] = H[[1, 3], 4] = (-0.5, 0.5)
    x, y, depth = axes @ T_odom_camera[:3, 3]
    z = np.append(sighting.edges_m, sighting.depth_m) + np.array([x, y, x, y, depth])
    return Measurement(z, H, R)


def first_state(m: Measurement) -> tuple[Vector, Vector]:
    """Return (x y z w h) that explains a measurement and its covariance, (5,) and (5, 5)."""
    inverse = np.linalg.inv(m.H[:, :5])
    return inverse @ m.z, inverse @ m.R @ inverse.T


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
    return [place(d, z, camera) for d, z in zip(movers, depths, strict=True)]


def place(detection: Detection, depth_m: float | None, camera: PinholeCamera) -> Sighting:
    """Return a detection with its place; where it has no depth it is nearer than sensors see."""
    z = _NOMINAL_M if depth_m is None else depth_m
    x0, y0, x1, y1 = detection.box_xyxy
    centre, focal = (camera.cx, camera.cy) * 2, (camera.fx, camera.fy) * 2
    edges_m = (np.array(detection.box_xyxy) - centre) / focal * z
    right, bottom = camera.width - _BORDER_PX, camera.height - _BORDER_PX
    cut_off = (x0 < _BORDER_PX, y0 < _BORDER_PX, x1 > right, y1 > bottom)
    return Sighting(detection, edges_m, z, depth_m is not None, cut_off)


def shown_as(state: Vector, camera: PinholeCamera, T_odom_camera: Pose) -> Shown | None:
    """Return how an object with state (x y z w h ...) appears; None behind the camera."""
    x, y, z = T_odom_camera[:3, :3].T @ (state[:3] - T_odom_camera[:3, 3])
    if z < 0.1:
        return None
    u, v = camera.fx * x / z + camera.cx, camera.fy * y / z + camera.cy
    # A filter that is told of clipped boxes may shrink below nothing.
    half_w, half_h = (
        0.5 * f * max(s, 0.05) / z for f, s in zip((camera.fx, camera.fy), state[3:5], strict=True)
    )
    box = (u - half_w, v - half_h, u + half_w, v + half_h)
    limit = [camera.width, camera.height, camera.width, camera.height]
    a, b, c, d = np.clip(box, 0, limit).tolist()
    return Shown(box, (a, b, c, d), float(z))


def _area(box: tuple[float, float, float, float]) -> float:
    return (box[2] - box[0]) * (box[3] - box[1])
