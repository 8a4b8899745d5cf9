"""Every parameter of the system, with default, meaning and range."""

from __future__ import annotations

from dataclasses import dataclass, field

from bdgs_ros.core.config.back_end import BackEndConfig
from bdgs_ros.core.config.belief import BeliefConfig
from bdgs_ros.core.config.camera import CameraConfig
from bdgs_ros.core.config.detection import DetectionConfig
from bdgs_ros.core.config.mapping import MappingConfig
from bdgs_ros.core.config.param import ParamSpec, param, specs, validate, with_values
from bdgs_ros.core.config.tracking import TrackingConfig


@dataclass(frozen=True)
class BdgsConfig:
    """The whole system."""

    camera: CameraConfig = field(default_factory=CameraConfig)
    detection: DetectionConfig = field(default_factory=DetectionConfig)
    tracking: TrackingConfig = field(default_factory=TrackingConfig)
    belief: BeliefConfig = field(default_factory=BeliefConfig)
    mapping: MappingConfig = field(default_factory=MappingConfig)
    back_end: BackEndConfig = field(default_factory=BackEndConfig)


__all__ = [
    'BackEndConfig',
    'BdgsConfig',
    'BeliefConfig',
    'CameraConfig',
    'DetectionConfig',
    'MappingConfig',
    'ParamSpec',
    'TrackingConfig',
    'param',
    'specs',
    'validate',
    'with_values',
]
