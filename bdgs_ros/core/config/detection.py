"""Parameters of the detection stage."""

from __future__ import annotations

from dataclasses import dataclass

from bdgs_ros.core.config.param import param


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
