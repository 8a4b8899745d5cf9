"""What a detector is, and which one a configuration asks for."""

from __future__ import annotations

from typing import Protocol

from bdgs_ros.core.config.detection import DetectionConfig
from bdgs_ros.core.types import ColorImage, Detection


class Detector(Protocol):
    """Finds objects of known classes in a colour image."""

    @property
    def name(self) -> str:
        """What runs and where, for people."""

    def detect(self, color: ColorImage) -> list[Detection]:
        """
        Return the objects in an image, best first.

        Parameters
        ----------
        color : ndarray, shape (H, W, 3), uint8
            RGB.

        Raises
        ------
        ModelError
            If the network cannot be run.

        """


class NullDetector:
    """The detector that knows no classes: the geometric prior works alone."""

    def __init__(self, reason: str = 'no weights file') -> None:
        self.name = reason

    def detect(self, color: ColorImage) -> list[Detection]:
        """Find nothing."""
        return []


def make_detector(config: DetectionConfig) -> Detector:
    """
    Return the detector that the configuration names.

    Raises
    ------
    ModelError
        If weights are named and cannot be used.

    """
    if not config.weights:
        return NullDetector()
    # onnxruntime takes a quarter of a second to import: only who has weights pays for it.
    from bdgs_ros.detection.onnx_detector import OnnxDetector

    return OnnxDetector(config)
