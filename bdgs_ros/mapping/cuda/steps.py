"""One step of Eq. 7 on one view, where all that it needs lies on a card."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bdgs_ros.core import se3
from bdgs_ros.core.config import MappingConfig
from bdgs_ros.mapping.cuda.images import Images
from bdgs_ros.mapping.cuda.kernels import EXPOSURE, POSE, Device, address, view_state
from bdgs_ros.mapping.cuda.store import DeviceParameters, DeviceShading
from bdgs_ros.mapping.densify import Pull, strongest
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.keyframes import MapKeyframe, Window
from bdgs_ros.mapping.parameters import RASTERISED, HostParameters
from bdgs_ros.mapping.steps import learning_rates, least_logit, loss_weights, penalised_by

_FIRST, _SECOND = slice(16, 22), slice(22, 28)  # of a view's state: moments of its pose
_E_FIRST, _E_SECOND = slice(30, 32), slice(32, 34)  # and of its exposure
_BETAS = (0.9, 0.999)


class CudaSteps:
    """
    `bdgs_ros.mapping.steps.Steps` on a card: between `begin` and `end` nothing crosses the bus.

    Parameters
    ----------
    config : MappingConfig
        Weights and rates.
    device : Device
        The card.

    """

    def __init__(self, config: MappingConfig, device: Device) -> None:
        self._config = config
        self._device = device
        self._weights = loss_weights(config).factors()
        self._rates = tuple(learning_rates(config).values())
        self._images = Images(device)
        self._mirror = _Mirror(device)
        self._pull: _DevicePull | None = None
        self._results: list[Tensor] = []

    def begin(self, gaussians: GaussianMap, keyframes: Sequence[MapKeyframe]) -> None:
        """Take a map, which moves to the card if it is not there, and views of it."""
        if isinstance(gaussians.parameters, HostParameters):
            gaussians.parameters = DeviceParameters(gaussians.parameters, self._device)
        assert isinstance(gaussians.parameters, DeviceParameters)
        self._parameters = gaussians.parameters
        visible, penalised = penalised_by(gaussians)
        self._visible = self._mirror.of('visible', visible)
        self._penalised = self._mirror.of('penalised', penalised)
        self._p_dynamic = self._mirror.of('p_dynamic', gaussians.p_dynamic)
        self._keyframes = list(dict.fromkeys(keyframes))
        states = [_state(self._device, k) for k in self._keyframes]
        self._states = self._device.tensor(np.stack(states))
        self._row = {id(k): row for row, k in enumerate(self._keyframes)}
        self._results = []

    def take(
        self,
        keyframe: MapKeyframe,
        level_index: int,
        window: Window | None,
        *,
        rate_scale: float = 1.0,
        pose_scale: float = 1.0,
    ) -> None:
        """Take a step."""
        device, parameters, config = self._device, self._parameters, self._config
        level = keyframe.levels[level_index]
        camera = level.camera if window is None else level.cut(window).camera
        state = self._states[self._row[id(keyframe)]]
        shading = self._shading(state)
        values = list(parameters.rasterised().values())
        shown = list(values)
        if shading is not None:
            shown[4] = shading.colors(values[4], self._visible)
        least = least_logit(config, level_index)
        device.look([*shown, self._p_dynamic], self._visible, camera, state, min_logit=least)
        by_color, visibility = self._wanted(shading)
        result = device.zeros(device.results, dtype=torch.float64)
        per_pixel = 1 / (camera.width * camera.height)
        target, stride = self._images.target(level, window)
        first, second = zip(*(parameters.moments[name] for name in RASTERISED), strict=True)
        pull = self._pull
        device.rasterizer.step(
            target,
            stride,
            self._weights,
            [*map(address, values)],
            [*map(address, first)],
            [*map(address, second)],
            tuple(rate_scale * rate for rate in self._rates),
            (config.loss.dynamic * per_pixel, config.loss.reg * per_pixel),
            [
                address(self._penalised),
                address(by_color),
                address(pull.sums if pull else None),
                address(pull.views if pull else None),
                address(visibility),
            ],
            address(state),
            self._view_rates(keyframe, rate_scale, pose_scale),
            address(result),
        )
        self._results.append(result)
        if shading is not None and by_color is not None and visibility is not None:
            self._adapt_shading(shading, by_color, visibility > 0, rate_scale)

    def _view_rates(
        self, keyframe: MapKeyframe, rate_scale: float, pose_scale: float
    ) -> tuple[float, float]:
        """Return the rates of pose and exposure; the first keyframe defines world and exposure."""
        if keyframe.index == 0:
            return -1.0, 0.0
        rate = self._config.rate
        return pose_scale * rate.pose, rate_scale * rate.exposure

    def losses(self) -> list[float]:
        """Return the losses since `begin`."""
        if not self._results:
            return []
        return [float(loss) for loss in torch.stack(self._results)[:, 0].cpu()]

    def end(self) -> None:
        """Bring poses and exposures of the keyframes up to date."""
        self._parameters.changed()
        for keyframe, state in zip(self._keyframes, self._states.cpu().numpy(), strict=True):
            if keyframe.index != 0:
                _bring_back(keyframe, state)

    def gather(self, count: int | None) -> Pull | None:
        """Gather how Gaussians are pulled."""
        self._pull = None if count is None else _DevicePull(self._device, count)
        return self._pull

    def _shading(self, state: Tensor) -> DeviceShading | None:
        if self._parameters.values['harmonics'].shape[1] == 0:
            return None
        T = state[POSE].view(4, 4)
        return DeviceShading(self._parameters, (-T[:3, :3].T @ T[:3, 3]).float())

    def _wanted(self, shading: DeviceShading | None) -> tuple[Tensor | None, Tensor | None]:
        """Return room for what the shading is fitted with, if there is any."""
        if shading is None:
            return None, None
        count = len(self._p_dynamic)
        return self._device.zeros(count, 3), self._device.zeros(count)

    def _adapt_shading(
        self, shading: DeviceShading, by_color: Tensor, seen: Tensor, rate_scale: float
    ) -> None:
        """Fit what depends on the direction; only where it is seen, the rest stays as it is."""
        harmonics = self._parameters.values['harmonics']
        first, second = self._parameters.moments['harmonics']
        gradient, rows = shading.gradient(by_color), seen[:, None]
        m = _BETAS[0] * first + (1 - _BETAS[0]) * gradient
        v = _BETAS[1] * second + (1 - _BETAS[1]) * gradient**2
        step = rate_scale * self._config.rate.harmonics * m / (v.sqrt() + 1e-15)
        first.copy_(torch.where(rows, m, first))
        second.copy_(torch.where(rows, v, second))
        harmonics.copy_(torch.where(rows, harmonics - step, harmonics))


class _Mirror:
    """Copies on the card of numpy's arrays, renewed where these have changed."""

    def __init__(self, device: Device) -> None:
        self._device = device
        self._held: dict[str, tuple[NDArray[Any], Tensor]] = {}

    def of(self, name: str, array: NDArray[Any]) -> Tensor:
        """Return `array` on the card."""
        held = self._held.get(name)
        if held is None or not np.array_equal(held[0], array):
            self._held[name] = array.copy(), self._device.tensor(array)
        return self._held[name][1]


class _DevicePull:
    """`bdgs_ros.mapping.densify.PositionalGradient` on a card."""

    def __init__(self, device: Device, count: int) -> None:
        self.sums = device.zeros(count)
        self.views = device.zeros(count)

    def strongest(self, count: int) -> NDArray[np.int64]:
        """Return the `count` Gaussians that were pulled most, fewer if fewer were seen."""
        return strongest((self.sums / self.views.clamp_min(1)).cpu().numpy(), count)


def _state(device: Device, keyframe: MapKeyframe) -> NDArray[np.float64]:
    exposure = keyframe.exposure.astype(float).tolist()
    state = view_state(device.view_state, keyframe.T_camera_world, exposure)
    state[_FIRST], state[_SECOND] = keyframe.pose_moments
    state[_E_FIRST], state[_E_SECOND] = keyframe.exposure_moments
    return state


def _bring_back(keyframe: MapKeyframe, state: NDArray[np.float64]) -> None:
    T_camera_world = state[POSE].reshape(4, 4)
    if not np.array_equal(T_camera_world, keyframe.T_camera_world):
        keyframe.T_world_camera = se3.orthonormalise(se3.inverse(T_camera_world))
    keyframe.exposure = state[EXPOSURE].astype(np.float32)
    keyframe.pose_moments = [state[_FIRST].astype(np.float32), state[_SECOND].astype(np.float32)]
    keyframe.exposure_moments = [
        state[_E_FIRST].astype(np.float32),
        state[_E_SECOND].astype(np.float32),
    ]
