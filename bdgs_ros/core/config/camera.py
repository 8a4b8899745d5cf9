"""Parameters of what is done to images before anything else."""

from __future__ import annotations

from dataclasses import dataclass

from bdgs_ros.core.config.param import param


@dataclass(frozen=True)
class CameraConfig:
    """The images that tracking, the back end and mapping work on."""

    width: int = param(
        640, 'wider images are halved as often as leaves this width', unit='px', low=80
    )
    depth_offset_s: float = param(
        0.0, 'stamps of depth images are late by this', unit='s', low=-5.0, high=5.0
    )
    estimate_depth_offset: bool = param(
        False, 'correct that by what tracking.registration measures, if it is clear'
    )
