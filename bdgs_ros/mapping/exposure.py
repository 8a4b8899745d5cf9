"""The exposure of a keyframe in closed form: the gain and offset from a render to its image."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.mapping.keyframes import Level
from bdgs_ros.mapping.rasterize import Rendered

Array = NDArray[np.float32]

_OPAQUE = 0.9
_DARK, _SATURATED = 0.02, 0.97  # outside, the sensor does not answer in proportion
_TOLERANCE = 0.05  # differences of brightness beyond count less
_ROUNDS = 5
_OFFSET_PRIOR = 0.3  # pixels' worth of pull to no offset, per pixel
_MIN_PIXELS, _MAX_PIXELS = 200, 20000
_MAX_LOG_GAIN = 1.0


def fit_exposure(static: Rendered, level: Level) -> Array | None:
    """
    Find the gain and offset with which the map looks like the image, robustly.

    Parameters
    ----------
    static : Rendered
        The static map at the keyframe's pose.
    level : Level
        The keyframe at the same size.

    Returns
    -------
    exposure : ndarray or None, shape (2,)
        (log gain, offset) as in `MapKeyframe`; None where map and image share too little.

    """
    color = level.color
    known = level.static & (static.silhouette > _OPAQUE)
    channels = cv2.split(color)  # numpy is slow over a last axis of three
    known &= np.minimum.reduce(channels) > _DARK
    known &= np.maximum.reduce(channels) < _SATURATED
    chosen = np.flatnonzero(known)
    if len(chosen) < _MIN_PIXELS:
        return None
    chosen = chosen[:: 1 + len(chosen) // _MAX_PIXELS]
    shown = static.color.reshape(-1, 3)[chosen] / static.silhouette.ravel()[chosen, None]
    gain, offset = _line(shown.mean(axis=1), color.reshape(-1, 3)[chosen].mean(axis=1))
    log_gain = np.clip(np.log(max(gain, 1e-3)), -_MAX_LOG_GAIN, _MAX_LOG_GAIN)
    return np.array([log_gain, offset], np.float32)


def _line(x: Array, y: Array) -> tuple[float, float]:
    """Fit y = gain x + offset by reweighted least squares."""
    gain, offset = float(np.median(y)) / max(float(np.median(x)), 1e-3), 0.0
    for _ in range(_ROUNDS):
        weight = 1 / (1 + ((gain * x + offset - y) / _TOLERANCE) ** 2)
        n, sx, sxx = weight.sum() * (1 + _OFFSET_PRIOR), weight @ x, weight @ (x * x)
        sy, sxy = weight @ y, weight @ (x * y)
        det = max(float(sxx * n - sx * sx), 1e-9)
        gain, offset = float(sxy * n - sx * sy) / det, float(sxx * sy - sx * sxy) / det
    return gain, offset
