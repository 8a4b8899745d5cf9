"""The map's parameters on a card, and what of them is copied to numpy when something reads it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bdgs_ros.mapping.cuda.kernels import Device
from bdgs_ros.mapping.harmonics import monomials
from bdgs_ros.mapping.parameters import PARAMETERS, RASTERISED, HostParameters, Rows
from bdgs_ros.mapping.rasterize_types import Array


class DeviceParameters:
    """
    Arrays and their moments as tensors: `Parameters` where the map lives on a card.

    What is read as numpy's is copied once and stays until the card changes it; it is read-only,
    for a change of the copy would be lost.

    Parameters
    ----------
    host : HostParameters
        What to begin with.
    device : Device
        Where.

    """

    def __init__(self, host: HostParameters, device: Device) -> None:
        self._device = device
        self.values = {name: device.tensor(host[name]) for name in PARAMETERS}
        self.moments = {
            name: [device.tensor(m) for m in host.moments[name]] for name in PARAMETERS
        }
        self._copies: dict[str, Array] = {}

    def __getitem__(self, name: str) -> Array:
        """Return a copy, to be read."""
        if name not in self._copies:
            self._keep_copy(name, self.values[name].cpu().numpy().copy())
        return self._copies[name]

    def __setitem__(self, name: str, array: Array) -> None:
        """Replace an array by one of the same shape."""
        self.values[name] = self._device.tensor(np.asarray(array, np.float32))
        self._keep_copy(name, np.array(array, np.float32))

    def _keep_copy(self, name: str, copy: Array) -> None:
        copy.flags.writeable = False
        self._copies[name] = copy

    def changed(self) -> None:
        """Forget the copies: the card has changed the tensors in place."""
        self._copies.clear()

    def rasterised(self) -> dict[str, Any]:
        """Return the tensors that are drawn."""
        return {name: self.values[name] for name in RASTERISED}

    def shading(self, T_camera_world: NDArray[np.float64], threads: int) -> DeviceShading | None:
        """Return how a camera sees the colours."""
        if self.values['harmonics'].shape[1] == 0:
            return None
        centre = -T_camera_world[:3, :3].T @ T_camera_world[:3, 3]
        return DeviceShading(self, self._device.tensor(centre.astype(np.float32)))

    def append(self, blocks: Mapping[str, Array]) -> None:
        """Add rows."""
        added = {n: self._device.tensor(np.asarray(blocks[n], np.float32)) for n in PARAMETERS}
        self._join(added)
        for name, copy in self._copies.items():
            self._keep_copy(name, np.concatenate([copy, np.asarray(blocks[name], np.float32)]))

    def copy(self, rows: Rows) -> None:
        """Add copies of rows."""
        at = self._device.tensor(rows)
        self._join({name: self.values[name][at] for name in PARAMETERS})
        self.changed()

    def _join(self, added: Mapping[str, Tensor]) -> None:
        for name, block in added.items():
            self.values[name] = torch.cat([self.values[name], block])
            nothing = torch.zeros_like(block)
            self.moments[name] = [torch.cat([m, nothing]) for m in self.moments[name]]

    def take(self, rows: Rows) -> None:
        """Keep these rows."""
        at = self._device.tensor(rows)
        for name in PARAMETERS:
            self.values[name] = self.values[name][at]
            self.moments[name] = [m[at] for m in self.moments[name]]
        for name, copy in self._copies.items():
            self._keep_copy(name, copy.take(rows, axis=0))

    def pool(self, values: Mapping[str, Array], leader: Rows) -> None:
        """Replace all."""
        at = self._device.tensor(leader)
        for name in PARAMETERS:
            self[name] = values[name]
            self.moments[name] = [m[at] for m in self.moments[name]]

    def reset(self, name: str, array: Array) -> None:
        """Replace an array and its moments."""
        self[name] = array
        self.moments[name] = [torch.zeros_like(self.values[name]) for _ in range(2)]


class DeviceShading:
    """
    `bdgs_ros.mapping.harmonics.Shading` on a card.

    Parameters
    ----------
    parameters : DeviceParameters
        With harmonics.
    centre : Tensor, shape (3,)
        Of the camera in world, metres.

    """

    def __init__(self, parameters: DeviceParameters, centre: Tensor) -> None:
        harmonics = parameters.values['harmonics']
        self._blocks = harmonics.view(len(harmonics), 3, -1)
        offsets = (parameters.values['means'] - centre).T
        distance = offsets.norm(dim=0).clamp_min(1e-6)
        self._basis = _basis(offsets / distance, self._blocks.shape[2])

    def colors(self, constant: Tensor, rows: NDArray[np.bool_] | Tensor) -> Tensor:
        """Return c(d), [N, 3]; those that are not drawn may get any."""
        return (constant + torch.einsum('nk,nck->nc', self._basis, self._blocks)).contiguous()

    def gradient(self, by_color: Tensor) -> Tensor:
        """Return dL/dc_k = Y_k dL/dc, [N, 3 K]."""
        return (by_color[:, :, None] * self._basis[:, None, :]).reshape(len(by_color), -1)


def _basis(directions: Tensor, count: int) -> Tensor:
    """Return the first `count` functions of unit vectors, shape (3, N), as columns, [N, K]."""
    names, coefficients = monomials(count)
    values = {'': torch.ones_like(directions[0])}
    for name in names[1:]:
        values[name] = values[name[:-1]] * directions['xyz'.index(name[-1])]
    table = torch.from_numpy(coefficients).to(directions)
    return torch.stack([values[name] for name in names], dim=1) @ table
