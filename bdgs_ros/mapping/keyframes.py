"""Keyframes as mapping keeps them: images by pyramid level, mask and exposure."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.images import sample_depth, shrink_frame, shrink_labels
from bdgs_ros.core.types import (
    DYNAMIC_THRESHOLD,
    ColorImage,
    DepthImage,
    Keyframe,
    Pose,
    ProbabilityImage,
    RgbdFrame,
)
from bdgs_ros.mapping.vignette import Vignette

Array = NDArray[np.float32]


@dataclass(frozen=True)
class Window:
    """A part of an image: one optimisation step need not look at all of it."""

    rows: slice
    columns: slice


@dataclass(frozen=True)
class Level:
    """
    A keyframe's images at one level of the Gaussian pyramid GP^i of Eq. 12.

    They are kept as they came, in eight bits; `color` and `weight` are made when asked for.
    """

    camera: PinholeCamera
    image: ColorImage  # [H, W, 3]
    depth_m: DepthImage  # [H, W]
    static: NDArray[np.bool_]  # [H, W] False where something moves
    vignette: Vignette = field(default_factory=Vignette)
    part: tuple[PinholeCamera, Window] | None = None
    """Of which image this is a part, if any: what holds for all windows is computed once."""

    @property
    def color(self) -> Array:
        """RGB without the lens's falloff, nominally in [0, 1], [H, W, 3]."""
        if self.part is None:
            return np.asarray(self.image * self.vignette.scale(self.camera), np.float32)
        whole, window = self.part
        scale = self.vignette.scale(whole)[window.rows, window.columns]
        return np.asarray(self.image * scale, np.float32)

    @property
    def weight(self) -> Array:
        """1 where static, 0 where something moves, [H, W]."""
        return self.static.astype(np.float32)

    def cut(self, window: Window) -> Level:
        """Return the part that a window shows, as a level with a camera of its own."""
        at = (window.rows, window.columns)
        camera = replace(
            self.camera,
            width=window.columns.stop - window.columns.start,
            height=window.rows.stop - window.rows.start,
            cx=self.camera.cx - window.columns.start,
            cy=self.camera.cy - window.rows.start,
        )
        images = self.image[at], self.depth_m[at], self.static[at]
        return Level(camera, *images, self.vignette, (self.camera, window))


@dataclass(eq=False)
class MapKeyframe:
    """One keyframe in the map's window."""

    index: int
    stamp_ns: int
    T_world_camera: Pose
    p_dynamic: ProbabilityImage
    levels: tuple[Level, ...]
    """Finest first."""
    exposure: Array = field(default_factory=lambda: np.zeros(2, np.float32))
    """(log gain, offset): the camera's image is exp(gain) * render + offset."""
    depth_bend: tuple[float, ...] = ()
    """What the depth of `levels` was corrected by; see `bdgs_ros.mapping.depth_bend`."""
    exposure_moments: list[Array] = field(
        default_factory=lambda: [np.zeros(2, np.float32), np.zeros(2, np.float32)]
    )
    pose_moments: list[Array] = field(
        default_factory=lambda: [np.zeros(6, np.float32), np.zeros(6, np.float32)]
    )

    def move(self, xi: Array) -> None:
        """Change the pose: `T_camera_world <- exp(xi) T_camera_world`, xi = (rho, phi), [6]."""
        moved = se3.exp(xi.astype(np.float64)) @ self.T_camera_world
        self.T_world_camera = se3.orthonormalise(se3.inverse(moved))

    @property
    def T_camera_world(self) -> Pose:
        """World to camera, shape (4, 4)."""
        return se3.inverse(self.T_world_camera)


def photograph(kept: MapKeyframe) -> Keyframe:
    """Return a keyframe as a photograph of a place that may be recognised."""
    level = kept.levels[0]
    frame = RgbdFrame(kept.stamp_ns, level.image, level.depth_m, level.camera)
    moving = np.where(level.static, kept.p_dynamic, np.uint8(255))
    return Keyframe(frame, kept.T_world_camera, moving)


def shrink(keyframe: Keyframe, width: int) -> Keyframe:
    """
    Bring a keyframe to the map's width: colour averaged, depth per surface, masks grown.

    A depth that is the average of two surfaces lies on neither, so depths are averaged within
    one; a dynamic pixel must not get lost, so probabilities take the maximum.
    """
    if keyframe.frame.camera.width <= width:
        return keyframe
    small = shrink_frame(keyframe.frame, width)
    p_dynamic = shrink_labels(keyframe.p_dynamic, small.camera.shape)
    return Keyframe(small, keyframe.T_world_camera, p_dynamic)


def build_levels(
    color: NDArray[np.uint8],
    depth_m: DepthImage,
    dynamic: NDArray[np.bool_],
    camera: PinholeCamera,
    count: int,
    vignette: Vignette | None = None,
) -> tuple[Level, ...]:
    """
    Build the pyramid of Eq. 12, finest level first.

    Parameters
    ----------
    color, depth_m, dynamic : ndarray, shape (H, W, ...)
        The keyframe at the map's width; `dynamic` pixels get weight 0.
    camera : PinholeCamera
        At that width.
    count : int
        Levels, L + 1 in the paper.
    vignette : Vignette, optional
        Of the camera; the levels follow what it learns later. None by default.

    """
    levels = [Level(camera, color, depth_m, ~dynamic, vignette or Vignette())]
    for _ in range(count - 1):
        levels.append(_halve(levels[-1]))
    return tuple(levels)


def _halve(level: Level) -> Level:
    camera = level.camera.scaled(0.5)
    size = (camera.width, camera.height)
    image = cv2.resize(level.image, size, interpolation=cv2.INTER_AREA)
    weight = cv2.resize(level.weight, size, interpolation=cv2.INTER_AREA)
    return Level(
        camera,
        np.asarray(image, np.uint8),
        sample_depth(level.depth_m, camera.shape),
        np.asarray(weight >= 1),
        level.vignette,
    )


def most_redundant(keyframes: Sequence[MapKeyframe]) -> MapKeyframe:
    """Return the keyframe that another one, from about the same place, can best stand in for."""
    if len(keyframes) == 1:
        return keyframes[0]
    # A metre apart and a radian turned count alike: either changes what is seen about as much.
    distance = se3.view_distances([k.T_world_camera for k in keyframes], metres_per_radian=1.0)
    return keyframes[int(distance.min(axis=1).argmin())]


def is_dynamic(p_dynamic: ProbabilityImage) -> NDArray[np.bool_]:
    """Return which pixels are called dynamic."""
    return np.asarray(p_dynamic >= DYNAMIC_THRESHOLD)
