"""
Bundle adjustment and loop closure over keyframes, beside mapping, never in the path of a frame.

Each keyframe is joined with the newest ones, with older ones that show the same, and with a place
recognised by its features. Each pair is condensed to a quadratic (`pair`); after each keyframe
all poses and the camera's calibration are solved for (`graph`).
"""

from __future__ import annotations

import logging
import math
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from typing import TypeGuard

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.back_end.calibration import Calibration, Known
from bdgs_ros.back_end.check import objection
from bdgs_ros.back_end.corners import Corners, Shared, View, find_corners, follow, overlap
from bdgs_ros.back_end.graph import Edge, Solution, pair_errors, solve
from bdgs_ros.back_end.loop import LoopDetector, Recognised, agree
from bdgs_ros.back_end.pair import PairFactor, condense
from bdgs_ros.back_end.velocity import velocity_at
from bdgs_ros.core import se3
from bdgs_ros.core.config.back_end import BackEndConfig
from bdgs_ros.core.types import Keyframe, Pose

Array = NDArray[np.float64]

_log = logging.getLogger(__name__)

_RECENT = 300  # poses of frames: keyframes may come late
_HURRIED_WINDOW, _HURRIED_OLDER = 2, 1  # that a new one is joined with when the next one waits
_NEWEST = 8  # keyframes that stay, and are no places to be recognised
_UNLOOKED = 3  # keyframes in a row, in a hurry, whose features wait: places come seldom
_RENEWED = 12  # pairs condensed again at a keyframe, at most
_OFF_RAD = 0.002  # how far the images of a pair may be bent otherwise than it was condensed with
_OVERCONFIDENT = 3.0  # pairs share velocities, so their errors are not independent
_LEAST_SIGMA_S = 0.001
_SAVED_SIGMA_S = 0.002  # of a readout that a map was saved with
_NEAR_M, _NEAR_RAD = 2.0, 0.8  # keyframes further apart are not asked what they share
_FEW_INLIERS = 0.5  # of the followed corners, for a recognised place to be believed
_FAR_M, _FAR_RAD = 1.0, 0.5  # from where its corners were followed: no pair is there
_FASTEST = (5.0, 10.0)  # m/s and rad/s; a hand is slower, a correction amid the frames is not
_TRIES = 3  # of a solution that is refused, each without the pairs that fit worst
_FITS_AS_BADLY = 0.1  # as the worst
_METRES_PER_RADIAN = 2.0  # a turn moves the view as far as this at usual depths


@dataclass
class _Pair:
    """Two keyframes, newer and older, and the corners of the newer one that both show."""

    shared: Shared
    factor: PairFactor


class BackEnd:
    """
    Makes keyframes agree with each other.

    Parameters
    ----------
    config : BackEndConfig
        Sizes and noise.
    hurried : callable
        Asked at each keyframe whether the next one waits already; then it is joined with few
        others, and places that it might show are looked for at every third keyframe.

    """

    def __init__(self, config: BackEndConfig, hurried: Callable[[], bool] = lambda: False) -> None:
        self._config = config
        self._hurried = hurried
        self._known = Known(Calibration.perfect(), config.bundle.readout_sigma_s)
        self.calibration = self._known.calibration
        self._readout_sigma_s = self._known.readout_sigma_s
        self.reset()

    def reset(self) -> None:
        """Forget all keyframes. The camera is the same: its calibration stays."""
        self._known = Known(self.calibration, self._readout_sigma_s)
        self.loops = 0
        """How many recognised places were joined."""
        self.refusals = 0
        """How many solutions were not believed; all poses stayed where they were."""
        self.refused_in_row = 0
        """How many since the last one that was."""
        self._recent: deque[tuple[int, Pose]] = deque(maxlen=_RECENT)
        self._views: dict[int, View] = {}
        self._poses: dict[int, Pose] = {}
        self._pairs: dict[tuple[int, int], _Pair] = {}
        self._follows: dict[int, int] = {}  # keyframes that were dropped: whom they move with
        self._loop = LoopDetector(self._config.loop)
        self._unlooked: deque[Keyframe] = deque(maxlen=_UNLOOKED)  # by the detector of loops
        self._suspected: Recognised | None = None  # by the last keyframe, and not yet believed

    def start_from(self, readout_s: float | None) -> None:
        """Begin with what a saved map knows of the shutter; None or 0 where it knows nothing."""
        if readout_s:
            self.calibration = replace(self.calibration, readout_s=readout_s)
            self._readout_sigma_s = _SAVED_SIGMA_S
        self.reset()

    def observe(self, stamp_ns: int, T_world_camera: Pose) -> None:
        """Take the pose of every tracked frame, in order of time: they tell velocities."""
        if not self._recent or stamp_ns > self._recent[-1][0]:
            self._recent.append((stamp_ns, T_world_camera))

    def process(self, keyframe: Keyframe, poses: Mapping[int, Pose]) -> dict[int, Pose]:
        """
        Take a new keyframe, and say how it and the earlier ones should move.

        Parameters
        ----------
        keyframe : Keyframe
            Newer than all others; its pose as tracking gave it.
        poses : mapping of int to ndarray, shape (4, 4)
            Present `T_world_camera` of earlier keyframes by stamp (ns): mapping moves them too.

        Returns
        -------
        transforms : dict of int to ndarray, shape (4, 4)
            `T_new_old` in world by stamp, of all keyframes that ever were; empty where nothing
            moves, or where nothing that was found can be believed.

        """
        if not self._config.bundle.enabled:
            return {}
        stamp_ns = keyframe.frame.stamp_ns
        if not se3.are_rigid(np.array([keyframe.T_world_camera, *poses.values()])):
            self._refuse('keyframes came with poses that are no motions')
            return {}
        # What is off SO(3) would be off twice as far after each correction.
        self._poses = {
            known: se3.orthonormalise(poses.get(known, pose))
            for known, pose in self._poses.items()
        }
        self.observe(stamp_ns, keyframe.T_world_camera)
        self._follow_velocity()
        view = View.of(keyframe, self._velocity(stamp_ns))
        corners = find_corners(view, self._config.bundle)
        self._poses[stamp_ns] = se3.orthonormalise(keyframe.T_world_camera)
        self._views[stamp_ns] = view
        self._unlooked.append(keyframe)
        hurried = self._hurried()
        self._join_all(corners, self._partners(corners, hurried))
        if self._config.loop.enabled and (not hurried or len(self._unlooked) == _UNLOOKED):
            self._close_loop(corners)
        if not hurried:
            self._renew()
        transforms = self._solve()
        self._drop_redundant()
        return transforms

    @property
    def readout_s(self) -> float:
        """
        The readout time as far as it is known: 0 while it might as well be.

        It is the positive-part estimator of James and Stein (1961) for a single number.
        """
        measured_s = self.calibration.readout_s
        doubt = 2 * self._readout_sigma_s / max(abs(measured_s), self._readout_sigma_s)
        return measured_s * max(1 - doubt**2, 0.0)

    def sweep(self, stamp_ns: int) -> Array:
        """Return the motion while a keyframe was read out, (rho, phi) in its frame, [6]."""
        view = self._views.get(stamp_ns)
        return np.zeros(6) if view is None else self.readout_s * view.twist

    def _follow_velocity(self) -> None:
        """Measure the velocity at the last keyframe again: what came after it is known now."""
        if not self._views:
            return
        stamp_ns, view = next(reversed(self._views.items()))
        self._views[stamp_ns] = replace(view, twist=self._velocity(stamp_ns))

    def _velocity(self, stamp_ns: int) -> Array:
        """Return (v, w) at a keyframe, 0 where the poses around it jump."""
        twist = velocity_at(stamp_ns, self._recent)
        is_slow = np.linalg.norm(twist.reshape(2, 3), axis=1) < _FASTEST
        return twist if is_slow.all() else np.zeros(6)

    def _relative(self, other: int, one: int) -> Pose:
        """Return T_other_one as it is now."""
        return se3.inverse(self._poses[other]) @ self._poses[one]

    def _partners(self, corners: Corners, hurried: bool) -> list[int]:
        """Return the window, and the older keyframes that show most of the corners."""
        config = self._config.bundle
        if hurried:
            config = replace(
                config,
                window=min(config.window, _HURRIED_WINDOW),
                older=min(config.older, _HURRIED_OLDER),
            )
        stamp_ns = corners.view.stamp_ns
        earlier = [known for known in self._views if known != stamp_ns]
        window, older = earlier[-config.window :], earlier[: -config.window]
        near = [known for known in older if _are_near(self._relative(known, stamp_ns))]
        shares = [
            overlap(corners, self._views[known], self._relative(known, stamp_ns)) for known in near
        ]
        order = np.argsort(-np.array(shares), kind='stable')[: config.older]
        return window + [near[i] for i in order if shares[i] >= config.overlap]

    def _join_all(self, corners: Corners, others: Sequence[int]) -> None:
        for other in others:
            self._join(corners, other, self._relative(other, corners.view.stamp_ns))

    def _join(self, corners: Corners, other: int, T_other_one: Pose) -> bool:
        """Add a pair, if the other keyframe shows enough of the corners."""
        config = self._config.bundle
        shared = follow(corners, self._views[other], T_other_one)
        if len(shared) < config.least_shared:
            return False
        factor = self._condense(shared, corners.view.stamp_ns, other, T_other_one)
        if not _is_credible(factor, shared, T_other_one):
            return False
        self._pairs[corners.view.stamp_ns, other] = _Pair(shared, factor)
        return True

    def _condense(self, shared: Shared, one: int, other: int, T_other_one: Pose) -> PairFactor:
        views = self._views[one], self._views[other]
        return condense(
            shared,
            T_other_one,
            (views[0].twist, views[1].twist),
            self.calibration,
            self._readout_sigma_s,
            views[1].camera.fx,
            self._config.bundle,
        )

    def _close_loop(self, corners: Corners) -> None:
        """Join a place that the present poses do not bring together with the new keyframe."""
        stamp_ns = corners.view.stamp_ns
        for keyframe in self._unlooked:
            self._loop.add(keyframe)
        self._unlooked.clear()
        joined = {old for new, old in self._pairs if new == stamp_ns}
        window = list(self._views)[-_NEWEST - 1 :]
        among = [
            known
            for known in self._views
            if known not in joined and known not in window and self._loop.knows(known)
        ]
        found = self._loop.find(stamp_ns, among) if among else None
        if self._is_believed(found) and self._join(corners, found.stamp_ns, found.T_earlier_new):
            self.loops += 1
        self._suspected = found

    def _is_believed(self, found: Recognised | None) -> TypeGuard[Recognised]:
        """Return whether a place is sure, or the keyframe before says the same."""
        if found is None:
            return False
        if found.inliers >= self._config.loop.sure_inliers:
            return True
        return self._suspected is not None and agree(self._suspected, found, self._poses)

    def _renew(self) -> None:
        """Condense again the pairs whose velocities or readout have become the most wrong."""
        off = {key: self._off_rad(key) for key in self._pairs}
        worst = sorted(off, key=lambda key: -off[key])[:_RENEWED]
        for one, other in worst:
            if off[one, other] > _OFF_RAD:
                pair = self._pairs[one, other]
                start = pair.factor.T_other_one
                pair.factor = self._condense(pair.shared, one, other, start)
                if not _is_credible(pair.factor, pair.shared, start):
                    del self._pairs[one, other]

    def _off_rad(self, key: tuple[int, int]) -> float:
        """Return how far the images of a pair are bent otherwise than it was condensed with."""
        factor = self._pairs[key].factor
        readout_s = abs(self.calibration.readout_s) + self._readout_sigma_s
        wrong_s = abs(factor.held_readout_s - self.calibration.readout_s)
        return max(
            wrong_s * math.hypot(*self._views[stamp_ns].twist[3:])
            + readout_s * math.dist(self._views[stamp_ns].twist[3:], twist[3:])
            for stamp_ns, twist in zip(key, factor.twists, strict=True)
        )

    def _solve(self) -> dict[int, Pose]:
        """Solve for all poses; return what moves by enough."""
        stamps = list(self._poses)
        before = [self._poses[stamp_ns] for stamp_ns in stamps]
        solution = self._believed(stamps, before) if self._pairs else None
        if solution is None:
            return {}
        self.calibration = solution.calibration
        sigma_s = max(_OVERCONFIDENT * solution.readout_sigma_s, _LEAST_SIGMA_S)
        self._readout_sigma_s = min(sigma_s, self._known.readout_sigma_s)
        moved = {
            stamp_ns: new @ se3.inverse(old)
            for stamp_ns, new, old in zip(stamps, solution.poses, before, strict=True)
        }
        largest = max(
            np.linalg.norm(new[:3, 3] - old[:3, 3])
            for new, old in zip(solution.poses, before, strict=True)
        )
        if largest < self._config.least_m:
            return {}
        self._poses = dict(zip(stamps, solution.poses, strict=True))
        # Tracking follows the newest keyframe.
        T_new_old = moved[stamps[-1]]
        self._recent = deque([(s, T_new_old @ T) for s, T in self._recent], maxlen=_RECENT)
        return moved | {gone: moved[self._leader(gone)] for gone in self._follows}

    def _believed(self, stamps: Sequence[int], before: Sequence[Pose]) -> Solution | None:
        """Solve; without the pairs that fit worst if it cannot be believed with them."""
        place = {stamp_ns: i for i, stamp_ns in enumerate(stamps)}
        keys, why = list(self._pairs), ''
        for _ in range(_TRIES):
            edges = [Edge(place[one], place[o], self._pairs[one, o].factor) for one, o in keys]
            given = self.calibration, self._known, self._config.bundle
            solution = solve(before, edges, *given)
            why = objection(before, solution, edges, *given)
            if not why:
                self._pairs = {key: self._pairs[key] for key in keys}
                self.refused_in_row = 0
                return solution
            (error,) = pair_errors(edges, (before, self.calibration))
            fits = error < _FITS_AS_BADLY * error.max()
            keys = [key for key, is_kept in zip(keys, fits, strict=True) if is_kept]
            if not keys:
                break
        self._refuse(why)
        return None

    def _refuse(self, why: str) -> None:
        self.refusals += 1
        self.refused_in_row += 1
        _log.warning('correction refused (%d so far): %s', self.refusals, why)

    def _leader(self, stamp_ns: int) -> int:
        while stamp_ns in self._follows:
            stamp_ns = self._follows[stamp_ns]
        return stamp_ns

    def _drop_redundant(self) -> None:
        """Over the budget, the keyframe nearest to another one leaves and moves with that."""
        if len(self._views) <= self._config.keyframes:
            return
        stamps = list(self._views)
        gone, stays = _most_redundant([self._poses[s] for s in stamps])
        self._forget(stamps[gone], stamps[stays])

    def _forget(self, gone: int, leader: int) -> None:
        del self._views[gone], self._poses[gone]
        self._loop.forget(gone)
        self._follows[gone] = leader
        self._pairs = {key: pair for key, pair in self._pairs.items() if gone not in key}


def _is_credible(factor: PairFactor, shared: Shared, T_other_one: Pose) -> bool:
    """Return whether a pair fits its corners, and not by going elsewhere."""
    numbers = [factor.information.ravel(), factor.gradient, factor.T_other_one.ravel()]
    if not np.isfinite(np.concatenate(numbers)).all():
        return False
    change = factor.T_other_one @ se3.inverse(T_other_one)
    is_near = np.linalg.norm(change[:3, 3]) < _FAR_M and se3.rotation_angle_rad(change) < _FAR_RAD
    return bool(is_near and factor.inliers >= _FEW_INLIERS * len(shared))


def _are_near(T: Pose) -> bool:
    return bool(np.linalg.norm(T[:3, 3]) < _NEAR_M and se3.rotation_angle_rad(T) < _NEAR_RAD)


def _most_redundant(poses: Sequence[Pose]) -> tuple[int, int]:
    """Return which keyframe is nearest to another, and to which; not the first or a new one."""
    distance = se3.view_distances(poses, _METRES_PER_RADIAN)
    nearest = distance[1:-_NEWEST].min(axis=1)
    gone = 1 + int(np.argmin(nearest))
    return gone, int(np.argmin(distance[gone]))
