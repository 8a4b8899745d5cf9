"""Images of keyframes on the card, copied there once and forgotten with the keyframe."""

from __future__ import annotations

import weakref
from typing import Any

from numpy.typing import NDArray
from torch import Tensor

from bdgs_ros.mapping.cuda.kernels import Device, address
from bdgs_ros.mapping.keyframes import Level, Window


class Images:
    """
    What the kernels compare with.

    Parameters
    ----------
    device : Device
        Where the copies are.

    """

    def __init__(self, device: Device) -> None:
        self._device = device
        self._copies: dict[int, Tensor] = {}
        self._scales: dict[Any, Tensor] = {}

    def target(self, level: Level, window: Window | None) -> tuple[list[int], int]:
        """
        Return the addresses of (a window of) an image, and the pixels from row to row.

        They are colour as floats, which are not used, eight-bit colour, its scale, depth, weight
        as floats, not used, and what is static.
        """
        corner = (0, 0) if window is None else (window.rows.start, window.columns.start)
        given: tuple[NDArray[Any], ...] = (level.image, level.depth_m, level.static)
        image, depth, static = (self._copy(a) for a in given)
        at = [_from(t, corner) for t in (image, self._scale(level), depth, static)]
        return [0, at[0], at[1], at[2], 0, at[3]], level.camera.width

    def _copy(self, array: NDArray[Any]) -> Tensor:
        """Return an image on the card; arrays of keyframes are never changed in place."""
        key = id(array)
        if key not in self._copies:
            self._copies[key] = self._device.tensor(array)
            weakref.finalize(array, self._copies.pop, key, None)
        return self._copies[key]

    def _scale(self, level: Level) -> Tensor:
        """Return what brings eight-bit colours to [0, 1] without the lens's falloff, [H, W]."""
        key = level.camera, level.vignette.coefficients
        if key not in self._scales:
            for old in [k for k in self._scales if k[0] == level.camera]:
                del self._scales[old]
            self._scales[key] = self._device.tensor(level.vignette.scale(level.camera)[..., 0])
        return self._scales[key]


def _from(image: Tensor, corner: tuple[int, int]) -> int:
    """Return the address of a pixel."""
    row, column = corner
    pixel = row * image.shape[1] + column
    channels = image.shape[2] if image.dim() == 3 else 1
    return address(image) + pixel * channels * image.element_size()
