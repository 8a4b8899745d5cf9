"""What is optimised of every Gaussian, with Adam's moments, where the optimiser works on it."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.mapping.harmonics import Shading, functions
from bdgs_ros.mapping.rasterize_types import Array

Rows = NDArray[np.int64]

RASTERISED = ('means', 'quats', 'log_scales', 'logit_opacities', 'colors')
PARAMETERS = (*RASTERISED, 'harmonics')


class ViewShading(Protocol):
    """How one camera sees the colours; see `bdgs_ros.mapping.harmonics.Shading`."""

    def colors(self, constant: Any, rows: Any) -> Any:
        """Return the colours of the Gaussians that are drawn, [N, 3]."""


class Parameters(Protocol):
    """
    Arrays by the names in `PARAMETERS`, each with first and second moments of its shape.

    Those of `HostParameters` are numpy's; `cuda.store.DeviceParameters` keeps them on a card, and
    copies to numpy what is read here.
    """

    def __getitem__(self, name: str) -> Array:
        """Return an array; to change it, assign the changed one."""

    def __setitem__(self, name: str, array: Array) -> None:
        """Replace an array by one of the same shape; its moments stay."""

    def rasterised(self) -> dict[str, Any]:
        """Return what the rasteriser draws, by the names in `RASTERISED`, without a copy."""

    def shading(self, T_camera_world: NDArray[np.float64], threads: int) -> ViewShading | None:
        """Return how a camera sees the colours; None where they are the same from everywhere."""

    def append(self, blocks: Mapping[str, Array]) -> None:
        """Add rows, with moments of 0."""

    def copy(self, rows: Rows) -> None:
        """Add copies of rows, with moments of 0."""

    def take(self, rows: Rows) -> None:
        """Keep these rows, in this order."""

    def pool(self, values: Mapping[str, Array], leader: Rows) -> None:
        """Replace all by M rows, whose moments are those of the rows `leader`, shape (M,)."""

    def reset(self, name: str, array: Array) -> None:
        """Replace an array by one of any shape, with moments of 0."""


class HostParameters:
    """Numpy's arrays, which the native backend and the torch twin change in place."""

    def __init__(self, degree: int = 0) -> None:
        shapes = ((0, 3), (0, 4), (0, 3), (0,), (0, 3), (0, 3 * functions(degree)))
        self._values: dict[str, Array] = {
            name: np.zeros(shape, np.float32)
            for name, shape in zip(PARAMETERS, shapes, strict=True)
        }
        self.moments = {name: _moments_like(a) for name, a in self._values.items()}
        """First and second moments by name."""

    def __getitem__(self, name: str) -> Array:
        """Return an array; it may be changed in place."""
        return self._values[name]

    def __setitem__(self, name: str, array: Array) -> None:
        """Replace an array by one of the same shape."""
        self._values[name] = np.ascontiguousarray(array, np.float32)

    def rasterised(self) -> dict[str, Any]:
        """Return what the rasteriser draws."""
        return {name: self._values[name] for name in RASTERISED}

    def shading(self, T_camera_world: NDArray[np.float64], threads: int) -> Shading | None:
        """Return how a camera sees the colours."""
        harmonics = self['harmonics']
        if harmonics.shape[1] == 0:
            return None
        return Shading(self['means'], harmonics, T_camera_world, threads=threads)

    def append(self, blocks: Mapping[str, Array]) -> None:
        """Add rows."""
        for name in PARAMETERS:
            block = np.asarray(blocks[name], np.float32)
            self._values[name] = _join(self._values[name], block)
            self.moments[name] = [_join(m, np.zeros_like(block)) for m in self.moments[name]]

    def copy(self, rows: Rows) -> None:
        """Add copies of rows."""
        self.append({name: self._values[name][rows] for name in PARAMETERS})

    def take(self, rows: Rows) -> None:
        """Keep these rows."""
        for name in PARAMETERS:
            self._values[name] = self._values[name].take(rows, axis=0)
            self.moments[name] = [m.take(rows, axis=0) for m in self.moments[name]]

    def pool(self, values: Mapping[str, Array], leader: Rows) -> None:
        """Replace all."""
        for name in PARAMETERS:
            self[name] = values[name]
            self.moments[name] = [m[leader] for m in self.moments[name]]

    def reset(self, name: str, array: Array) -> None:
        """Replace an array and its moments."""
        self[name] = array
        self.moments[name] = _moments_like(array)


def _moments_like(array: Array) -> list[Array]:
    return [np.zeros_like(array), np.zeros_like(array)]


def _join(a: Array, b: Array) -> Array:
    return np.ascontiguousarray(np.concatenate([a, b]))
