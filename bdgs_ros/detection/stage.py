"""The detection stage: from a frame to the prior, per pixel, that it shows something moving."""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.detection import DetectionConfig
from bdgs_ros.core.errors import ModelError
from bdgs_ros.core.types import (
    DepthImage,
    Detection,
    Labels,
    Pose,
    ProbabilityImage,
    RgbdFrame,
)
from bdgs_ros.detection.detector import (
    Answer,
    Detector,
    LateDetector,
    NullDetector,
    make_detector,
)
from bdgs_ros.detection.ego_motion import DirectEgoMotion
from bdgs_ros.detection.geometric import GeometricPrior
from bdgs_ros.detection.late import AtOnce
from bdgs_ros.detection.mask import dynamic_prior_image
from bdgs_ros.detection.sighting import sightings
from bdgs_ros.detection.tracks import ObjectTracks

_LOG = logging.getLogger(__name__)


@dataclass(frozen=True)
class _Asked:
    """A frame whose answer is awaited."""

    depth_m: DepthImage
    camera: PinholeCamera
    T_odom_camera: Pose


class DetectionStage:
    """
    Detections cut with depth, joined with the class-agnostic geometric prior (section 3.2).

    The detector tells the object tracks what it sees, when it does; the masks of every frame come
    from the tracks. Weights that cannot be used do not stop the stage: it says so once and goes on
    with the geometric prior alone.

    Parameters
    ----------
    config : DetectionConfig
        All parameters.
    detector : Detector or LateDetector, optional
        Used instead of the one that the configuration names.
    runner : callable
        How a detector is made one that may answer late; by default it answers at once, so that
        results are repeatable.

    """

    def __init__(
        self,
        config: DetectionConfig,
        detector: Detector | LateDetector | None = None,
        runner: Callable[[Detector], LateDetector] = AtOnce,
    ) -> None:
        self._config = config
        self.tracks = ObjectTracks(config.tracks)
        self._mute: NullDetector | None = None
        self._detector = self._open(detector, runner)
        self._ego = DirectEgoMotion(config.warp)
        self._geometric = GeometricPrior(config.warp, self._ego) if config.geometric else None
        self._asked: dict[int, _Asked] = {}
        self._count = 0
        self.answer_ages_s: list[float] = []
        """Of the answers taken in with the last frame: how much newer that frame was."""

    @property
    def status(self) -> str:
        """What the stage works with, for diagnostics."""
        if self._mute is not None:
            alone = 'geometric prior alone' if self._geometric else 'no prior at all'
            return f'{alone}: {self._mute.name}'
        return self._detector.name

    @property
    def degraded(self) -> bool:
        """Whether a detector was asked for and is not working."""
        return bool(self._config.weights) and self._mute is not None

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
        T_odom_camera = self._ego.predicted
        self._ask(frame, T_odom_camera)
        still = self._listen(frame.stamp_ns)
        found = self.tracks.at(frame.stamp_ns, frame.camera, T_odom_camera) + still
        p_dynamic = dynamic_prior_image(found, frame.depth_m, self._config.cut)
        if self._geometric is not None:
            p_dynamic = combine(p_dynamic, self._geometric.process(frame, p_dynamic))
            self._place(frame.stamp_ns, T_odom_camera, self._geometric.T_odom_camera)
        return Labels(frame.stamp_ns, p_dynamic, tuple(found))

    def reset(self) -> None:
        """Forget earlier frames; a detector that failed stays off."""
        self._detector.reset()
        self.tracks.reset()
        self._asked.clear()
        self._count = 0
        if self._geometric is not None:
            self._geometric.reset()

    def close(self) -> None:
        """Stop the detector."""
        self._detector.close()

    def _ask(self, frame: RgbdFrame, T_odom_camera: Pose) -> None:
        """Offer the detector every n-th frame."""
        turn = self._count % self._config.tracks.interval == 0
        self._count += 1
        if not turn or self._mute is not None:
            return
        self._asked[frame.stamp_ns] = _Asked(frame.depth_m, frame.camera, T_odom_camera)
        try:
            self._detector.submit(frame.stamp_ns, frame.color)
        except ModelError as error:
            self._give_up(error)

    def _listen(self, stamp_ns: int) -> list[Detection]:
        """Take in what was answered; return what stands still by its class in this very frame."""
        try:
            answers = self._detector.poll()
        except ModelError as error:
            self._give_up(error)
            answers = []
        self.answer_ages_s = [(stamp_ns - a.stamp_ns) * 1e-9 for a in answers]
        for answer in answers:
            self._take_in(answer)
        oldest_ns = stamp_ns - round(self._config.tracks.longest_s * 1e9)
        self._asked = {s: asked for s, asked in self._asked.items() if s >= oldest_ns}
        now = [a for a in answers if a.stamp_ns == stamp_ns]
        return [d for a in now for d in a.detections if d.p_dynamic <= 0]

    def _take_in(self, answer: Answer) -> None:
        """Tell the tracks, at the time and place of the image."""
        asked = self._asked.pop(answer.stamp_ns, None)
        self._asked = {s: other for s, other in self._asked.items() if s > answer.stamp_ns}
        if asked is None:  # so late that nobody remembers the question
            return
        seen = sightings(answer.detections, asked.depth_m, asked.camera, self._config.cut)
        self.tracks.update(answer.stamp_ns, seen, asked.camera, asked.T_odom_camera)

    def _place(self, stamp_ns: int, expected: Pose, T_odom_camera: Pose | None) -> None:
        """Correct the place of the frame, now that the ego-motion is known."""
        if T_odom_camera is None:  # the odometry begins anew, where the camera is
            T_new_old = se3.inverse(expected)
            self.tracks.move(T_new_old)
            self._asked = {
                s: replace(asked, T_odom_camera=T_new_old @ asked.T_odom_camera)
                for s, asked in self._asked.items()
            }
        elif stamp_ns in self._asked:
            asked = self._asked[stamp_ns]
            self._asked[stamp_ns] = replace(asked, T_odom_camera=T_odom_camera)

    def _open(
        self,
        detector: Detector | LateDetector | None,
        runner: Callable[[Detector], LateDetector],
    ) -> LateDetector:
        if isinstance(detector, LateDetector):
            return detector
        try:
            chosen = detector or make_detector(self._config)
        except ModelError as error:
            return self._give_up(error)
        if isinstance(chosen, NullDetector):
            self._mute = chosen
            return AtOnce(chosen)
        return runner(chosen)

    def _give_up(self, error: ModelError) -> LateDetector:
        _LOG.warning('detector failed, going on with the geometric prior alone: %s', error)
        self._mute = NullDetector(f'detector failed: {error}')
        self._detector = AtOnce(self._mute)
        self.tracks.reset()
        return self._detector


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
