"""
Whether what the graph found may be believed: the map and tracking follow, and nothing undoes it.

Three things speak against a solution whatever was recorded. A camera like that does not exist; the
pairs on which it rests fit worse than before; or neighbours were torn apart though no pair that
agrees with the result joins what lies before with what lies behind.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.back_end.calibration import Calibration, Known
from bdgs_ros.back_end.graph import Edge, Solution, motions_apart, pair_errors
from bdgs_ros.core import se3
from bdgs_ros.core.bend import BENDS
from bdgs_ros.core.config.back_end import BundleConfig
from bdgs_ros.core.types import Pose

Array = NDArray[np.float64]

_MOST_SIGMA = 5.0  # that a camera may differ from what is known of cameras
_TORN_CHI2 = 54.0  # of six degrees of freedom: by chance once in 1e9 links


def objection(
    before: Sequence[Pose],
    solution: Solution,
    edges: Sequence[Edge],
    calibration: Calibration,
    known: Known,
    config: BundleConfig,
) -> str:
    """
    Say what speaks against a solution.

    Parameters
    ----------
    before : sequence of ndarray, shape (4, 4)
        T_world_camera that it started from, in order of time.
    solution : Solution
        Of `edges`.
    edges : sequence of Edge
        At least one.
    calibration : Calibration
        That it started from.
    known : Known
        Of the calibration, beforehand.
    config : BundleConfig
        Noise of odometry and of calibrations.

    Returns
    -------
    reason : str
        Empty where nothing does.

    """
    after, found = solution.poses, solution.calibration
    if not se3.are_rigid(np.array(after)):
        return 'its poses are no motions'
    if not _is_possible(found, known, config):
        return 'no camera has such a shutter or bend'
    was, errors = pair_errors(edges, (before, calibration), (after, found))
    # Odometry and the calibration may outvote a pair, and no more than one.
    if _cost(errors) > _cost(was) + 1:
        return 'the pairs fit worse than before'
    agreeing = [edge for edge, error in zip(edges, errors, strict=True) if error < 1]
    if _is_torn(motions_apart(before, after), agreeing, config):
        return 'neighbours were torn apart without a pair that joins both sides'
    return ''


def _is_possible(found: Calibration, known: Known, config: BundleConfig) -> bool:
    sigma = np.append(np.full(BENDS, config.bend_sigma), config.readout_sigma_s)
    off = np.abs(found.vector - known.calibration.vector) / sigma
    return bool((off < _MOST_SIGMA).all())  # what is no number is not less


def _cost(errors: Array) -> float:
    """Return Geman and McClure's cost: none weighs more than 1."""
    return float(np.sum(errors / (1 + errors)))


def _is_torn(changes: Array, agreeing: Sequence[Edge], config: BundleConfig) -> bool:
    """Return whether a motion between neighbours changed by more than odometry drifts, alone."""
    sigma = np.repeat([config.odometry_m, config.odometry_rad], 3)
    starts = np.zeros(len(changes) + 1)  # of pairs over links, less those that end
    for edge in agreeing:
        starts[min(edge.one, edge.other)] += 1
        starts[max(edge.one, edge.other)] -= 1
    alone = np.cumsum(starts)[:-1] == 0
    return bool((((changes / sigma) ** 2).sum(axis=1)[alone] > _TORN_CHI2).any())
