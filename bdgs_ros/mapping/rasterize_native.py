"""The compiled rasteriser, src/rasterizer.cpp, behind the `Backend` protocol."""

from __future__ import annotations

import importlib
import threading
from collections.abc import Sequence
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.mapping.rasterize_types import (
    AdamConstants,
    AdamGroup,
    Array,
    FusedResult,
    Gradients,
    LossWeights,
    Rendered,
    Scene,
    Target,
)

VARIANTS = ('avx512', 'avx2', 'base')
"""Builds of the one source, best first."""


def load_module(variant: str) -> ModuleType | None:
    """Import a build, or return None where it is missing or the processor cannot run it."""
    try:
        base = importlib.import_module('bdgs_ros._rasterizer_base')
        if not base.supports(variant):
            return None
        return importlib.import_module(f'bdgs_ros._rasterizer_{variant}')
    except ImportError:
        return None


class NativeBackend:
    """One build; each Python thread has its own workspace, so calls may run side by side."""

    def __init__(self, module: ModuleType) -> None:
        self._module = module
        self._local = threading.local()

    @property
    def workspace(self) -> Any:
        """The calling thread's `Rasterizer`, which keeps its buffers between calls."""
        if not hasattr(self._local, 'rasterizer'):
            self._local.rasterizer = self._module.Rasterizer()
        return self._local.rasterizer

    def render(self, scene: Scene, statistics: bool) -> Rendered:
        """Render `scene`."""
        images = _empty_images(scene)
        count = len(scene.gaussians)
        extra = tuple(np.empty(count, np.float32) for _ in range(3)) if statistics else None
        self.workspace.render(*_arguments(scene), images, extra)
        return Rendered(*images, *(extra or ()))

    def backward(self, scene: Scene, dL_dimages: tuple[Array, Array, Array]) -> Gradients:
        """Return derivatives, given those by color, depth and silhouette."""
        arrays = _empty_gradients(len(scene.gaussians))
        pose = self.workspace.backward(*_arguments(scene), *dL_dimages, arrays)
        return Gradients.of(arrays[:5], pose)

    def fused_step(
        self, scene: Scene, target: Target, weights: LossWeights, with_images: bool
    ) -> FusedResult:
        """Render, compare and differentiate."""
        arrays = _empty_gradients(len(scene.gaussians))
        images = _empty_images(scene) if with_images else None
        *terms_found, d_log_gain, d_offset, pose = self.workspace.fused_step(
            *_arguments(scene),
            target.color,
            target.depth,
            target.weight,
            weights.factors(),
            target.exposure,
            arrays,
            images,
        )
        loss, l1, ssim, depth, smooth, empty = terms_found
        return FusedResult(
            loss,
            l1,
            ssim,
            depth,
            Gradients.of(arrays[:5], pose),
            np.array([d_log_gain, d_offset], np.float32),
            arrays[5],
            Rendered(*images) if images else None,
            smooth,
            empty,
        )

    def adam_steps(
        self,
        groups: Sequence[AdamGroup],
        rows: NDArray[np.bool_] | None,
        constants: AdamConstants,
        threads: int,
    ) -> None:
        """Make one step of Adam in place; groups have the same number of rows."""
        mask = None if rows is None else rows.view(np.uint8)
        self._module.adam_steps([tuple(g) for g in groups], *constants, mask, threads)


def _arguments(scene: Scene) -> tuple[Any, ...]:
    camera = scene.camera
    return (
        scene.gaussians.arrays(),
        None if scene.active is None else scene.active.view(np.uint8),
        camera.width,
        camera.height,
        (camera.fx, camera.fy, camera.cx, camera.cy),
        scene.T_camera_world.ravel(),
        scene.threads,
    )


def _empty_images(scene: Scene) -> tuple[Array, Array, Array, Array]:
    shape = scene.camera.shape
    color = np.empty((*shape, 3), np.float32)
    return (color, *(np.empty(shape, np.float32) for _ in range(3)))  # type: ignore[return-value]


def _empty_gradients(count: int) -> tuple[Array, ...]:
    """Means, quats, log_scales, logit_opacities, colors and visibility."""
    shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3), (count,))
    return tuple(np.empty(shape, np.float32) for shape in shapes)
