"""
The two steps of a Kalman filter.

filterpy, which has them too, imports all of scipy's statistics with them: 0.3 s, and a node that
has died should be back in 1.5.

References
----------
.. [1] R. G. Brown, P. Y. C. Hwang, "Introduction to Random Signals and Applied Kalman Filtering",
   4th edition, 2012, section 4.2; the covariance by Joseph's form, which stays symmetric and
   positive whatever the gain.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]


def predict(state: Array, covariance: Array, F: Array, Q: Array) -> tuple[Array, Array]:
    """
    Move a state on.

    Parameters
    ----------
    state, covariance : ndarray, shape (N,) and (N, N)
        What is known.
    F, Q : ndarray, shape (N, N)
        Transition, and the covariance of its noise.

    """
    return F @ state, F @ covariance @ F.T + Q


def update(state: Array, covariance: Array, z: Array, R: Array, H: Array) -> tuple[Array, Array]:
    """
    Take a measurement.

    Parameters
    ----------
    state, covariance : ndarray, shape (N,) and (N, N)
        What is known.
    z, R : ndarray, shape (M,) and (M, M)
        Measurement, and the covariance of its noise.
    H : ndarray, shape (M, N)
        What the measurement is of a state.

    """
    across = covariance @ H.T
    gain = np.linalg.solve(H @ across + R, across.T).T
    left = np.eye(len(state)) - gain @ H
    return state + gain @ (z - H @ state), left @ covariance @ left.T + gain @ R @ gain.T
