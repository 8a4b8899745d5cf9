"""
Where the camera is, frame by frame, section 3.1 of the paper.

Predict, align to the last keyframe, see what moves, refine against the rendered static map,
decide whether the pose can be trusted and whether the frame becomes a keyframe. Where it cannot
be trusted the camera is lost: no pose is given, and it is looked for where it was last seen and
at the places it knows.
"""

from __future__ import annotations

import logging
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.config import TrackingConfig
from bdgs_ros.core.types import (
    Keyframe,
    Labels,
    ModelView,
    Pose,
    ProbabilityImage,
    RgbdFrame,
    TrackingResult,
    TrackingStatus,
)
from bdgs_ros.tracking import covariance
from bdgs_ros.tracking.align import Aligner, ImagePyramid, ResidualMaps
from bdgs_ros.tracking.broken import BrokenRows, without_rows
from bdgs_ros.tracking.keyframe_choice import KeyframeChoice
from bdgs_ros.tracking.loss import Evidence, LossTest
from bdgs_ros.tracking.motion import MotionPredictor
from bdgs_ros.tracking.movers import MoverMask, gone_from_model
from bdgs_ros.tracking.parts import Parts, find_world
from bdgs_ros.tracking.places import Place, Places
from bdgs_ros.tracking.starts import (
    Attempt,
    Estimate,
    Hypothesis,
    Reference,
    Start,
    information_of,
)

_log = logging.getLogger(__name__)

_START_SIGMA = (0.3, 0.3)  # m and rad: how well the start in a known map is known
_PLACE_SIGMA = (0.05, 0.03)  # of a pose from features
_SPEED = (1.0, 2.0)  # m/s and rad/s, from one frame to the next that shall confirm it
_LEAST_MOVED = 0.02  # of the view, that was not masked; less does not move the camera
_LEAST_MOVED_HURRIED = 0.1  # the same while newer frames wait: to align again costs a third
_MOST_TRACKED = 32  # keyframes; mapping that is further behind corrects nothing


class CameraTracker:
    """Camera pose of every frame, relative to keyframes and to the static map."""

    def __init__(self, config: TrackingConfig) -> None:
        self._config = config
        self._aligner = Aligner(config.align)
        self._refiner = Aligner(
            replace(
                config.align,
                intensity_noise=config.refine.intensity_noise,
                depth_weight=config.refine.depth_weight,
            )
        )
        self._motion = MotionPredictor(config.motion)
        self._movers = MoverMask(config.movers)
        self._broken = BrokenRows()
        self._readout_s = config.readout_s  # of the camera: outlives a reset
        self.refused = 0
        """How often mapping said what cannot be."""
        self._choice = KeyframeChoice(config.keyframe)
        self._loss = LossTest(config.loss)
        self._places = Places(config.places, config.features)
        self.reset()

    def reset(self) -> None:
        """Forget everything; the next frame is the first, and the origin of the world."""
        self._keyframe: Reference | None = None
        self._model: Reference | None = None
        self._tracked: dict[int, Pose] = {}  # keyframes whose view has not come yet
        self._doubt: dict[int, NDArray[np.float64]] = {}  # covariance of keyframes in world
        self._move: Pose | None = None  # of all that is known, since the last frame
        self._is_lost = False
        self._hypothesis: Hypothesis | None = None
        self._searchless = 0  # frames since places were looked at
        self.evidence: Evidence | None = None
        """Of the last frame, aligned where it was expected."""
        self._motion.reset()
        self._movers.reset()
        self._broken.reset()
        self._is_whole, self._is_hurried = True, False
        self._choice.begin(None)
        self._places.clear()

    def start_from(self, view: ModelView, keyframes: Iterable[Keyframe] = ()) -> None:
        """
        Begin in a map that exists: the first frame is aligned to a view of it.

        Parameters
        ----------
        view : ModelView
            Rendered from about where the camera is. Frames are LOST until one fits to it.
        keyframes : iterable of Keyframe
            Of the map; where the camera may be instead.

        """
        self.reset()
        self.set_model(view)
        self._is_lost = True
        for keyframe in keyframes:
            self._places.add(keyframe.frame, keyframe.T_world_camera, keyframe.p_dynamic)

    def learn(
        self, keyframes: Iterable[Keyframe], covariances: Iterable[NDArray[np.float64]]
    ) -> None:
        """
        Take keyframes that somebody else saw: places where the camera may be found.

        Parameters
        ----------
        keyframes : iterable of Keyframe
            In this world.
        covariances : iterable of ndarray, shape (6, 6)
            Of their poses.

        """
        for keyframe, spread in zip(keyframes, covariances, strict=True):
            self._places.add(keyframe.frame, keyframe.T_world_camera, keyframe.p_dynamic)
            self._doubt[keyframe.frame.stamp_ns] = spread

    def set_model(self, view: ModelView | None) -> None:
        """
        Take the static map as rendered at a keyframe, or None where there is no map.

        Mapping may have moved the keyframe a little; all that was tracked since moves with it.
        A view from where the keyframe cannot be is not taken.
        """
        if view is None or not self._may_be({view.stamp_ns: view.T_world_camera}):
            return
        self._follow(view)
        if view.readout_s is not None:
            self._readout_s = view.readout_s
        posterior = view.p_dynamic if self._config.refine.posterior else None
        pyramid = self._aligner.pyramid(view.color, view.depth_m, posterior, view.camera)
        self._model = Reference(view.stamp_ns, view.T_world_camera, pyramid)

    def _follow(self, view: ModelView) -> None:
        tracked = self._tracked.get(view.stamp_ns)
        if tracked is None:
            return
        T_new_old = se3.orthonormalise(view.T_world_camera @ se3.inverse(tracked))
        self._tracked = {
            stamp_ns: se3.orthonormalise(T_new_old @ pose)
            for stamp_ns, pose in self._tracked.items()
            if stamp_ns >= view.stamp_ns
        }
        self._places.put(self._tracked)
        self._move_present(self._tracked)

    def note_keyframes(self, poses: Mapping[int, Pose]) -> None:
        """
        Take where mapping has the keyframes now; what was seen from them moves along.

        Parameters
        ----------
        poses : mapping of int to ndarray, shape (4, 4)
            `T_world_camera` by stamp (ns). Newer keyframes move with the newest of them. None is
            taken if one is no motion, or moves what was tracked lately further than
            `se3.FARTHEST_CORRECTION_M`.

        """
        if not poses or not self._may_be(poses):
            return
        waiting = [stamp_ns for stamp_ns in poses if stamp_ns in self._tracked]
        if waiting:
            newest = max(waiting)
            T_new_old = poses[newest] @ se3.inverse(self._tracked[newest])
            for stamp_ns, pose in self._tracked.items():
                moved = se3.orthonormalise(T_new_old @ pose) if stamp_ns > newest else pose
                self._tracked[stamp_ns] = poses.get(stamp_ns, moved)
        known = {**poses, **self._tracked}
        if self._model is not None and self._model.stamp_ns in known:
            self._model = replace(self._model, T_world_camera=known[self._model.stamp_ns])
        self._places.put(known)
        self._move_present(known)

    def _may_be(self, poses: Mapping[int, Pose]) -> bool:
        """Return whether keyframes may be there; count and say where not."""
        known = dict(self._tracked)
        if self._keyframe is not None:
            known[self._keyframe.stamp_ns] = self._keyframe.T_world_camera
        old = [known.get(stamp_ns, pose) for stamp_ns, pose in poses.items()]
        if se3.is_correction(old, list(poses.values())):
            return True
        self.refused += 1
        _log.warning('mapping moved keyframes where they cannot be (%d so far)', self.refused)
        return False

    def _move_present(self, poses: Mapping[int, Pose]) -> None:
        """Move the present with the keyframe that it is relative to."""
        if self._keyframe is None or self._keyframe.stamp_ns not in poses:
            return
        new = poses[self._keyframe.stamp_ns]
        if np.array_equal(new, self._keyframe.T_world_camera):
            return
        self._hypothesis = None
        T_new_old = se3.orthonormalise(new @ se3.inverse(self._keyframe.T_world_camera))
        self._motion.move(T_new_old)
        self._move = T_new_old if self._move is None else T_new_old @ self._move
        self._keyframe = replace(self._keyframe, T_world_camera=new)

    def take_move(self) -> Pose | None:
        """Return by what the present has been moved since the last call, T_new_old in world."""
        move, self._move = self._move, None
        return move

    def process(
        self, frame: RgbdFrame, labels: Labels | None = None, hurried: bool = False
    ) -> TrackingResult:
        """
        Estimate the camera pose of the next frame.

        Parameters
        ----------
        frame : RgbdFrame
            Newer than the last one.
        labels : Labels, optional
            Dynamic prior; without it every pixel may be static.
        hurried : bool
            Whether newer frames wait. To look for a lost camera at places takes as long as to
            track some frames, so it is then done in some of them (`tracking.places.patience`), at
            the likeliest place alone.

        Returns
        -------
        result : TrackingResult
            With status LOST the pose is the prediction and must not be used.

        """
        self._is_hurried = hurried
        prior = self._prior(frame, labels)
        missing = self._broken.share(frame.color)
        self._is_whole = missing == 0
        if missing:
            _log.warning(
                'image at stamp %d ns: %.0f %% are missing', frame.stamp_ns, 100 * missing
            )
            prior = without_rows(prior, missing)
        expected = np.maximum(prior, self._movers.expected(frame.camera.shape))
        sweep = self._readout_s * self._motion.velocity
        current = self._aligner.pyramid(frame.color, frame.depth_m, expected, frame.camera, sweep)
        if self._keyframe is None and not self._is_lost:
            return self._begin(frame, current, prior)
        self._choice.count()
        first: Attempt | None = None
        believed: Attempt | None = None
        for start in self._starts(frame, prior, hurried):
            attempt = self._attempt(start, frame.stamp_ns, current, prior)
            first = first or attempt
            if not self._objection(attempt):
                believed = attempt
                break
        assert first is not None
        self.evidence = self._loss.evidence(first.best.quality)
        return self._lose(frame, first) if believed is None else self._conclude(frame, believed)

    def compare(self, share: float) -> None:
        """Compare this share of the points of `tracking.align.max_points` from now on."""
        for aligner in (self._aligner, self._refiner):
            aligner.compare(share)

    def rest(self) -> None:
        """Do what can wait until the pose is out; call it after each frame, when there is time."""
        self._places.prepare()

    def _prior(self, frame: RgbdFrame, labels: Labels | None) -> ProbabilityImage:
        if labels is None or not self._config.masked:
            return np.zeros(frame.camera.shape, np.uint8)
        return labels.p_dynamic

    def _begin(
        self, frame: RgbdFrame, current: ImagePyramid, p_dynamic: ProbabilityImage
    ) -> TrackingResult:
        """Make the first frame that shows anything the origin of the world and a keyframe."""
        T_world_camera, spread = se3.identity(), 1e-6 * np.eye(6)
        if not (self._is_whole and self._loss.can_be_aligned_to(frame.depth_m, p_dynamic)):
            nowhere = np.asarray(np.linalg.inv(information_of(_START_SIGMA)))
            return TrackingResult(
                frame.stamp_ns,
                TrackingStatus.LOST,
                T_world_camera,
                nowhere,
                False,
                p_dynamic,
                0.0,
                0.0,
            )
        self._motion.update(frame.stamp_ns, T_world_camera, spread)
        self._become_keyframe(frame, T_world_camera, current, p_dynamic, spread)
        return TrackingResult(
            frame.stamp_ns,
            TrackingStatus.OK,
            T_world_camera,
            spread,
            True,
            p_dynamic,
            1.0,
            1.0,
        )

    def _starts(self, frame: RgbdFrame, prior: ProbabilityImage, hurried: bool) -> Iterator[Start]:
        """List where the camera may be, likeliest first; places cost time, so they are last."""
        if self._hypothesis is not None:
            yield self._confirming(self._hypothesis, frame.stamp_ns)
        if self._keyframe is not None:
            predicted, covariance = self._motion.predict(frame.stamp_ns)
            yield Start(self._keyframe, predicted, np.asarray(np.linalg.inv(covariance)))
        elif self._model is not None:
            pose = self._model.T_world_camera
            yield Start(self._model, pose, information_of(_START_SIGMA), is_far=True)
        self._searchless += 1
        if hurried and self._searchless <= self._config.places.patience:
            return
        self._searchless = 0
        sightings = self._places.find(frame, prior)
        for sighting in sightings[:1] if hurried else sightings:
            reference = self._recall(sighting.place)
            information = information_of(_PLACE_SIGMA)
            yield Start(reference, sighting.T_world_camera, information, is_far=True)

    def _confirming(self, hypothesis: Hypothesis, stamp_ns: int) -> Start:
        dt = (stamp_ns - hypothesis.stamp_ns) * 1e-9
        position, angle = (s + v * dt for s, v in zip(_PLACE_SIGMA, _SPEED, strict=True))
        return replace(
            hypothesis.start,
            T_world_camera=hypothesis.T_world_camera,
            information=information_of((position, angle)),
            confirms=True,
        )

    def _recall(self, place: Place) -> Reference:
        """Make a remembered keyframe a reference again."""
        pyramid = self._aligner.pyramid(
            place.grey, place.depth_m.astype(np.float32), place.p_dynamic, place.camera
        )
        return Reference(place.stamp_ns, place.T_world_camera, pyramid)

    def _attempt(
        self, start: Start, stamp_ns: int, current: ImagePyramid, prior: ProbabilityImage
    ) -> Attempt:
        """Align coarse to fine, see what moves, refine against the rendered static map."""
        first = self._align(start.reference, current, start.T_world_camera, start.information)
        parts = self._find_world(start, current, first)
        p_moving = None if parts is None else parts.large(prior, self._config.movers.p_dynamic)
        coarse, current, prior = self._align_world(start, current, prior, first, parts)
        maps = self._compare_to_model(current, coarse)
        p_dynamic = self._see_movers(prior, maps)
        sweep = self._sweep(stamp_ns, coarse)
        current = self._aligner.with_dynamic(current, p_dynamic, sweep)
        still = self._without_gone(current, p_dynamic, maps, sweep)
        fine = self._refine(still, coarse, start.information)
        spread = self._relative_covariance(parts, first, coarse, fine)
        return Attempt(start, current, coarse, fine, p_dynamic, spread, p_moving)

    def _relative_covariance(
        self, parts: Parts | None, first: Estimate, coarse: Estimate, best: Estimate
    ) -> NDArray[np.float64]:
        """Return how far the pose may be off relative to the keyframe."""
        if parts is None:
            return best.quality.covariance
        T_first = first.quality.T_current_reference
        step = se3.log(coarse.quality.T_current_reference @ se3.inverse(T_first))
        return covariance.of_alignment(
            parts.cells,
            parts.moved,
            step,
            best.quality.covariance,
            self._motion.velocity,
            self._config.covariance,
        )

    def _sweep(self, stamp_ns: int, coarse: Estimate) -> NDArray[np.float64]:
        """Return the motion during the readout of a rolling shutter, with this frame's own."""
        if not self._readout_s:  # nothing to find out: spare the filter an update
            return np.zeros(6)
        pose, covariance = coarse.T_world_camera, coarse.quality.covariance
        return self._readout_s * self._motion.velocity_with(stamp_ns, pose, covariance)

    def _align(
        self,
        reference: Reference,
        current: ImagePyramid,
        guess: Pose,
        information: NDArray[np.float64],
        expected: Pose | None = None,
        fine_only: bool = False,
    ) -> Estimate:
        """Align from a guess; `information` is of what was expected, by default the guess."""
        aligner = self._refiner if fine_only else self._aligner
        guess, expected = (
            se3.inverse(pose) @ reference.T_world_camera
            for pose in (guess, guess if expected is None else expected)
        )
        quality = aligner.align(
            reference.pyramid, current, guess, fine_only, information, expected
        )
        T_world_camera = reference.T_world_camera @ se3.inverse(quality.T_current_reference)
        return Estimate(se3.orthonormalise(T_world_camera), quality)

    def _find_world(self, start: Start, current: ImagePyramid, coarse: Estimate) -> Parts | None:
        """Ask which part of the view is the world, if parts of it move on their own."""
        if not (self._config.masked and self._config.parts.enabled):
            return None
        reference, quality = start.reference, coarse.quality
        cells = self._aligner.cells(reference.pyramid, current, quality)
        T_expected = se3.inverse(start.T_world_camera) @ reference.T_world_camera
        expected = se3.log(T_expected @ se3.inverse(quality.T_current_reference))
        return find_world(cells, expected, start.information, self._config.parts)

    def _align_world(
        self,
        start: Start,
        current: ImagePyramid,
        prior: ProbabilityImage,
        first: Estimate,
        parts: Parts | None,
    ) -> tuple[Estimate, ImagePyramid, ProbabilityImage]:
        """Mask what moves against the world, and align once more if it had a say."""
        if parts is None:
            return first, current, prior
        least = _LEAST_MOVED_HURRIED if self._is_hurried else _LEAST_MOVED
        had_no_say = parts.unnamed(prior).mean() <= least
        prior = np.maximum(prior, parts.mask(prior.shape, self._config.movers.p_dynamic))
        if had_no_say and not parts.is_other:
            return first, current, prior
        still = self._aligner.with_dynamic(current, prior)
        T_current_reference = se3.exp(parts.step) @ first.quality.T_current_reference
        guess = start.reference.T_world_camera @ se3.inverse(T_current_reference)
        found = self._align(start.reference, still, guess, start.information, start.T_world_camera)
        return found, still, prior

    def _compare_to_model(self, current: ImagePyramid, coarse: Estimate) -> ResidualMaps | None:
        if self._model is None or not self._config.masked:
            return None
        T_current_model = se3.inverse(coarse.T_world_camera) @ self._model.T_world_camera
        return self._aligner.residual_maps(self._model.pyramid, current, T_current_model)

    def _see_movers(self, prior: ProbabilityImage, maps: ResidualMaps | None) -> ProbabilityImage:
        """Join the prior with what stands nearer than the static map (class-agnostic prior)."""
        if maps is None:
            return prior
        return np.maximum(prior, self._movers.update(maps, prior.shape))

    def _without_gone(
        self,
        current: ImagePyramid,
        p_dynamic: ProbabilityImage,
        maps: ResidualMaps | None,
        sweep: NDArray[np.float64],
    ) -> ImagePyramid:
        """Return the image without what is seen through the static map."""
        if maps is None:
            return current
        gone = gone_from_model(maps, p_dynamic.shape, self._config.movers)
        if gone is None:
            return current
        return self._aligner.with_dynamic(current, np.maximum(p_dynamic, gone), sweep)

    def _refine(
        self, current: ImagePyramid, coarse: Estimate, information: NDArray[np.float64]
    ) -> Estimate:
        """Align to the rendered static map, starting from the coarse pose."""
        if self._model is None or not self._config.refine.enabled:
            return coarse
        fine = self._align(
            self._model, current, coarse.T_world_camera, information, fine_only=True
        )
        return coarse if self._loss.objection(fine.quality) else fine

    def _objection(self, attempt: Attempt) -> str:
        """Say in words why a pose is not to be believed; nothing where it is."""
        own = self._loss.objection(attempt.best.quality)
        return own or self._loss.contradiction(attempt.coarse, attempt.best)

    def _conclude(self, frame: RgbdFrame, attempt: Attempt) -> TrackingResult:
        """Believe a pose; where the camera was lost, only one that is sure or seen twice."""
        start, estimate = attempt.start, attempt.best
        was_lost = self._is_lost or start.is_far
        if was_lost and not (
            self._is_sure(frame, attempt) and self._can_be_keyframe(frame, attempt)
        ):
            self._hypothesis = Hypothesis(frame.stamp_ns, estimate.T_world_camera, start)
            return self._lost(frame, attempt)
        if was_lost:
            _log.warning('found again at stamp %d ns', frame.stamp_ns)
            self._motion.reset()
            self._is_lost, self._hypothesis = False, None
        self._motion.update(frame.stamp_ns, estimate.T_world_camera, estimate.quality.covariance)
        reference = start.reference
        spread = self._world_covariance(attempt, reference.stamp_ns, reference.T_world_camera)
        is_keyframe = start.is_far or (
            self._needs_keyframe(attempt) and self._can_be_keyframe(frame, attempt)
        )
        if is_keyframe:
            spread = self._least_covariance(attempt)
            self._become_keyframe(
                frame, estimate.T_world_camera, attempt.current, attempt.p_dynamic, spread
            )
        return _result(frame, attempt, TrackingStatus.OK, is_keyframe, spread)

    def _is_sure(self, frame: RgbdFrame, attempt: Attempt) -> bool:
        """Tell whether a frame before said the same: the camera is where it was about to go."""
        if attempt.start.confirms:
            return True
        if attempt.start.is_far or self._keyframe is None:
            return False
        best = attempt.best
        return self._motion.expects(frame.stamp_ns, best.T_world_camera, best.quality.covariance)

    def _world_covariance(
        self, attempt: Attempt, stamp_ns: int, T_world_reference: Pose
    ) -> NDArray[np.float64]:
        """Return how far the pose may be off in the world, if it is known by this keyframe."""
        T_reference_camera = se3.inverse(T_world_reference) @ attempt.best.T_world_camera
        doubt = self._doubt.get(stamp_ns, np.zeros((6, 6)))
        return covariance.chained(doubt, T_reference_camera, attempt.covariance)

    def _least_covariance(self, attempt: Attempt) -> NDArray[np.float64]:
        """Return the same by the surest of the keyframes that look at much the same."""
        best = attempt.best
        near = self._places.near(best.T_world_camera, best.quality.depth_m)
        reference = attempt.start.reference
        near[reference.stamp_ns] = reference.T_world_camera
        chains = [self._world_covariance(attempt, *place) for place in near.items()]
        return min(chains, key=lambda chain: float(np.trace(chain[:3, :3])))

    def _lose(self, frame: RgbdFrame, attempt: Attempt) -> TrackingResult:
        """No start led anywhere: the camera is lost, or stays so."""
        if not self._is_lost:
            _log.warning('lost at stamp %d ns: %s', frame.stamp_ns, self._objection(attempt))
        self._hypothesis = None
        return self._lost(frame, attempt)

    def _lost(self, frame: RgbdFrame, attempt: Attempt) -> TrackingResult:
        """Report loss; what was seen from a wrong pose says nothing about the next frame."""
        self._is_lost = True
        self._movers.reset()
        nowhere = np.asarray(np.linalg.inv(attempt.start.information))
        return _result(frame, attempt, TrackingStatus.LOST, False, nowhere)

    def _needs_keyframe(self, attempt: Attempt) -> bool:
        assert self._keyframe is not None
        T_keyframe_world = se3.inverse(self._keyframe.T_world_camera)
        T_keyframe_camera = T_keyframe_world @ attempt.best.T_world_camera
        return self._choice.is_due(T_keyframe_camera, attempt.coarse.quality.overlap)

    def _can_be_keyframe(self, frame: RgbdFrame, attempt: Attempt) -> bool:
        return self._is_whole and self._loss.can_be_aligned_to(frame.depth_m, attempt.p_dynamic)

    def _become_keyframe(
        self,
        frame: RgbdFrame,
        T_world_camera: Pose,
        pyramid: ImagePyramid,
        p_dynamic: ProbabilityImage,
        spread: NDArray[np.float64],
    ) -> None:
        self._doubt[frame.stamp_ns] = spread
        self._keyframe = Reference(frame.stamp_ns, T_world_camera, pyramid)
        self._tracked[frame.stamp_ns] = T_world_camera
        if len(self._tracked) > _MOST_TRACKED:
            del self._tracked[min(self._tracked)]
        self._choice.begin(frame)
        self._motion.look(self._choice.depth_m)
        self._places.add(frame, T_world_camera, p_dynamic)
        known = {place.stamp_ns for place in self._places} | {frame.stamp_ns}
        self._doubt = {stamp_ns: self._doubt[stamp_ns] for stamp_ns in known & self._doubt.keys()}


def _result(
    frame: RgbdFrame,
    attempt: Attempt,
    status: TrackingStatus,
    is_keyframe: bool,
    spread: NDArray[np.float64],
) -> TrackingResult:
    """Return what came of a frame; a lost one has no pose but where it was looked for."""
    found, start = attempt.best, attempt.start
    is_ok = status is TrackingStatus.OK
    return TrackingResult(
        frame.stamp_ns,
        status,
        found.T_world_camera if is_ok else start.T_world_camera,
        spread,
        is_keyframe,
        attempt.p_dynamic,
        found.quality.inlier_ratio,
        attempt.coarse.quality.overlap,
        attempt.p_moving,
    )
