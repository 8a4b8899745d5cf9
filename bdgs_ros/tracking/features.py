"""
Corners that can be found again from elsewhere: ORB features with depth on what stands still.

Direct alignment needs to start within a few pixels. Features need no start, so places are
recognised with them (`places`) and keyframes far apart in time are joined (`bundle`). ORB is that
of Rublee et al., ICCV 2011, as in OpenCV.
"""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.config.tracking import FeatureConfig
from bdgs_ros.core.types import ColorImage, ProbabilityImage, RgbdFrame

_NEIGHBOURS = 2  # of a descriptor: the best and the one it must be clearly better than


@dataclass(frozen=True)
class Features:
    """Features of one image, all with depth, in the frame of its camera."""

    pixels: NDArray[np.float32]
    """Shape (N, 2): (u, v)."""
    points_camera: NDArray[np.float32]
    """Shape (N, 3): metres."""
    descriptors: NDArray[np.uint8]
    """Shape (N, 32)."""
    octaves: NDArray[np.uint8]
    """Shape (N,): level of the feature's pyramid; its pixel is known to `scale ** octave`."""
    p_static: NDArray[np.float32]
    """Shape (N,)."""

    def __len__(self) -> int:
        """Return the number of features."""
        return len(self.pixels)


class FeatureExtractor:
    """
    Finds ORB features spread over an image, where nothing moves and depth is known.

    Parameters
    ----------
    config : FeatureConfig
        How many, and what counts as static.

    """

    def __init__(self, config: FeatureConfig) -> None:
        self._config = config
        self._orb = cv2.ORB.create(
            nfeatures=config.count,
            scaleFactor=config.scale,
            nlevels=config.levels,
            fastThreshold=config.fast_threshold,
        )

    def extract(self, frame: RgbdFrame, p_dynamic: ProbabilityImage) -> Features:
        """
        Return the features of a frame.

        Parameters
        ----------
        frame : RgbdFrame
            Rectified.
        p_dynamic : ndarray, shape (H, W), uint8
            P(dynamic) x 255; corners that are likelier to move than `max_dynamic` are left out.

        """
        usable = (p_dynamic <= 255 * self._config.max_dynamic) & (frame.depth_m > 0)
        mask = np.where(usable, np.uint8(255), np.uint8(0))
        keypoints, descriptors = self._orb.detectAndCompute(_grey(frame.color), mask)
        if descriptors is None:
            return _nothing()
        pixels = np.array([k.pt for k in keypoints], np.float32).reshape(-1, 2)
        octaves = np.array([k.octave for k in keypoints], np.uint8)
        columns, rows = np.rint(pixels).astype(int).T
        depth_m = frame.depth_m[rows, columns]
        rays = np.column_stack([frame.camera.tangents(pixels), np.ones(len(pixels))])
        points = (rays * depth_m[:, None]).astype(np.float32)
        p_static = 1 - p_dynamic[rows, columns].astype(np.float32) / 255
        return Features(pixels, points, np.asarray(descriptors, np.uint8), octaves, p_static)


def match(a: Features, b: Features, config: FeatureConfig) -> NDArray[np.intp]:
    """
    Pair features that look alike: each other's best, and clearly better than the second.

    Returns
    -------
    pairs : ndarray, shape (M, 2)
        Rows of `a` and of `b`.

    """
    if min(len(a), len(b)) < _NEIGHBOURS:
        return np.zeros((0, 2), np.intp)
    ahead, clear = _nearest(a.descriptors, b.descriptors, config)
    rows = np.flatnonzero(clear)
    if not len(rows):
        return np.zeros((0, 2), np.intp)
    back, _ = _nearest(b.descriptors[ahead[rows]], a.descriptors, config)
    rows = rows[back == rows]
    return np.stack([rows, ahead[rows]], axis=1)


def _nearest(
    query: NDArray[np.uint8], train: NDArray[np.uint8], config: FeatureConfig
) -> tuple[NDArray[np.intp], NDArray[np.bool_]]:
    """Return the nearest descriptor of `train` to each of `query`, and whether it is clear."""
    distance, index = cv2.batchDistance(
        query, train, cv2.CV_32S, normType=cv2.NORM_HAMMING, K=_NEIGHBOURS
    )
    best, second = distance[:, 0], distance[:, 1]
    clear = (best <= config.max_distance) & (best < config.ratio * second)
    return np.asarray(index[:, 0], np.intp), np.asarray(clear)


def _grey(color: ColorImage) -> NDArray[np.uint8]:
    return np.asarray(cv2.cvtColor(color, cv2.COLOR_RGB2GRAY), np.uint8)


def _nothing() -> Features:
    return Features(
        np.zeros((0, 2), np.float32),
        np.zeros((0, 3), np.float32),
        np.zeros((0, 32), np.uint8),
        np.zeros(0, np.uint8),
        np.zeros(0, np.float32),
    )
