"""Parameters of the detection stage."""

from __future__ import annotations

from dataclasses import dataclass, field

from bdgs_ros.core.config.param import param


@dataclass(frozen=True)
class CutConfig:
    """How a box is cut to the object in it with depth."""

    stride: int = param(4, 'work on every n-th pixel', unit='px', low=1, high=8)
    near_tolerance: float = param(
        0.6, 'depth of an object towards the camera', unit='m', low=0.05, high=5.0
    )
    far_tolerance: float = param(
        0.45, 'depth of an object away from the camera', unit='m', low=0.05, high=5.0
    )
    near: float = param(
        0.9, 'objects nearer than this also take the holes of their box', unit='m', low=0.0
    )
    margin: float = param(
        0.06, 'limbs stick out of the box by this share of its size', low=0.0, high=0.5
    )
    dilate: int = param(4, 'growth of the mask at its edge', unit='px', low=0, high=32)


@dataclass(frozen=True)
class TracksConfig:
    """Objects followed from detection to detection: where they are while the network is mute."""

    interval: int = param(1, 'run the network on every n-th frame', low=1, high=30)
    start_odds: float = param(
        4.0, 'that a detection is a real one, in the first image', low=0.0, high=100.0
    )
    border_odds: float = param(
        0.2, 'that a new detection at the border of the image is a real one', low=0.0, high=100.0
    )
    birth_odds: float = param(
        0.05, 'that a new detection elsewhere is a real one', low=0.0, high=100.0
    )
    even_score: float = param(
        0.2, 'the score that a false detection has as often as a true one', low=0.01, high=0.99
    )
    most_odds: float = param(
        200.0, 'that an object exists, however often it was seen', low=1.0, high=1e6
    )
    miss_s: float = param(
        0.1, 'missed for so long, the odds of an object fall by e', unit='s', low=0.001, high=10.0
    )
    miss_odds: float = param(0.3, 'the least factor of one miss', low=0.0, high=1.0)
    longest_s: float = param(
        1.0, 'an object not seen for longer is let go', unit='s', low=0.0, high=60.0
    )
    speed: float = param(
        0.5, 'of an object, standard deviation per axis', unit='m/s', low=0.01, high=100.0
    )
    speed_s: float = param(
        0.5, 'for which an object keeps its velocity', unit='s', low=0.01, high=100.0
    )
    size_change: float = param(0.4, 'of a size within one second', unit='m', low=0.01, high=10.0)
    box_sigma: float = param(0.07, 'noise of a box, in parts of its size', low=0.001, high=1.0)
    depth_sigma: float = param(0.12, "noise of an object's depth", unit='m', low=0.001, high=10.0)
    gate_sigma: float = param(
        4.0, 'further from its prediction an object is another one', unit='sigma', low=0.1
    )
    widen: float = param(
        1.0, 'a predicted box is larger by this on each side', unit='sigma', low=0.0, high=10.0
    )
    gate_iou: float = param(0.3, 'unless their boxes overlap by this', low=0.0, high=1.0)


@dataclass(frozen=True)
class GeometricConfig:
    """The class-agnostic prior: what stands where an earlier frame saw free space."""

    width: int = param(160, 'image width at which depths are compared', unit='px', low=40)
    p_dynamic: float = param(0.75, 'prior of what was found', low=0.0, high=1.0)
    lag: float = param(0.25, 'age of the first frame compared with', unit='s', low=0.02, high=10.0)
    lags: int = param(4, 'frames compared with, each twice as old as the last', low=1, high=8)
    max_turn_deg: float = param(
        25.0, 'frames from before more turning than this are not compared', unit='deg', low=0.0
    )
    max_move: float = param(
        0.8, 'frames from before a longer way than this are not compared', unit='m', low=0.0
    )
    threshold_sigma: float = param(
        9.0, 'nearer than free space by this', unit='sigma_z', low=1.0, high=100.0
    )
    threshold_m: float = param(0.06, 'and by this', unit='m', low=0.0, high=5.0)
    depth_noise: float = param(
        0.0025, 'sigma_z = depth_noise * z^2, the Kinect model', unit='1/m', low=1e-5
    )
    min_area: float = param(
        0.006, 'smaller regions are dropped', unit='share of the image', low=0.0, high=1.0
    )
    share: float = param(
        0.15, 'of a surface that must have moved in for all of it to move', low=0.0, high=1.0
    )
    max_area: float = param(
        0.75, 'if more of the image seems to move the alignment failed', low=0.0, high=1.0
    )
    min_inliers: float = param(
        0.4, 'alignments with a smaller inlier ratio are not believed', low=0.0, high=1.0
    )


@dataclass(frozen=True)
class DetectionConfig:
    """YOLOv5 prior cut with depth, and the class-agnostic geometric prior beside it."""

    weights: str = param('', 'path of a YOLOv5 ONNX file; empty: geometric prior alone')
    provider: str = param(
        'auto', 'onnxruntime execution provider', choices=('auto', 'cpu', 'cuda')
    )
    threads: int = param(1, 'threads of the network', low=1, high=64)
    score_threshold: float = param(0.35, 'detections below are dropped', low=0.0, high=1.0)
    iou_threshold: float = param(0.45, 'overlap for non-maximum suppression', low=0.0, high=1.0)
    geometric: bool = param(True, 'use the depth warp between frames as a prior')
    cut: CutConfig = field(default_factory=CutConfig)
    tracks: TracksConfig = field(default_factory=TracksConfig)
    warp: GeometricConfig = field(default_factory=GeometricConfig)
