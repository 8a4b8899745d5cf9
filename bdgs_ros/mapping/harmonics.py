"""
Colour that depends on where one looks from: real spherical harmonics, as in 3DGS.

Seen along the unit vector d, from the camera's centre to its mean, a Gaussian has the colour

    c(d) = c_0 + sum_k Y_k(d) c_k,    k = 1 .. (degree + 1)^2 - 1

(Kerbl et al. 2023, section 4), where c_0 is the colour that everything else knows it by: the
filter, the point cloud, a map of degree 0. It is computed before the rasteriser, which takes plain
colours, so every backend has it. Nothing is clamped, neither here nor in the rasteriser: a clamp
would stop the gradient where it acts. Viewers clamp each Gaussian's colour at 0.

Order and signs of Y_k are those of 3DGS, so that files agree. The functions are polynomials in x,
y and z: one product of all monomials with a table of coefficients.
"""

from __future__ import annotations

from functools import lru_cache
from importlib import import_module
from itertools import combinations_with_replacement
from math import pi, sqrt
from types import ModuleType

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]

MAX_DEGREE = 3

_kernels: ModuleType | None
try:
    _kernels = import_module('bdgs_ros._harmonics')
except ImportError:
    _kernels = None

# Y_k = factor * sum of coefficients times monomials, k = 1 .. 15
_FUNCTIONS: tuple[tuple[float, dict[str, int]], ...] = (
    (-sqrt(3 / (4 * pi)), {'y': 1}),
    (sqrt(3 / (4 * pi)), {'z': 1}),
    (-sqrt(3 / (4 * pi)), {'x': 1}),
    (sqrt(15 / (4 * pi)), {'xy': 1}),
    (-sqrt(15 / (4 * pi)), {'yz': 1}),
    (sqrt(5 / (16 * pi)), {'zz': 2, 'xx': -1, 'yy': -1}),
    (-sqrt(15 / (4 * pi)), {'xz': 1}),
    (sqrt(15 / (16 * pi)), {'xx': 1, 'yy': -1}),
    (-sqrt(35 / (32 * pi)), {'xxy': 3, 'yyy': -1}),
    (sqrt(105 / (4 * pi)), {'xyz': 1}),
    (-sqrt(21 / (32 * pi)), {'yzz': 4, 'xxy': -1, 'yyy': -1}),
    (sqrt(7 / (16 * pi)), {'zzz': 2, 'xxz': -3, 'yyz': -3}),
    (-sqrt(21 / (32 * pi)), {'xzz': 4, 'xxx': -1, 'xyy': -1}),
    (sqrt(105 / (16 * pi)), {'xxz': 1, 'yyz': -1}),
    (-sqrt(35 / (32 * pi)), {'xxx': 1, 'xyy': -3}),
)


def functions(degree: int) -> int:
    """Return how many functions there are beyond the constant one: 0, 3, 8 or 15."""
    return (degree + 1) ** 2 - 1


def degree_of(count: int) -> int | None:
    """Return the degree that has `count` coefficients in three channels; None if none has."""
    fits = [d for d in range(MAX_DEGREE + 1) if 3 * functions(d) == count]
    return fits[0] if fits else None


def resized(harmonics: Array, degree: int) -> Array:
    """Return coefficients for another degree: what is new is 0, what is too fine is left out."""
    count, columns = functions(degree), harmonics.shape[1] // 3
    out = np.zeros((len(harmonics), 3, count), np.float32)
    kept = min(count, columns)
    out[:, :, :kept] = harmonics.reshape(len(out), 3, columns)[:, :, :kept]
    return out.reshape(len(out), 3 * count)


class Shading:
    """
    The colours of Gaussians as one camera sees them, and their derivatives by the coefficients.

    The derivative through the direction to the means and the camera, which 3DGS adds, is left
    out: it gained nothing where it was tried (docs/view_dependent_color.md).

    Parameters
    ----------
    means : ndarray, shape (N, 3)
        Metres in world.
    harmonics : ndarray, shape (N, 3 K)
        c_k of all functions for red, then for green, then for blue: the order of `f_rest_*`.
    T_camera_world : ndarray, shape (4, 4)
        Of the camera.
    threads : int
        Of the native kernels.
    native : bool
        Whether to use them where they were built; the twin in numpy is many times slower.

    """

    def __init__(
        self,
        means: Array,
        harmonics: Array,
        T_camera_world: NDArray[np.float64],
        *,
        threads: int = 1,
        native: bool = True,
    ) -> None:
        self._means = np.ascontiguousarray(means, np.float32)
        self._harmonics = np.ascontiguousarray(harmonics, np.float32)
        self._centre = -T_camera_world[:3, :3].T @ T_camera_world[:3, 3]
        self._threads = threads
        self._kernels = _kernels if native else None

    def colors(self, constant: Array, rows: Mask) -> Array:
        """
        Return c(d), shape (N, 3).

        Parameters
        ----------
        constant : ndarray, shape (N, 3)
            c_0.
        rows : ndarray of bool, shape (N,)
            Those that are drawn; the others keep c_0.

        """
        out = np.array(constant, np.float32, order='C')
        if self._kernels is not None:
            self._kernels.add_colors(
                self._centre, self._means, self._harmonics, rows, out, self._threads
            )
        else:
            blocks = self._harmonics[rows].reshape(-1, 3, self._count)
            out[rows] += np.einsum('nk,nck->nc', self._basis(rows), blocks)
        return out

    def gradient(self, by_color: Array, rows: Mask, out: Array) -> None:
        """
        Write dL/dc_k = Y_k dL/dc to `out`, shape (N, 3 K).

        Parameters
        ----------
        by_color : ndarray, shape (N, 3)
            dL/dc(d), which is dL/dc_0 as well.
        rows : ndarray of bool, shape (N,)
            Those that are wanted; in the others `out` stays as it is.
        out : ndarray, shape (N, 3 K)
            To be used again for the next view: fresh memory costs more than the arithmetic.

        """
        if self._kernels is not None:
            by_color = np.ascontiguousarray(by_color, np.float32)
            self._kernels.gradient(self._centre, self._means, by_color, rows, out, self._threads)
        else:
            blocks = np.einsum('nc,nk->nck', by_color[rows], self._basis(rows))
            out[rows] = blocks.reshape(-1, 3 * self._count)

    @property
    def _count(self) -> int:
        return int(self._harmonics.shape[1] // 3)

    def _basis(self, rows: Mask) -> Array:
        offsets = (self._means[rows] - self._centre.astype(np.float32)).T
        distance = np.maximum(np.sqrt((offsets**2).sum(axis=0)), np.float32(1e-6))
        return basis(offsets / distance, self._count)


def basis(directions: Array, count: int) -> Array:
    """Return the first `count` functions of unit vectors, shape (3, N), as columns, [N, K]."""
    names, coefficients = monomials(count)
    values = np.empty((len(names), directions.shape[1]), np.float32)
    values[0] = 1
    for i, name in enumerate(names[1:], start=1):
        lower = values[names.index(name[:-1])]
        np.multiply(lower, directions['xyz'.index(name[-1])], out=values[i])
    return np.asarray(values.T @ coefficients)


@lru_cache(maxsize=MAX_DEGREE + 1)
def monomials(count: int) -> tuple[tuple[str, ...], Array]:
    """Return the names of monomials, and their coefficients in the functions, [L, K]."""
    chosen = _FUNCTIONS[:count]
    degree = max((len(name) for _, terms in chosen for name in terms), default=0)
    names = tuple(
        ''.join(n) for d in range(degree + 1) for n in combinations_with_replacement('xyz', d)
    )
    coefficients = np.zeros((len(names), count), np.float32)
    for k, (factor, terms) in enumerate(chosen):
        for name, coefficient in terms.items():
            coefficients[names.index(name), k] = factor * coefficient
    return names, coefficients
