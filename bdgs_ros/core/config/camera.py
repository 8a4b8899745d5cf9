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
