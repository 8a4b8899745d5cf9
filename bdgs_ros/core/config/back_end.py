"""Parameters of the back end: how keyframes agree with each other."""

from __future__ import annotations

from dataclasses import dataclass, field

from bdgs_ros.core.config.param import param
from bdgs_ros.core.config.tracking import FeatureConfig


@dataclass(frozen=True)
class BundleConfig:
    """Bundle adjustment of keyframes by the corners that they share."""

    enabled: bool = param(True, 'join each new keyframe with the window and what shows the same')
    window: int = param(4, 'newest keyframes that a new one is joined with', low=1, high=100)
    older: int = param(3, 'older keyframes that show the same, joined too', low=0, high=100)
    overlap: float = param(0.4, 'least share of its corners in an older one', low=0.0, high=1.0)
    corners: int = param(150, 'followed from each keyframe', low=20, high=1000)
    max_dynamic: float = param(0.5, 'likelier to move: no corner', low=0.0, high=1.0)
    least_shared: int = param(15, 'fewer corners join no pair', low=6, high=1000)
    pixel_sigma: float = param(0.7, 'of a followed corner', unit='px', low=0.01, high=10.0)
    inverse_depth_sigma: float = param(
        0.006, 'of the sensor, what its bend leaves over', unit='1/m', low=1e-4, high=1.0
    )
    dof: float = param(
        3.0, 'degrees of freedom of the t-distribution: fewer reject more', low=1.0, high=100.0
    )
    bend_sigma: float = param(
        0.03, 'what depth sensors bend, before anything is known', unit='1/m', low=1e-6, high=1.0
    )
    readout_sigma_s: float = param(
        0.03, 'time from first row to last (rolling shutter), beforehand', unit='s', low=1e-6
    )
    odometry_m: float = param(
        0.01, 'how far a keyframe may drift from its neighbour', unit='m', low=1e-5, high=1.0
    )
    odometry_rad: float = param(
        0.005, 'how far a keyframe may turn from its neighbour', unit='rad', low=1e-5, high=1.0
    )


@dataclass(frozen=True)
class LoopConfig:
    """Places seen before, recognised without knowing where the camera is."""

    enabled: bool = param(True, 'look for places seen before')
    candidates: int = param(3, 'likeliest keyframes compared with a new one', low=1, high=1000)
    min_inliers: int = param(25, 'matches that agree on one pose', low=6, high=1000)
    sure_inliers: int = param(
        60, 'so many are believed though the keyframe before saw no such place', low=6, high=1000
    )
    min_share: float = param(0.4, 'of all matches', low=0.0, high=1.0)
    tolerance_px: float = param(4.0, 'of a match that agrees', unit='px', low=0.1, high=50.0)
    features: FeatureConfig = field(default_factory=lambda: FeatureConfig(count=400))


@dataclass(frozen=True)
class BackEndConfig:
    """The back end."""

    keyframes: int = param(100, 'kept with image; redundant ones leave first', low=20, high=2000)
    least_m: float = param(0.001, 'smaller corrections are not made', unit='m', low=0.0, high=1.0)
    bundle: BundleConfig = field(default_factory=BundleConfig)
    loop: LoopConfig = field(default_factory=LoopConfig)
