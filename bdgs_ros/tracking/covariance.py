"""
How far off a pose may be: from how much the parts of an image disagree about it.

Residuals of neighbouring pixels err together, so their number says nothing. Squares of the image
are asked instead: at the pose that all of them chose, each still pulls a little its own way, and
the spread of these pulls is what the pose inherits (the sandwich estimator with clusters [1]_).
What the images leave open altogether, and what a camera in motion does while an image is exposed
and read out, come on top.

References
----------
.. [1] A. C. Cameron, D. L. Miller, "A Practitioner's Guide to Cluster-Robust Inference", Journal
   of Human Resources 50(2), 2015.

"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.config.tracking import CovarianceConfig
from bdgs_ros.core.types import Pose
from bdgs_ros.tracking.align import Cells
from bdgs_ros.tracking.parts import FEWEST, blocks_of_two

Array = NDArray[np.float64]


def of_alignment(
    cells: Cells,
    moved: NDArray[np.bool_],
    step: Array,
    open_covariance: Array,
    velocity: Array,
    config: CovarianceConfig,
) -> Array:
    """
    Return the covariance of a pose relative to its reference.

    Parameters
    ----------
    cells : Cells
        Of the present image.
    moved : ndarray, shape (rows, columns)
        Squares that are not the world.
    step : ndarray, shape (6,)
        From where the cells were asked to the pose, `exp(step) @ T_current_reference`.
    open_covariance : ndarray, shape (6, 6)
        What the images leave open, `AlignResult.covariance`.
    velocity : ndarray, shape (6,)
        Of the camera, (v, w) in its frame, m/s and rad/s.
    config : CovarianceConfig
        Calibration.

    Returns
    -------
    covariance : ndarray, shape (6, 6)
        Of the camera's tangent, m^2 and rad^2.

    """
    used = (cells.seen >= FEWEST) & ~moved.reshape(-1)
    pulls = (cells.gradient + cells.information @ step) * used[:, None]
    information = cells.information[used].sum(axis=0)
    information += 1e-6 * np.trace(information) * np.eye(6) + 1e-6 * np.eye(6)
    bread = np.linalg.inv(information)
    clusters = blocks_of_two(pulls.reshape(-1, cells.columns, 6)).reshape(-1, 6)
    spread = bread @ (clusters.T @ clusters) @ bread
    smear = _smear(velocity, float(np.median(cells.depth_m[used])) if used.any() else 1.0)
    return np.asarray(
        config.spread * spread + config.open * open_covariance + config.smear_s**2 * smear
    )


def _smear(velocity: Array, depth_m: float) -> Array:
    """Return the covariance of what shifts in the image in a second, whatever its direction."""
    spin = float(np.linalg.norm(velocity[3:]) + np.linalg.norm(velocity[:3]) / depth_m)
    return spin**2 * np.diag([depth_m**2] * 3 + [1.0] * 3)


def chained(first: Array, T_first_second: Pose, second: Array) -> Array:
    """
    Return the covariance of a pose that is known relative to another one.

    Parameters
    ----------
    first : ndarray, shape (6, 6)
        Of the tangent of `T_world_first`.
    T_first_second : ndarray, shape (4, 4)
        From one to the other.
    second : ndarray, shape (6, 6)
        Of its tangent.

    """
    A = se3.adjoint(se3.inverse(T_first_second))
    return np.asarray(A @ first @ A.T + second)
