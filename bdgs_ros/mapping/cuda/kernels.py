"""The compiled kernels of `src/cuda`, and what they are handed: addresses of torch's tensors."""

from __future__ import annotations

import importlib
import logging
import threading
from collections.abc import Sequence
from functools import lru_cache
from importlib.util import find_spec
from types import ModuleType
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import MapError
from bdgs_ros.core.types import Pose

MODULE = 'bdgs_ros._rasterizer_cuda'
POSE, EXPOSURE = slice(0, 16), slice(28, 30)  # of a view's state: `ViewState` in update.cuh

_log = logging.getLogger(__name__)


def is_built() -> bool:
    """Return whether the kernels were compiled; imports nothing."""
    return find_spec(MODULE) is not None


def obstacle() -> str | None:
    """Return why the kernels cannot run here, or None if they can."""
    if not is_built():
        return 'the kernels were not compiled: install a CUDA toolkit (nvcc), then bdgs_ros again'
    if not torch.cuda.is_available():
        return 'torch sees no CUDA device'
    return None


class Device:
    """
    Where the map lives, and the kernels that run there.

    Parameters
    ----------
    module : module, optional
        With `Rasterizer`. By default the compiled kernels.
    name : str
        Of the torch device.

    Raises
    ------
    MapError
        If the kernels cannot run.

    """

    def __init__(self, module: ModuleType | None = None, name: str = 'cuda') -> None:
        self.torch = torch.device(name)
        self._module = module or importlib.import_module(MODULE)
        self._local = threading.local()
        try:
            self.tensor(np.zeros(1, np.float32))
            _ = self.rasterizer
        except RuntimeError as error:
            raise MapError(f'the CUDA kernels cannot run on {name}: {error}') from error
        card = torch.cuda.get_device_name(self.torch) if self.torch.type == 'cuda' else name
        _log.info('the map lives on %s', card)

    @property
    def rasterizer(self) -> Any:
        """The calling thread's `Rasterizer`, which keeps its buffers between calls."""
        if not hasattr(self._local, 'rasterizer'):
            self._local.rasterizer = self._module.Rasterizer()
        return self._local.rasterizer

    @property
    def stream(self) -> int:
        """What torch's work of this thread is queued on, as a number."""
        if self.torch.type != 'cuda':
            return 0
        return int(torch.cuda.current_stream(self.torch).cuda_stream)

    @property
    def results(self) -> int:
        """How many numbers a step leaves; see `Result` in src/cuda/update.cuh."""
        return int(self._module.RESULTS)

    @property
    def view_state(self) -> int:
        """How many numbers a view is optimised with; see `ViewState` in src/cuda/update.cuh."""
        return int(self._module.VIEW_STATE)

    def tensor(self, array: NDArray[Any] | Tensor) -> Tensor:
        """Return a copy of an array on the device, in rows; a tensor that is there as it is."""
        if isinstance(array, Tensor):
            return array
        return torch.from_numpy(np.ascontiguousarray(array)).to(self.torch, copy=True)

    def zeros(self, *shape: int, dtype: torch.dtype = torch.float32) -> Tensor:
        """Return zeros on the device."""
        return torch.zeros(shape, dtype=dtype, device=self.torch)

    def look(
        self,
        arrays: Sequence[Tensor],
        active: Tensor | None,
        camera: PinholeCamera,
        state: Tensor,
        *,
        min_logit: float = -np.inf,
        planes: Tensor | None = None,
        radius: Tensor | None = None,
    ) -> None:
        """
        Render: what every other call of `rasterizer` goes on from.

        Parameters
        ----------
        arrays : sequence of Tensor
            The six arrays of `Gaussians`.
        active : Tensor of bool, shape (N,), optional
            Others are not drawn, nor those whose logit opacity is below `min_logit`.
        camera : PinholeCamera
            Of the view.
        state : Tensor, float64, shape (view_state,)
            Pose and exposure of the view.
        planes : Tensor, shape (6, H, W), optional
            Filled; without it the rasteriser keeps the images to itself.
        radius : Tensor, shape (N,), optional
            Filled.

        """
        self.rasterizer.look(
            [*map(address, arrays), address(active)],
            len(arrays[0]),
            min_logit,
            camera.width,
            camera.height,
            (camera.fx, camera.fy, camera.cx, camera.cy),
            address(state),
            address(planes),
            address(radius),
            self.stream,
        )


@lru_cache(maxsize=1)
def device() -> Device:
    """Return the card of this process."""
    return Device()


def address(tensor: Tensor | None) -> int:
    """Return where a tensor lies; 0 for None."""
    if tensor is None:
        return 0
    if not tensor.is_contiguous():
        raise ValueError('the kernels take arrays in rows')
    return int(tensor.data_ptr())


def view_state(
    size: int, T_camera_world: Pose, exposure: Sequence[float] = (0.0, 0.0)
) -> NDArray[np.float64]:
    """Return a view that has not been optimised yet, shape (size,)."""
    state = np.zeros(size)
    state[POSE] = np.asarray(T_camera_world).ravel()
    state[EXPOSURE] = exposure
    return state
