"""Whether poses are as far off as they say: errors over the covariance that came with them."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.types import TrackingStatus, Trajectory
from bdgs_ros.eval import trajectory
from bdgs_ros.eval.metric import Metric
from bdgs_ros.eval.recorder import FrameRow

_THREE_SIGMA = 14.16  # chi-square of 3 degrees of freedom that 0.27 % exceed
WITHIN = {50: 2.366, 80: 4.642, 95: 7.815, 99: 11.345}
"""Shares in percent, and the chi-square that such a share of honest errors is below."""
_LEAST_VARIANCE = 1e-10  # m^2: the first pose is the origin and has none


def honesty_metrics(gt: Trajectory, est: Trajectory, rows: Sequence[FrameRow]) -> list[Metric]:
    """
    Return the normalised squared error of positions, and the share beyond three sigma.

    Parameters
    ----------
    gt, est : Trajectory
        Truth, and the poses that were published.
    rows : sequence of FrameRow
        Of the same run; without covariances there are no metrics.

    Returns
    -------
    metrics : list of Metric
        `nees`: mean of the three-dimensional error squared over its covariance, after rigid
        alignment of all positions; 3 is honest, less is modest. `beyond_3_sigma`: share of
        poses. `within_50` and so on: share of poses in the ellipsoids in which 50 % of honest
        ones are.

    """
    known = {
        row.stamp_ns: row.covariance
        for row in rows
        if row.covariance is not None and row.status is TrackingStatus.OK
    }
    found = trajectory.ate(gt, est)
    gt_index, est_index = trajectory.associate(gt, est)
    squared = [
        _squared(found.T_gt_est, gt.positions[i], est.matrices[j], known[int(est.stamps_ns[j])])
        for i, j in zip(gt_index, est_index, strict=True)
        if int(est.stamps_ns[j]) in known
    ]
    if not squared:
        return []
    beyond = 100.0 - _percent_below(squared, _THREE_SIGMA)
    within = {share: _percent_below(squared, limit) for share, limit in WITHIN.items()}
    return [
        Metric('nees', float(np.mean(squared))),
        Metric('beyond_3_sigma', beyond, '%'),
        *(Metric(f'within_{share}', found, '%') for share, found in within.items()),
    ]


def _percent_below(squared: Sequence[float], limit: float) -> float:
    return 100.0 * float(np.mean(np.array(squared) <= limit))


def _squared(
    T_gt_est: NDArray[np.float64],
    position: NDArray[np.float64],
    T_world_camera: NDArray[np.float64],
    covariance: NDArray[np.float64],
) -> float:
    """Return the squared error of one position; its covariance is of the camera's tangent."""
    T = T_gt_est @ T_world_camera
    turned = T[:3, :3] @ covariance[:3, :3] @ T[:3, :3].T + _LEAST_VARIANCE * np.eye(3)
    error = position - T[:3, 3]
    return float(error @ np.linalg.solve(turned, error))
