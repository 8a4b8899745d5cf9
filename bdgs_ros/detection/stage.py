"""The detection stage: from a frame to the prior, per pixel, that it shows something moving."""

from __future__ import annotations

import logging

import numpy as np

from bdgs_ros.core.config.detection import DetectionConfig
from bdgs_ros.core.errors import ModelError
from bdgs_ros.core.types import Detection, Labels, ProbabilityImage, RgbdFrame
from bdgs_ros.detection.detector import Detector, NullDetector, make_detector
from bdgs_ros.detection.ego_motion import DirectEgoMotion
from bdgs_ros.detection.geometric import GeometricPrior
from bdgs_ros.detection.hold import BoxHold
from bdgs_ros.detection.mask import dynamic_prior_image

_LOG = logging.getLogger(__name__)


class DetectionStage:
    """
    Detections cut with depth, joined with the class-agnostic geometric prior (section 3.2).

    Weights that cannot be used do not stop the stage: it says so once and goes on with the
    geometric prior alone.

    Parameters
    ----------
    config : DetectionConfig
        All parameters.
    detector : Detector, optional
        Used instead of the one that the configuration names.

    """

    def __init__(self, config: DetectionConfig, detector: Detector | None = None) -> None:
        self._config = config
        self._detector = detector or self._open(config)
        self._hold = BoxHold(config.hold)
        self._geometric = (
            GeometricPrior(config.warp, DirectEgoMotion(config.warp)) if config.geometric else None
        )
        self._count = 0

    @property
    def status(self) -> str:
        """What the stage works with, for diagnostics."""
        if isinstance(self._detector, NullDetector):
            alone = 'geometric prior alone' if self._geometric else 'no prior at all'
            return f'{alone}: {self._detector.name}'
        return self._detector.name

    @property
    def degraded(self) -> bool:
        """Whether a detector was asked for and is not working."""
        return bool(self._config.weights) and isinstance(self._detector, NullDetector)

    def process(self, frame: RgbdFrame) -> Labels:
        """
        Return the dynamic prior of a frame.

        Parameters
        ----------
        frame : RgbdFrame
            Stamps increase from call to call; `reset` after a jump back.

        Returns
        -------
        labels : Labels
            Stamp of the frame, P(dynamic) x 255 at its size, and the detections.

        """
        found = self._detect(frame)
        p_dynamic = dynamic_prior_image(found, frame.depth_m, self._config.cut)
        if self._geometric is not None:
            p_dynamic = combine(p_dynamic, self._geometric.process(frame, p_dynamic))
        return Labels(frame.stamp_ns, p_dynamic, tuple(found))

    def reset(self) -> None:
        """Forget earlier frames; a detector that failed stays off."""
        self._hold.reset()
        self._count = 0
        if self._geometric is not None:
            self._geometric.reset()

    def _detect(self, frame: RgbdFrame) -> list[Detection]:
        skip = self._count % self._config.hold.interval != 0
        self._count += 1
        if skip:
            return self._hold.coast(frame.camera.shape)
        try:
            found = self._detector.detect(frame.color)
        except ModelError as error:
            self._detector = self._give_up(error)
            self._hold.reset()
            return []
        return self._hold.update(found, frame.camera.shape)

    def _open(self, config: DetectionConfig) -> Detector:
        try:
            return make_detector(config)
        except ModelError as error:
            return self._give_up(error)

    @staticmethod
    def _give_up(error: ModelError) -> Detector:
        _LOG.warning('detector failed, going on with the geometric prior alone: %s', error)
        return NullDetector(f'detector failed: {error}')


def combine(a: ProbabilityImage, b: ProbabilityImage) -> ProbabilityImage:
    """
    Join two priors about the same pixels as independent evidence: 1 - (1 - a)(1 - b).

    Parameters
    ----------
    a, b : ndarray, shape (H, W), uint8
        Probabilities x 255; 0 says nothing.

    """
    if not b.any():
        return a
    static = (255 - a.astype(np.uint16)) * (255 - b.astype(np.uint16))
    return np.asarray(255 - (static + 127) // 255, dtype=np.uint8)
