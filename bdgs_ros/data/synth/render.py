"""
One frame of a world: what the sensor integrates, and what is true at its stamp.

Colour is the mean of four samples per pixel, half a pixel apart. In the recorded image the four
are also spread over the exposure, so the mean carries motion blur of camera and movers at no
further cost; the true static image has all four at the stamp. Depth and ids are exact, one
sample at the pixel's centre at the stamp.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.data.synth.raster import (
    QuadricForms,
    SampleGrid,
    Visibility,
    draw_quadrics,
    draw_quads,
)
from bdgs_ros.data.synth.scenarios import World
from bdgs_ros.data.synth.scene import Surfaces
from bdgs_ros.data.synth.shade import CameraScene, shade

Array = NDArray[np.float64]
# right, down (pixels), time (share of the exposure), mip dither; shifts and times have mean zero,
# so that the blurred image is neither moved nor late
_SAMPLES = (
    (-0.25, -0.25, -0.375, 0.125),
    (0.25, 0.25, -0.125, 0.625),
    (0.25, -0.25, 0.125, 0.875),
    (-0.25, 0.25, 0.375, 0.375),
)


@dataclass(frozen=True)
class FrameImages:
    """
    The images of one frame.

    `color` and `static_color` are light in 8-bit units at exposure gain 1, float32 [H, W, 3];
    depths are metres along z, float32 [H, W]; `object_id` is uint8 [H, W], 0 where nothing is.
    """

    color: NDArray[np.float32]
    depth_m: NDArray[np.float32]
    object_id: NDArray[np.uint8]
    static_color: NDArray[np.float32]
    static_depth_m: NDArray[np.float32]


class FrameRenderer:
    """Render frames of a world through a camera."""

    def __init__(self, world: World, camera: PinholeCamera, exposure_s: float) -> None:
        self._world, self._camera, self._exposure_s = world, camera, exposure_s

    def render(self, time_s: float) -> FrameImages:
        """Return all images at a time in seconds from the first frame."""
        everything, static = self._world.scene.surfaces(time_s), self._static(time_s)
        grid = SampleGrid.of(self._camera)
        seen = draw(self._view(everything, time_s), grid)
        bare = seen if everything is static else draw(self._view(static, time_s), grid)
        return FrameImages(
            color=self._color(time_s, None, self._exposure_s),
            depth_m=np.float32(1) / seen.inv_depth,
            object_id=_object_ids(everything, seen),
            static_color=self._color(time_s, static, 0.0),
            static_depth_m=np.float32(1) / bare.inv_depth,
        )

    def brightness(self, time_s: float) -> float:
        """Return the mean light of the frame in 8-bit units, from one sample per pixel."""
        scene = self._view(self._world.scene.surfaces(time_s), time_s)
        grid = SampleGrid.of(self._camera)
        return float(shade(scene, draw(scene, grid), grid, self._world.scene.atlas, 0.5).mean())

    def _static(self, time_s: float) -> Surfaces:
        return self._world.scene.surfaces(time_s, at_rest_of_s=time_s)

    def _color(
        self, time_s: float, surfaces: Surfaces | None, exposure_s: float
    ) -> NDArray[np.float32]:
        """Average the samples; `surfaces` None takes those of each sample's own time."""
        total = np.zeros((*self._camera.shape, 3), np.uint16)
        for right, down, share, dither in _SAMPLES:
            t = time_s + share * exposure_s
            scene = self._view(surfaces or self._world.scene.surfaces(t), t)
            grid = SampleGrid.of(self._camera, (right, down))
            total += shade(scene, draw(scene, grid), grid, self._world.scene.atlas, dither)
        return total.astype(np.float32) * np.float32(1 / len(_SAMPLES))

    def _view(self, surfaces: Surfaces, time_s: float) -> CameraScene:
        T_camera_world = se3.inverse(self._world.camera_path.pose(time_s))
        quadrics = surfaces.quadrics.transformed(T_camera_world)
        return CameraScene(
            surfaces.quads.transformed(T_camera_world),
            quadrics,
            QuadricForms.of(quadrics),
            T_camera_world[:3, :3],
        )


def draw(scene: CameraScene, grid: SampleGrid) -> Visibility:
    """Return what each sample sees."""
    seen = Visibility.empty(grid)
    draw_quads(scene.quads, grid, seen)
    draw_quadrics(scene.quadrics, scene.forms, grid, seen, len(scene.quads))
    return seen


def _object_ids(surfaces: Surfaces, seen: Visibility) -> NDArray[np.uint8]:
    ids = np.concatenate([surfaces.quads.object_id, surfaces.quadrics.object_id, [0]])
    return np.asarray(ids.astype(np.uint8)[seen.surface])
