"""
Places seen before, found without knowing where the camera is.

Keyframes that the present poses do not bring together are compared by ORB features. A place is
recognised where PnP explains enough of the matches; whether it is believed is decided by the
corners that are then followed (`bundle`), and by the rest of the graph.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.back_end import LoopConfig
from bdgs_ros.core.types import Keyframe, Pose
from bdgs_ros.tracking.features import FeatureExtractor, Features, match
from bdgs_ros.tracking.pnp import locate

_LEAST_SPREAD = 0.03  # of their distance, in the second direction


@dataclass(frozen=True)
class Recognised:
    """An earlier keyframe that a new one shows again."""

    stamp_ns: int
    T_earlier_new: Pose
    inliers: int


class LoopDetector:
    """
    Remembers the features of keyframes and compares new ones with them.

    Parameters
    ----------
    config : LoopConfig
        Features, how many comparisons, and what counts as recognised.

    """

    def __init__(self, config: LoopConfig) -> None:
        self._config = config
        self._extractor = FeatureExtractor(config.features)
        self._known: dict[int, tuple[Features, PinholeCamera]] = {}
        self._turn = 0

    def add(self, keyframe: Keyframe) -> None:
        """Remember a keyframe."""
        features = self._extractor.extract(keyframe.frame, keyframe.p_dynamic)
        self._known[keyframe.frame.stamp_ns] = features, keyframe.frame.camera

    def forget(self, stamp_ns: int) -> None:
        """Drop a keyframe that is no longer kept."""
        self._known.pop(stamp_ns, None)

    def find(self, stamp_ns: int, among: Sequence[int]) -> Recognised | None:
        """
        Look for the place of a remembered keyframe among earlier ones.

        Parameters
        ----------
        stamp_ns : int
            Of the new keyframe.
        among : sequence of int
            Stamps of those that may be compared. Not more than `candidates` are, in turn.

        Returns
        -------
        recognised : Recognised or None
            The one with the most matches that agree on a pose.

        """
        count = min(self._config.candidates, len(among))
        chosen = [among[(self._turn + i * len(among) // count) % len(among)] for i in range(count)]
        self._turn += 1
        found = [self._compare(stamp_ns, earlier) for earlier in chosen]
        seen = [recognised for recognised in found if recognised is not None]
        return max(seen, key=lambda recognised: recognised.inliers, default=None)

    def _compare(self, new: int, earlier: int) -> Recognised | None:
        features, _ = self._known[new]
        others, camera = self._known[earlier]
        pairs = match(features, others, self._config.features)
        if len(pairs) < self._config.min_inliers:
            return None
        points, pixels = features.points_camera[pairs[:, 0]], others.pixels[pairs[:, 1]]
        located = locate(points, pixels, camera, self._config.tolerance_px)
        least = max(self._config.min_inliers, self._config.min_share * len(pairs))
        if located is None or len(located.inliers) < least:
            return None
        inliers = points[located.inliers]
        if not _is_spread(inliers):
            return None
        return Recognised(earlier, located.T_current_reference, len(located.inliers))


def _is_spread(points: NDArray[np.float32]) -> bool:
    """Return whether points determine a pose: not all on a line or on one small thing."""
    scatter = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(scatter[1] / np.sqrt(len(points)) > _LEAST_SPREAD * np.median(points[:, 2]))
