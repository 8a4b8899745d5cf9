"""
The smooth functions of which the bend of a depth sensor is made.

    1 / z_true = 1 / z + sum_k c_k q_k(x, y)        x, y: tangents of the viewing ray

The mapper learns the `c_k` from depth alone, the back end together with poses. A constant is left
out of `q`: pairs of views say little about it, and it would scale the world.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera

BENDS = 5
"""How many functions there are."""
_HALF_WIDTH = 0.5  # tangent at which the functions are about 1


def bend_functions(tangents: NDArray[np.floating]) -> NDArray[np.float64]:
    """
    Return the functions q_k at viewing rays.

    Parameters
    ----------
    tangents : ndarray, shape (N, 2)
        (x, y) of rays with z = 1.

    Returns
    -------
    functions : ndarray, shape (N, 5)

    """
    x, y = tangents.T / _HALF_WIDTH
    return np.stack([x, y, x * x, x * y, y * y], axis=1)


@lru_cache(maxsize=32)
def inverse_depth_bend(
    camera: PinholeCamera, coefficients: tuple[float, ...]
) -> NDArray[np.float32]:
    """Return the sum of all c_k q_k at every pixel, [H, W], 1/m: what inverse depth lacks."""
    x = ((np.arange(camera.width) - camera.cx) / (camera.fx * _HALF_WIDTH)).astype(np.float32)
    y = ((np.arange(camera.height) - camera.cy) / (camera.fy * _HALF_WIDTH)).astype(np.float32)
    cx, cy, cxx, cxy, cyy = np.array(coefficients, np.float32)
    image: NDArray[np.float32] = (
        (cy * y + cyy * y * y)[:, None] + (cx * x + cxx * x * x) + np.outer(cxy * y, x)
    )
    image.setflags(write=False)
    return image
