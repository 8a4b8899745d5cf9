"""What the rasteriser takes and gives, whichever backend does the work."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera

Array = NDArray[np.float32]
Pose = NDArray[np.float64]  # [4, 4]


@dataclass(frozen=True)
class Gaussians:
    """The parameters of N Gaussians."""

    means: Array  # [N, 3] metres in world
    quats: Array  # [N, 4] wxyz, of any length but zero
    log_scales: Array  # [N, 3] natural logarithm of metres
    logit_opacities: Array  # [N]
    colors: Array  # [N, 3] RGB, nominally in [0, 1]
    p_dynamic: Array  # [N] rendered as one more channel; gets no gradient

    def __len__(self) -> int:
        """Return N."""
        return len(self.means)

    def arrays(self) -> tuple[Array, ...]:
        """Return the six arrays in the order of the fields."""
        return (
            self.means,
            self.quats,
            self.log_scales,
            self.logit_opacities,
            self.colors,
            self.p_dynamic,
        )


@dataclass(frozen=True)
class Rendered:
    """
    One view of the Gaussians on black; the last three fields only if statistics were asked for.

    Depth and p_dynamic are sums of weights times values: divide by `silhouette` for means. The
    depth of a Gaussian is the mean of its z given the pixel, not the z of its centre.
    """

    color: Array  # [H, W, 3] RGB
    depth: Array  # [H, W] metres times silhouette
    silhouette: Array  # [H, W] sum of weights, in [0, 1]
    p_dynamic: Array  # [H, W] probability times silhouette
    visibility: Array | None = None  # [N] sum of a Gaussian's weights over all pixels
    max_weight: Array | None = None  # [N] the largest of them
    radius: Array | None = None  # [N] half the longer side of its box in px; 0 = not in view


@dataclass(frozen=True)
class Gradients:
    """Derivatives of a loss; shapes as in `Gaussians`."""

    means: Array
    quats: Array
    log_scales: Array
    logit_opacities: Array
    colors: Array
    pose: NDArray[np.float64]
    """[6] (rho, phi): the derivative at xi = 0 of T_camera_world <- exp(xi) T_camera_world."""

    @classmethod
    def of(cls, arrays: Sequence[Array], pose: NDArray[np.float64]) -> Gradients:
        """Assemble from the five arrays that `parameters` returns."""
        means, quats, log_scales, logit_opacities, colors = arrays
        return cls(means, quats, log_scales, logit_opacities, colors, pose)

    def parameters(self) -> tuple[Array, Array, Array, Array, Array]:
        """Return the gradients of the optimised arrays, in the order of `Gaussians`."""
        return self.means, self.quats, self.log_scales, self.logit_opacities, self.colors


@dataclass(frozen=True)
class LossWeights:
    """
    How the terms of a view's loss add up.

    loss = color * [(1 - ssim) * L1 + ssim * (1 - SSIM)] + depth * L_depth + smooth * L_smooth
    + empty * L_empty; `color` is lambda_psim of Eq. 7, `ssim` gamma of Eq. 9 and `smooth` the
    weight of the first term of Eq. 8, whose edge-aware form `rasterize_torch.smoothness` defines.
    L_empty is the mean of 1 - silhouette where the camera measured a surface.
    """

    color: float
    ssim: float
    depth: float
    smooth: float = 0.0
    empty: float = 0.0

    def factors(self) -> tuple[float, float, float, float, float]:
        """Return the factors of the terms as kernels take them: L1, 1 - SSIM, depth, ..."""
        return (
            self.color * (1 - self.ssim),
            self.color * self.ssim,
            self.depth,
            self.smooth,
            self.empty,
        )


@dataclass(frozen=True)
class FusedResult:
    """One view's loss with all its derivatives."""

    loss: float
    l1: float
    """Mean absolute colour error over the weighted pixels, unweighted by `LossWeights`."""
    ssim: float
    """Mean of 1 - SSIM."""
    depth: float
    """Mean absolute depth error in metres."""
    gradients: Gradients
    exposure_gradient: Array
    """[2]: by log_gain and by offset."""
    visibility: Array
    """[N] sum of a Gaussian's weights over the pixels; 0 = this view says nothing about it."""
    rendered: Rendered | None = None
    """Before exposure; only if asked for."""
    smooth: float = 0.0
    """Mean departure of depth from planes in metres, edges left out; 0 if not weighted."""
    empty: float = 0.0
    """Mean of 1 - silhouette where depth was measured."""


@dataclass(frozen=True)
class Target:
    """What a view should look like."""

    color: Array  # [H, W, 3]
    depth: Array  # [H, W] metres, 0 = unknown
    weight: Array  # [H, W] 0 = this pixel does not count at all
    exposure: tuple[float, float]  # (log_gain, offset): exp(log_gain) * rendered + offset


@dataclass(frozen=True)
class Scene:
    """Checked input of every backend call."""

    gaussians: Gaussians
    active: NDArray[np.bool_] | None  # [N]
    T_camera_world: Pose
    camera: PinholeCamera
    threads: int


class AdamGroup(NamedTuple):
    """An array that Adam changes, with all it needs; arrays have the shape of `params`."""

    params: Array
    """[N, ...]; changed, like its moments."""
    grads: Array
    """Gradient by `params`."""
    first: Array
    second: Array
    rate: float
    """Step size."""


class AdamConstants(NamedTuple):
    """What all arrays of a step share."""

    step: int
    """Number of this step from 1; 0 leaves the correction of the moments' bias out."""
    betas: tuple[float, float]
    eps: float


class Backend(Protocol):
    """One way to rasterise; arguments are already checked."""

    def render(self, scene: Scene, statistics: bool) -> Rendered:
        """Render `scene`."""

    def backward(self, scene: Scene, dL_dimages: tuple[Array, Array, Array]) -> Gradients:
        """Return derivatives, given those by color, depth and silhouette."""

    def fused_step(
        self, scene: Scene, target: Target, weights: LossWeights, with_images: bool
    ) -> FusedResult:
        """Render, compare and differentiate."""


def expect_shape(name: str, array: Any, shape: Sequence[int]) -> None:
    """Raise ValueError naming the argument unless `array` has `shape`."""
    if tuple(array.shape) != tuple(shape):
        raise ValueError(f'{name}: expected shape {tuple(shape)}, received {array.shape}')


def on_card(name: str, array: Any, shape: Sequence[int]) -> Any:
    """Return a tensor as it is, and anything else by `as_float32`; refuse another shape."""
    if isinstance(array, np.ndarray):
        return as_float32(name, array, shape)
    expect_shape(name, array, shape)
    return array


def as_float32(name: str, array: Any, shape: Sequence[int]) -> Array:
    """Return `array` as rows of float32, copied only if it is not; refuse another shape."""
    expect_shape(name, array, shape)
    if not isinstance(array, np.ndarray):  # a tensor, perhaps of a card
        array = array.detach().cpu().numpy()
    return np.ascontiguousarray(array, dtype=np.float32)
