"""When a frame becomes a keyframe: by movement, overlap and age, against the last keyframe."""

from __future__ import annotations

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.config.tracking import KeyframeConfig
from bdgs_ros.core.types import Pose, RgbdFrame


class KeyframeChoice:
    """
    Counts frames since the last keyframe and compares poses with it.

    Parameters
    ----------
    config : KeyframeConfig
        The rules.

    """

    def __init__(self, config: KeyframeConfig) -> None:
        self._config = config
        self.begin(None)

    def begin(self, keyframe: RgbdFrame | None) -> None:
        """Start anew at a keyframe."""
        self.depth_m = 1.0 if keyframe is None else _median_depth(keyframe)
        """Of the keyframe's view, median."""
        self._frames = 0

    def count(self) -> None:
        """Note that another frame came."""
        self._frames += 1

    def is_due(self, T_keyframe_camera: Pose, overlap: float) -> bool:
        """
        Choose by translation over depth, rotation, overlap and age.

        All are against the last keyframe; the model view may be of an older one, when mapping is
        behind.
        """
        move = float(np.linalg.norm(T_keyframe_camera[:3, 3])) / self.depth_m
        turn = np.rad2deg(se3.rotation_angle_rad(T_keyframe_camera))
        return bool(
            move > self._config.translation
            or turn > self._config.rotation_deg
            or overlap < self._config.overlap
            or self._frames >= self._config.max_interval
        )


def _median_depth(frame: RgbdFrame) -> float:
    valid = frame.depth_m[frame.depth_m > 0]
    return float(np.median(valid)) if len(valid) else 1.0
