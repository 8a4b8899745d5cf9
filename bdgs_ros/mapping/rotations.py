"""Rotations of many Gaussians at once: quaternions wxyz and matrices whose columns are axes."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]


def quats_from_axes(axes: Array) -> Array:
    """
    Return the unit quaternions of rotation matrices.

    Parameters
    ----------
    axes : ndarray, shape (M, 3, 3)
        Right-handed orthonormal axes as columns.

    Returns
    -------
    quats : ndarray, shape (M, 4)
        wxyz.

    """
    xx, yy, zz = axes[:, 0, 0], axes[:, 1, 1], axes[:, 2, 2]
    skew_x, skew_y, skew_z = (axes[:, i, j] - axes[:, j, i] for i, j in ((2, 1), (0, 2), (1, 0)))
    xy, xz, yz = (axes[:, i, j] + axes[:, j, i] for i, j in ((0, 1), (0, 2), (1, 2)))
    # Each row i is 4 q_i q; the one with the largest q_i is safe to divide by.
    rows = np.stack(
        [
            np.stack([1 + xx + yy + zz, skew_x, skew_y, skew_z], axis=1),
            np.stack([skew_x, 1 + xx - yy - zz, xy, xz], axis=1),
            np.stack([skew_y, xy, 1 - xx + yy - zz, yz], axis=1),
            np.stack([skew_z, xz, yz, 1 - xx - yy + zz], axis=1),
        ],
        axis=1,
    )
    best = np.argmax(np.einsum('mii->mi', rows), axis=1)
    return normalised(rows[np.arange(len(rows)), best])


def axes_from_quats(quats: Array) -> Array:
    """Return the rotation matrices, shape (M, 3, 3), of quaternions wxyz of any length."""
    w, x, y, z = normalised(quats).T
    rows = [
        [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
        [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
        [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
    ]
    return np.stack([np.stack(row, axis=1) for row in rows], axis=1)


def multiply(a: Array, b: Array) -> Array:
    """Return the Hamilton products `a b`, shape (M, 4): first turn by `b`, then by `a`."""
    w, v = a[:, :1], a[:, 1:]
    u, r = b[:, :1], b[:, 1:]
    real = w * u - np.einsum('mi,mi->m', v, r)[:, None]
    return np.concatenate([real, w * r + u * v + np.cross(v, r)], axis=1).astype(np.float32)


def normalised(quats: Array) -> Array:
    """Return quaternions scaled to unit length."""
    return np.asarray(quats / np.linalg.norm(quats, axis=1, keepdims=True), np.float32)
