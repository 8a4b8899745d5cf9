"""
The terms of Eq. 7 that act on Gaussians directly, with their gradients in closed form.

The photometric term (Eq. 9) and the depth term are computed by the rasteriser in one pass with
the rendering; see `bdgs_ros.mapping.rasterize.fused_step`.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.filter import sigmoid

Array = NDArray[np.float32]


def dynamic_penalty(
    logit_opacities: Array, is_dynamic: NDArray[np.bool_], importance: Array
) -> tuple[float, Array]:
    """
    Penalise the opacity of dynamic Gaussians, second term of Eq. 7.

    Parameters
    ----------
    logit_opacities : ndarray, shape (N,)
        alpha_g before the sigmoid.
    is_dynamic : ndarray, shape (N,)
        Membership in G_D.
    importance : ndarray, shape (N,)
        w_g.

    Returns
    -------
    loss : float
        Sum over G_D of w_g alpha_g^2.
    gradient : ndarray, shape (N,)
        With respect to `logit_opacities`.

    """
    alpha = sigmoid(logit_opacities)
    weight = np.where(is_dynamic, importance, 0).astype(np.float32)
    loss = float(np.sum(weight * alpha**2))
    return loss, np.asarray(2 * weight * alpha**2 * (1 - alpha), np.float32)


def covariance_penalty(log_scales: Array) -> tuple[float, Array]:
    """
    Penalise large covariances, second term of Eq. 8.

    The squared Frobenius norm of Sigma_g is the sum of the fourth powers of its scales, whatever
    its rotation.

    Parameters
    ----------
    log_scales : ndarray, shape (N, 3)
        Natural logarithms of metres.

    Returns
    -------
    loss : float
        Sum over all Gaussians, m^4.
    gradient : ndarray, shape (N, 3)
        With respect to `log_scales`.

    """
    fourth = np.exp(4 * log_scales)
    return float(fourth.sum()), np.asarray(4 * fourth, np.float32)
