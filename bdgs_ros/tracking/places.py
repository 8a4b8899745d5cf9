"""
Keyframes by which a lost camera finds where it is: retrieval by binary words, then geometry.

The likeliest places are matched feature by feature, and PnP with RANSAC says where the camera is.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.tracking import FeatureConfig, PlacesConfig
from bdgs_ros.core.types import Pose, ProbabilityImage, RgbdFrame
from bdgs_ros.tracking.features import FeatureExtractor, Features, match
from bdgs_ros.tracking.pnp import locate
from bdgs_ros.tracking.word_index import WordIndex, Words

_SAME_VIEW = 0.35  # rad, that two cameras look at much the same
_METRES_PER_RADIAN = 2.0  # a turn moves the view as far as this at usual depths


@dataclass(frozen=True)
class Place:
    """A keyframe, small, as it is remembered."""

    stamp_ns: int
    T_world_camera: Pose
    camera: PinholeCamera
    grey: NDArray[np.uint8]
    depth_m: NDArray[np.float16]
    p_dynamic: ProbabilityImage
    features: Features | None = None
    """None until somebody had the time."""
    words: Words | None = None


@dataclass(frozen=True)
class Sighting:
    """A place that the camera may see, and where the camera would be."""

    place: Place
    T_world_camera: Pose
    inliers: int
    """Matches that agree on the pose."""


class Places:
    """
    The data base of keyframes.

    Parameters
    ----------
    config : PlacesConfig
        How many are remembered, and what counts as recognised.
    features : FeatureConfig
        Of the descriptors and their matching; the count is that of `config`.

    """

    def __init__(self, config: PlacesConfig, features: FeatureConfig) -> None:
        self._config = config
        self._matching = replace(features, count=config.features)
        self._extractor = FeatureExtractor(self._matching)
        self._index = WordIndex()
        self._places: list[Place] = []

    def clear(self) -> None:
        """Forget all."""
        self._places = []

    def __len__(self) -> int:
        """Return the number of places."""
        return len(self._places)

    def __iter__(self) -> Iterator[Place]:
        """List the places, oldest first."""
        return iter(self._places)

    def add(self, frame: RgbdFrame, T_world_camera: Pose, p_dynamic: ProbabilityImage) -> None:
        """
        Remember a keyframe; its features are extracted later, see `prepare`.

        Parameters
        ----------
        frame : RgbdFrame
            Rectified.
        T_world_camera : ndarray, shape (4, 4)
            Its pose.
        p_dynamic : ndarray, shape (H, W), uint8
            P(dynamic) x 255; what may move is no landmark.

        """
        self._places.append(_shrink(frame, T_world_camera, p_dynamic, self._config.width))
        if len(self._places) > self._config.count:
            del self._places[_most_redundant(self._places)]

    def put(self, poses: Mapping[int, Pose]) -> None:
        """Take new poses, `T_world_camera` by stamp (ns); what is not named stays."""
        for i, place in enumerate(self._places):
            if place.stamp_ns in poses:
                self._places[i] = replace(place, T_world_camera=poses[place.stamp_ns])

    def near(self, T_world_camera: Pose, depth_m: float) -> dict[int, Pose]:
        """Return the poses by stamp of the places that look at much the same from there."""
        if not self._places:
            return {}
        poses = np.array([place.T_world_camera for place in self._places])
        apart = np.linalg.norm(poses[:, :3, 3] - T_world_camera[:3, 3], axis=1) / depth_m
        turned = np.arccos(np.clip(poses[:, :3, 2] @ T_world_camera[:3, 2], -1, 1))
        chosen = np.flatnonzero(apart + turned < _SAME_VIEW)
        return {self._places[i].stamp_ns: poses[i] for i in chosen}

    def prepare(self, most: int = 1) -> None:
        """Extract the features of so many places that have none yet."""
        for i, place in enumerate(self._places):
            if place.features is None and most > 0:
                self._places[i] = self._prepared(place)
                most -= 1

    def _prepared(self, place: Place) -> Place:
        frame = RgbdFrame(
            place.stamp_ns,
            np.asarray(cv2.cvtColor(place.grey, cv2.COLOR_GRAY2RGB), np.uint8),
            place.depth_m.astype(np.float32),
            place.camera,
        )
        features = self._extractor.extract(frame, place.p_dynamic)
        return replace(place, features=features, words=self._index.words(features.descriptors))

    def find(self, frame: RgbdFrame, p_dynamic: ProbabilityImage) -> list[Sighting]:
        """
        Recognise where a frame was taken.

        Parameters
        ----------
        frame : RgbdFrame
            Rectified.
        p_dynamic : ndarray, shape (H, W), uint8
            P(dynamic) x 255.

        Returns
        -------
        sightings : list of Sighting
            Those with enough matches that agree on a pose, the most first.

        """
        self.prepare(len(self._places))
        query = self._prepared(_shrink(frame, se3.identity(), p_dynamic, self._config.width))
        likely = self._likely(query)
        seen = [s for s in (self._look(place, query) for place in likely) if s is not None]
        return sorted(seen, key=lambda sighting: -sighting.inliers)

    def _likely(self, query: Place) -> list[Place]:
        """Return the places that share the rarest words with the query, the best first."""
        known = [p.words for p in self._places if p.words is not None]
        if query.words is None or len(known) < len(self._places):
            return []
        likely = self._index.likely(query.words, known, self._config.candidates)
        return [self._places[i] for i in likely]

    def _look(self, place: Place, query: Place) -> Sighting | None:
        """Match feature by feature, and locate the camera."""
        assert place.features is not None and query.features is not None
        pairs = match(place.features, query.features, self._matching)
        if len(pairs) < self._config.min_inliers:
            return None
        found = locate(
            place.features.points_camera[pairs[:, 0]],
            query.features.pixels[pairs[:, 1]],
            query.camera,
            self._config.tolerance_px,
        )
        if found is None or len(found.inliers) < self._config.min_inliers:
            return None
        T_place_camera = se3.inverse(found.T_current_reference)
        return Sighting(place, place.T_world_camera @ T_place_camera, len(found.inliers))


def _shrink(
    frame: RgbdFrame, T_world_camera: Pose, p_dynamic: ProbabilityImage, width: int
) -> Place:
    camera = frame.camera.scaled(min(1.0, width / frame.camera.width))
    size = (camera.width, camera.height)
    image = cv2.resize(
        cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY), size, interpolation=cv2.INTER_AREA
    )
    depth_m = cv2.resize(frame.depth_m, size, interpolation=cv2.INTER_NEAREST)
    moving = cv2.resize(p_dynamic, size, interpolation=cv2.INTER_NEAREST)
    return Place(
        frame.stamp_ns,
        T_world_camera,
        camera,
        np.asarray(image, np.uint8),
        np.asarray(depth_m, np.float16),
        np.asarray(moving, np.uint8),
    )


def _most_redundant(places: list[Place]) -> int:
    """Return which place is nearest to another one; the newest is never it."""
    distance = se3.view_distances([p.T_world_camera for p in places], _METRES_PER_RADIAN)
    return int(np.argmin(distance[:-1].min(axis=1)))
