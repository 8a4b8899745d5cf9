"""Where one camera is in the frame of another, from matched features: PnP with RANSAC."""

from __future__ import annotations

from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import Pose

_LEAST = 4  # points that determine a pose
_CONFIDENCE = 0.999


@dataclass(frozen=True)
class Located:
    """A pose and the matches that agree with it."""

    T_current_reference: Pose
    inliers: NDArray[np.intp]
    """Shape (I,): rows of the matches."""


def locate(
    points_reference: NDArray[np.float32],
    pixels_current: NDArray[np.float32],
    camera: PinholeCamera,
    tolerance_px: float,
    seed: int = 0,
) -> Located | None:
    """
    Find the pose that projects points of the reference onto pixels of the current image.

    RANSAC over P3P, then least squares on the inliers.

    Parameters
    ----------
    points_reference : ndarray, shape (M, 3)
        Metres, in the reference camera's frame.
    pixels_current : ndarray, shape (M, 2)
        Where they were found.
    camera : PinholeCamera
        Of the current image, rectified.
    tolerance_px : float
        A point that projects within this of its pixel agrees.
    seed : int
        Of the random samples.

    Returns
    -------
    located : Located or None
        None where no pose explains four matches.

    """
    if len(points_reference) < _LEAST:
        return None
    cv2.setRNGSeed(seed)
    K = np.array([[camera.fx, 0, camera.cx], [0, camera.fy, camera.cy], [0, 0, 1]])
    points = np.ascontiguousarray(points_reference, np.float64)
    pixels = np.ascontiguousarray(pixels_current, np.float64)
    found, rotation, translation, rows = cv2.solvePnPRansac(
        points,
        pixels,
        K,
        None,
        reprojectionError=tolerance_px,
        confidence=_CONFIDENCE,
        flags=cv2.SOLVEPNP_P3P,
    )
    if not found or rows is None or len(rows) < _LEAST:
        return None
    inliers = np.asarray(rows.reshape(-1), np.intp)
    rotation, translation = cv2.solvePnPRefineLM(
        points[inliers], pixels[inliers], K, None, rotation, translation
    )
    matrix = np.asarray(cv2.Rodrigues(rotation)[0], np.float64)
    return Located(
        se3.from_rotation_translation(matrix, np.asarray(translation, np.float64).reshape(3)),
        inliers,
    )
