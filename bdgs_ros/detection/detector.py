"""What a detector is, and which one a configuration asks for."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol, runtime_checkable

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


@dataclass(frozen=True)
class Answer:
    """What was found in one image."""

    stamp_ns: int
    detections: list[Detection]


@runtime_checkable
class LateDetector(Protocol):
    """A detector that may answer later than it is asked, or never."""

    @property
    def name(self) -> str:
        """What runs and where, for people."""

    def submit(self, stamp_ns: int, color: ColorImage) -> None:
        """Offer an RGB image, shape (H, W, 3), newer than all before; never waits for long."""

    def poll(self) -> list[Answer]:
        """
        Return what was answered since the last call, in the order of stamps.

        Raises
        ------
        ModelError
            If the network cannot be run.

        """

    def reset(self) -> None:
        """Forget the images offered and their answers."""

    def close(self) -> None:
        """Stop working."""


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
