"""
The rasteriser of `src/cuda` behind the `Backend` protocol.

Arrays of the scene may be numpy's, which are copied to the card, or tensors that live there. What
comes back is numpy's: this is for views of the map; its optimisation (`steps`) leaves all there.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from bdgs_ros.mapping.cuda.kernels import Device, address, view_state
from bdgs_ros.mapping.rasterize_types import (
    Array,
    FusedResult,
    Gradients,
    LossWeights,
    Rendered,
    Scene,
    Target,
)

_PLANES = 6


class CudaBackend:
    """
    Renders on a card.

    Parameters
    ----------
    device : Device
        Where.

    """

    def __init__(self, device: Device) -> None:
        self.device = device

    def render(self, scene: Scene, statistics: bool) -> Rendered:
        """Render `scene`."""
        count = len(scene.gaussians)
        extra = [self.device.zeros(count) for _ in range(3)] if statistics else []
        planes = self._look(scene, radius=extra[2] if extra else None)
        if extra:
            self.device.rasterizer.statistics(address(extra[0]), address(extra[1]))
        return _rendered(planes, *map(_to_numpy, extra))

    def backward(self, scene: Scene, dL_dimages: tuple[Array, Array, Array]) -> Gradients:
        """Return derivatives, given those by color, depth and silhouette."""
        self._look(scene)
        color, depth, silhouette = map(self.device.tensor, dL_dimages)
        nothing = torch.zeros_like(depth)
        given = torch.stack([*color.unbind(2), depth, silhouette, nothing]).contiguous()
        gradients, result = self._room(len(scene.gaussians))
        self.device.rasterizer.backward(
            address(given), [*map(address, gradients)], address(result)
        )
        return Gradients.of([_to_numpy(g) for g in gradients[:5]], result.cpu().numpy()[8:14])

    def fused_step(
        self, scene: Scene, target: Target, weights: LossWeights, with_images: bool
    ) -> FusedResult:
        """Render, compare and differentiate."""
        planes = self._look(scene, target.exposure)
        given = [self.device.tensor(a) for a in (target.color, target.depth, target.weight)]
        color, depth, weight = map(address, given)
        gradients, result = self._room(len(scene.gaussians))
        self.device.rasterizer.compare(
            [color, 0, 0, depth, weight, 0],
            scene.camera.width,
            weights.factors(),
            [*map(address, gradients)],
            address(result),
        )
        found = result.cpu().numpy()
        loss, l1, ssim, depth_error, smooth, empty = found[:6].tolist()
        *arrays, visibility = map(_to_numpy, gradients)
        return FusedResult(
            loss,
            l1,
            ssim,
            depth_error,
            Gradients.of(arrays, found[8:14]),
            found[6:8].astype(np.float32),
            visibility,
            _rendered(planes) if with_images else None,
            smooth,
            empty,
        )

    def _look(
        self,
        scene: Scene,
        exposure: tuple[float, float] = (0.0, 0.0),
        radius: Tensor | None = None,
    ) -> Tensor:
        """Render, and return the images, [6, H, W]."""
        device, camera = self.device, scene.camera
        planes = device.zeros(_PLANES, *camera.shape)
        state = device.tensor(view_state(device.view_state, scene.T_camera_world, exposure))
        active = None if scene.active is None else device.tensor(scene.active)
        arrays = [device.tensor(a) for a in scene.gaussians.arrays()]
        device.look(arrays, active, camera, state, planes=planes, radius=radius)
        self._held = arrays, active, state, planes  # the kernels go on with their addresses
        return planes

    def _room(self, count: int) -> tuple[list[Tensor], Tensor]:
        """Return where gradients and visibility go, and the loss with its terms."""
        shapes = ((count, 3), (count, 4), (count, 3), (count,), (count, 3), (count,))
        gradients = [self.device.zeros(*shape) for shape in shapes]
        return gradients, self.device.zeros(self.device.results, dtype=torch.float64)


def _to_numpy(tensor: Tensor) -> Array:
    return tensor.cpu().numpy()


def _rendered(planes: Tensor, *statistics: Array) -> Rendered:
    a = planes.cpu().numpy()
    color = np.ascontiguousarray(np.moveaxis(a[:3], 0, 2))
    return Rendered(color, *a[3:], *statistics)
