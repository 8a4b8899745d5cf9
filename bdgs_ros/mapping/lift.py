"""From cells of a keyframe's image to flat Gaussians on the surfaces that it shows."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.mapping import InsertConfig
from bdgs_ros.mapping.cells import Cells, average, choose_cells
from bdgs_ros.mapping.gaussians import NewGaussians
from bdgs_ros.mapping.keyframes import Level, MapKeyframe
from bdgs_ros.mapping.rotations import quats_from_axes
from bdgs_ros.mapping.surface import Surface

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]


def lift(
    keyframe: MapKeyframe,
    level: Level,
    surface: Surface,
    pixels: Mask,
    belief: float,
    config: InsertConfig,
) -> NewGaussians:
    """
    Cover pixels of a level of a keyframe with Gaussians in world.

    Parameters
    ----------
    keyframe : MapKeyframe
        Pose and exposure.
    level : Level
        Camera and colour.
    surface : Surface
        Of the level's depth.
    pixels : ndarray of bool, shape (H, W)
        What to cover; all of them must have a depth.
    belief : float
        P(dynamic) of the new Gaussians.
    config : InsertConfig
        Their number, size and shape.

    """
    cells = choose_cells(pixels, level.color, config.finest, config.doublings, config.detail)
    rays = _rays(level.camera, cells)
    share = np.maximum(average(pixels.astype(np.float32), cells), 1e-6)
    inverse_depth = average(surface.inverse_depth * pixels, cells) / share
    normals = average(surface.normals * pixels[..., None], cells)
    color = average(level.color * pixels[..., None], cells) / share[:, None]
    points = np.asarray(rays / inverse_depth[:, None], np.float32)
    width = np.float32(config.sigma_px / level.camera.fx) * cells.size * points[:, 2]
    axes, scales = _shapes(rays, normals, width.astype(np.float32), config)
    T = keyframe.T_world_camera.astype(np.float32)
    gain, offset = np.exp(keyframe.exposure[0]), keyframe.exposure[1]
    return NewGaussians(
        means=points @ T[:3, :3].T + T[:3, 3],
        quats=quats_from_axes(T[:3, :3] @ axes),
        scales=scales,
        colors=(color - offset) / gain,
        belief=np.full(len(points), belief, np.float32),
    )


def _rays(camera: PinholeCamera, cells: Cells) -> Array:
    """Return the rays with z = 1 through the centres of cells, [M, 3]."""
    half = (cells.size - 1) / 2
    tangents = camera.tangents(np.stack([cells.column + half, cells.row + half], axis=1))
    return np.column_stack([tangents, np.ones(len(tangents))]).astype(np.float32)


def _shapes(
    rays: Array, normals: Array, width: Array, config: InsertConfig
) -> tuple[Array, Array]:
    """
    Return axes as columns in camera, [M, 3, 3], and standard deviations along them, [M, 3].

    A cell of the image is seen on the surface stretched by 1 / cos(slant) in the direction in
    which it slants: the second axis. The third is the normal. Where there is no normal, or cells
    of different surfaces would share one, Gaussians are round.
    """
    length = np.linalg.norm(normals, axis=1)
    oriented = length > 0.9
    away = rays / np.linalg.norm(rays, axis=1, keepdims=True)
    normal = np.where(oriented[:, None], normals / np.maximum(length, 1e-6)[:, None], -away)
    across = np.cross(away, normal)
    sine = np.linalg.norm(across, axis=1, keepdims=True)
    # Seen straight on, any direction across will do.
    fallback = np.cross(normal, np.where(np.abs(normal[:, :1]) < 0.6, [[1, 0, 0]], [[0, 1, 0]]))
    fallback /= np.linalg.norm(fallback, axis=1, keepdims=True)
    across = np.where(sine > 1e-3, across / np.maximum(sine, 1e-6), fallback)
    axes = np.stack([across, np.cross(normal, across), normal], axis=2).astype(np.float32)
    cosine = np.abs(np.einsum('mi,mi->m', away, normal))
    stretch = np.minimum(1 / np.maximum(cosine, 1e-3), config.max_slant)
    one = np.ones_like(width)
    thickness = np.where(oriented, np.float32(config.flatness), one)
    scales = width[:, None] * np.stack([one, np.where(oriented, stretch, one), thickness], axis=1)
    return axes, scales.astype(np.float32)
