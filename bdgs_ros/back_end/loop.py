"""
Places seen before, found without knowing where the camera is.

Keyframes that the present poses do not bring together are looked up by the words of their ORB
features, and the likeliest compared. A place is recognised where PnP explains enough of the
matches; it is believed where very many agree or the keyframe before said the same, and the
corners can then be followed (`bundle`). The rest of the graph may still overrule it.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.back_end import LoopConfig
from bdgs_ros.core.types import Keyframe, Pose
from bdgs_ros.tracking.features import FeatureExtractor, Features, match
from bdgs_ros.tracking.pnp import locate
from bdgs_ros.tracking.word_index import WordIndex, Words

_AGREE_M, _AGREE_RAD = 0.15, 0.1  # two recognised places, each good to a few centimetres
_LEAST_SPREAD = 0.03  # of their distance, in the second direction


@dataclass(frozen=True)
class Recognised:
    """An earlier keyframe that a new one shows again."""

    new_ns: int
    stamp_ns: int
    """Of the earlier one."""
    T_earlier_new: Pose
    inliers: int


@dataclass(frozen=True)
class _Known:
    """What is remembered of a keyframe."""

    features: Features
    words: Words
    camera: PinholeCamera


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
        self._index = WordIndex()
        self._known: dict[int, _Known] = {}

    def add(self, keyframe: Keyframe) -> None:
        """Remember a keyframe."""
        features = self._extractor.extract(keyframe.frame, keyframe.p_dynamic)
        words = self._index.words(features.descriptors)
        self._known[keyframe.frame.stamp_ns] = _Known(features, words, keyframe.frame.camera)

    def forget(self, stamp_ns: int) -> None:
        """Drop a keyframe that is no longer kept."""
        self._known.pop(stamp_ns, None)

    def knows(self, stamp_ns: int) -> bool:
        """Return whether a keyframe is remembered."""
        return stamp_ns in self._known

    def find(self, stamp_ns: int, among: Sequence[int]) -> Recognised | None:
        """
        Look for the place of a remembered keyframe among earlier ones.

        Parameters
        ----------
        stamp_ns : int
            Of the new keyframe.
        among : sequence of int
            Stamps of those that may be compared. The likeliest `candidates` are.

        Returns
        -------
        recognised : Recognised or None
            The one with the most matches that agree on a pose.

        """
        words = [self._known[earlier].words for earlier in among]
        likely = self._index.likely(self._known[stamp_ns].words, words, self._config.candidates)
        found = [self._compare(stamp_ns, among[i]) for i in likely]
        seen = [recognised for recognised in found if recognised is not None]
        return max(seen, key=lambda recognised: recognised.inliers, default=None)

    def _compare(self, new: int, earlier: int) -> Recognised | None:
        features = self._known[new].features
        others, camera = self._known[earlier].features, self._known[earlier].camera
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
        return Recognised(new, earlier, located.T_current_reference, len(located.inliers))


def agree(one: Recognised, other: Recognised, poses: Mapping[int, Pose]) -> bool:
    """
    Return whether two keyframes recognise places that are to each other as they are themselves.

    Parameters
    ----------
    one, other : Recognised
        Of two keyframes close in time.
    poses : mapping of int to ndarray, shape (4, 4)
        T_world_camera by stamp, before the loop is closed.

    """
    if not {one.stamp_ns, one.new_ns, other.stamp_ns, other.new_ns} <= set(poses):
        return False
    # By how much each of the two would move the present into the past.
    moves = [
        poses[r.stamp_ns] @ r.T_earlier_new @ se3.inverse(poses[r.new_ns]) for r in (one, other)
    ]
    at = poses[other.new_ns]
    apart = se3.inverse(moves[0] @ at) @ moves[1] @ at
    near = float(np.linalg.norm(apart[:3, 3])) < _AGREE_M
    return near and se3.rotation_angle_rad(apart) < _AGREE_RAD


def _is_spread(points: NDArray[np.float32]) -> bool:
    """Return whether points determine a pose: not all on a line or on one small thing."""
    scatter = np.linalg.svd(points - points.mean(axis=0), compute_uv=False)
    return bool(scatter[1] / np.sqrt(len(points)) > _LEAST_SPREAD * np.median(points[:, 2]))
