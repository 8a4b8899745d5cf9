"""Which detection is which object: cost matrix and assignment; no state."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import linear_sum_assignment

from bdgs_ros.core.config.detection import TracksConfig
from bdgs_ros.core.types import Detection, Pose
from bdgs_ros.detection.postprocess import iou_matrix
from bdgs_ros.detection.sighting import Shown, Sighting, measurement

Matrix = NDArray[np.float64]

_FORBIDDEN = 1e3


class Predicted(Protocol):
    """An object predicted to the time of the image."""

    @property
    def state(self) -> Matrix:
        """Shape (8,)."""

    @property
    def covariance(self) -> Matrix:
        """Shape (8, 8)."""

    @property
    def detection(self) -> Detection:
        """The last one of it."""


def assign(
    tracks: Sequence[Predicted],
    expected: Sequence[Shown | None],
    sightings: Sequence[Sighting],
    T_odom_camera: Pose,
    config: TracksConfig,
) -> list[tuple[int, int]]:
    """
    Pair sightings with objects at the least sum of costs (Hungarian assignment).

    The cost is what the boxes do not overlap plus the distance in space in parts of the gate.
    Other classes, and objects outside both gates, are no partners.

    Parameters
    ----------
    tracks : sequence of Predicted
        M objects at the time of the image.
    expected : sequence of Shown or None
        How they should appear; None: not at all.
    sightings : sequence of Sighting
        What was found.
    T_odom_camera : ndarray, shape (4, 4)
        Where the camera was.
    config : TracksConfig
        Gates and noise.

    Returns
    -------
    pairs : list of (int, int)
        Index of the sighting, index of the object.

    """
    if not tracks or not sightings:
        return []
    cost = _costs(tracks, expected, sightings, T_odom_camera, config)
    rows, columns = linear_sum_assignment(cost)
    return [
        (int(i), int(k)) for i, k in zip(rows, columns, strict=True) if cost[i, k] < _FORBIDDEN
    ]


def _costs(
    tracks: Sequence[Predicted],
    expected: Sequence[Shown | None],
    sightings: Sequence[Sighting],
    T_odom_camera: Pose,
    config: TracksConfig,
) -> Matrix:
    overlap = _overlaps(expected, sightings)
    far = np.array([_distances(s, tracks, T_odom_camera, config) for s in sightings])
    gate = far / config.gate_sigma
    cost = (1 - overlap) + np.minimum(gate, 1.0)
    foreign = np.array(
        [[s.detection.class_id != t.detection.class_id for t in tracks] for s in sightings]
    )
    apart = (gate > 1) & (overlap < config.gate_iou)
    unseen = np.array([e is None for e in expected])
    cost[foreign | apart | unseen[None, :]] = _FORBIDDEN
    return np.asarray(cost)


def _overlaps(expected: Sequence[Shown | None], sightings: Sequence[Sighting]) -> Matrix:
    found = np.array([s.detection.box_xyxy for s in sightings], np.float32)
    nothing = (0.0, 0.0, 0.0, 0.0)
    boxes = np.array([nothing if e is None else e.clipped for e in expected], np.float32)
    return np.asarray(iou_matrix(found, boxes), dtype=np.float64)


def _distances(
    sighting: Sighting, tracks: Sequence[Predicted], T_odom_camera: Pose, config: TracksConfig
) -> Matrix:
    """Mahalanobis distance of a sighting from each object's prediction, shape (M,)."""
    m = measurement(sighting, T_odom_camera, config)
    innovation = m.z - np.array([t.state for t in tracks]) @ m.H.T
    S = m.H @ np.array([t.covariance for t in tracks]) @ m.H.T + m.R
    solved = np.linalg.solve(S, innovation[..., None])[..., 0]
    return np.asarray(np.sqrt(np.einsum('mi,mi->m', innovation, solved)))
