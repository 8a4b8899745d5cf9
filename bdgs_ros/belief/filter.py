"""
The Bayesian filter of one Gaussian's state, Eq. 1-4, and its smoothing, Eq. 10-11.

Every function takes and returns plain arrays over all Gaussians. Beliefs are P(dynamic) in
[0, 1]; updates are sums in log-odds.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float32]

_EPSILON = np.float32(1e-6)


def logit(probability: Array) -> Array:
    """Return log(p / (1 - p)), finite also at 0 and 1."""
    p = np.clip(probability, _EPSILON, 1 - _EPSILON)
    return np.asarray(np.log(p) - np.log1p(-p), dtype=np.float32)


def sigmoid(log_odds: Array) -> Array:
    """Return the probability of the given log-odds."""
    return np.asarray(0.5 * (1.0 + np.tanh(0.5 * log_odds)), dtype=np.float32)


def switch_probability(decay_rate: float, elapsed_s: float) -> float:
    """
    Return the chance q that a Gaussian changed its state within `elapsed_s`.

    A symmetric two-state chain with this q turns Eq. 1 into Eq. 4:
    `(1 - q) b + q (1 - b) = exp(-alpha dt) (b - 1/2) + 1/2`.
    """
    return 0.5 * (1.0 - float(np.exp(-decay_rate * elapsed_s)))


def predict(belief: Array, decay_rate: float, elapsed_s: float) -> Array:
    """
    Carry beliefs over `elapsed_s` seconds without an observation, Eq. 1 in the form of Eq. 4.

    Parameters
    ----------
    belief : ndarray, shape (N,)
        P(dynamic) after the last observation.
    decay_rate : float
        alpha in 1/s.
    elapsed_s : float
        Seconds since then; negative values count as zero.

    Returns
    -------
    predicted : ndarray, shape (N,)
        P(dynamic), drawn towards 1/2.

    """
    decay = np.float32(np.exp(-decay_rate * max(elapsed_s, 0.0)))
    return np.asarray(decay * (belief - np.float32(0.5)) + np.float32(0.5), dtype=np.float32)


def update(predicted: Array, evidence: Array, max_log_odds: float) -> Array:
    """
    Fuse one observation, Eq. 2.

    Parameters
    ----------
    predicted : ndarray, shape (N,)
        P(dynamic) before the observation.
    evidence : ndarray, shape (N,)
        log p(o | dynamic) - log p(o | static), which is `w.f + b` for the likelihood of Eq. 3;
        0 where the Gaussian was not seen.
    max_log_odds : float
        Beliefs are clamped here, so that they can be changed again (as in OctoMap).

    Returns
    -------
    posterior : ndarray, shape (N,)

    """
    return sigmoid(np.clip(logit(predicted) + evidence, -max_log_odds, max_log_odds))


def smooth(belief: Array, previous: Array, ema: float) -> Array:
    """Return the exponential moving average of Eq. 10: `rho b_t + (1 - rho) b_ema`."""
    return np.asarray(np.float32(ema) * belief + np.float32(1 - ema) * previous, dtype=np.float32)


def render_mask(smoothed: Array, threshold: float) -> NDArray[np.bool_]:
    """Return M_g of Eq. 11: True where a Gaussian may be rendered and supervised."""
    return np.asarray(smoothed < threshold)
