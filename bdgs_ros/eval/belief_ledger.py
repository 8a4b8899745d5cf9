"""Follow every Gaussian of a run and compare what is believed of it with what is true."""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass, field
from typing import Any, Protocol

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import DepthImage, Pose, RgbdFrame, TrackingResult
from bdgs_ros.eval.belief_score import BeliefScore
from bdgs_ros.eval.gaussian_truth import (
    Projection,
    Sight,
    TrueState,
    near_surface,
    project,
    sight,
    true_states,
)
from bdgs_ros.eval.metric import Metric
from bdgs_ros.eval.restoration import Restorations

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

VIEWS = 3  # keyframes of evidence after which a Gaussian is judged
_RENDER_WIDTH = 320
_SEEN = 0.5  # silhouette above which the map says something about a pixel


class Gaussians(Protocol):
    """The map; see `bdgs_ros.mapping.gaussians.GaussianMap`."""

    serial: Index

    @property
    def means(self) -> Array:
        """Centres in world, [N, 3]."""

    def visible_mask(self) -> Mask:
        """Return which are rendered, [N]."""


class MapOwner(Protocol):
    """Whoever keeps the map; see `bdgs_ros.mapping.mapper.Mapper`."""

    map: Any
    removed_by_belief: Any
    """Serial numbers of the Gaussians that the last keyframe deleted for their belief."""

    def final_pose(self, stamp_ns: int, T_world_camera: Pose) -> Pose:
        """Return a pose with what mapping found out after tracking gave it."""

    def render(self, T_world_camera: Pose, camera: PinholeCamera) -> Any:
        """Render what is believed to be static."""

    def render_everything(self, T_world_camera: Pose, camera: PinholeCamera) -> Any:
        """Render also what is hidden."""


class ObjectTruth(Protocol):
    """What is known of a synthetic recording; see `bdgs_ros.data.synth.truth.SynthTruth`."""

    def dynamic(self, stamp_ns: int) -> Mask:
        """Return which pixels see something that moves, (H, W)."""

    def object_id(self, stamp_ns: int) -> NDArray[np.uint8]:
        """Return the object that each pixel sees, (H, W)."""

    def static_depth(self, stamp_ns: int) -> DepthImage:
        """Return the depth without anything that moves, (H, W)."""


@dataclass
class _Books:
    """What is remembered of each Gaussian ever seen, by serial number, [S]."""

    truth: NDArray[np.uint8] = field(default_factory=lambda: np.zeros(0, np.uint8))
    views: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    """Keyframes that saw it since its truth changed, that of its birth not counted."""
    judged: Mask = field(default_factory=lambda: np.zeros(0, bool))
    alive: Mask = field(default_factory=lambda: np.zeros(0, bool))
    removed: Mask = field(default_factory=lambda: np.zeros(0, bool))
    """Deleted because of its belief."""
    shown: Mask = field(default_factory=lambda: np.zeros(0, bool))
    is_thing: Mask = field(default_factory=lambda: np.zeros(0, bool))
    """Was once seen on something that no detector knows."""
    tainted: Mask = field(default_factory=lambda: np.zeros(0, bool))
    """Born on something that moved close before a static surface: nobody can tell which it is."""
    means: Array = field(default_factory=lambda: np.zeros((0, 3), np.float32))

    def grow(self, count: int) -> None:
        more = count - len(self.truth)
        if more <= 0:
            return
        for name, old in list(vars(self).items()):
            setattr(self, name, np.concatenate([old, np.zeros((more, *old.shape[1:]), old.dtype)]))


class BeliefLedger:
    """
    Observer of a run that scores the belief of each Gaussian against exact truth.

    A Gaussian is judged once it was visible in three keyframes since its truth last changed,
    that of its birth not counted; or when its belief has it deleted before. What is deleted for
    other reasons (faint, merged) leaves unjudged.

    Parameters
    ----------
    mapper : Mapper
        Asked after each keyframe.
    truth : SynthTruth
        Of the recording.
    things : collection of int
        Object ids of what no detector knows, for `unknown_recall`.

    """

    def __init__(self, mapper: MapOwner, truth: ObjectTruth, things: Collection[int] = ()) -> None:
        self._mapper = mapper
        self._truth = truth
        self._things = list(things)
        self._books = _Books()
        self._waits = Restorations()
        self._judgements = np.zeros((2, 2, 2), np.int64)  # is a thing, is dynamic, is called so
        self._hidden_percent: list[float] = []

    def __call__(self, frame: RgbdFrame, tracking: TrackingResult) -> None:
        """Take the outcome of one frame; only keyframes change the map."""
        if not tracking.is_keyframe:
            return
        stamp_ns, gaussians = frame.stamp_ns, self._mapper.map
        pose = self._mapper.final_pose(stamp_ns, tracking.T_world_camera)
        self._books.grow(int(gaussians.serial.max(initial=-1)) + 1)
        self._bury(frame, pose, gaussians.serial)
        self._follow(frame, pose, gaussians)
        self._compare_renders(stamp_ns, pose, frame.camera)

    def score(self) -> BeliefScore:
        """Return the counts of the run so far."""
        books, (known, thing) = self._books, self._judgements
        static = (books.alive | books.removed) & (books.truth == TrueState.STATIC)
        both = known + thing
        return BeliefScore(
            true_positives=int(both[1, 1]),
            false_positives=int(both[0, 1]),
            false_negatives=int(both[1, 0]),
            true_negatives=int(both[0, 0]),
            thing_positives=int(thing[1, 1]),
            thing_negatives=int(thing[1, 0]),
            statics=int(static.sum()),
            statics_removed=int((static & (books.removed | ~books.shown)).sum()),
            **{
                **self._waits.counts,
                'unresolved': self._waits.counts['unresolved'] + self._waits.open_waits(),
            },
        )

    def metrics(self) -> list[Metric]:
        """Return the ratios, and the share of the static image that belief hides."""
        hidden = self._hidden_percent
        share = float(np.mean(hidden)) if hidden else float('nan')
        return [*self.score().metrics(), Metric('hidden_static', share, '%')]

    def _bury(self, frame: RgbdFrame, pose: Pose, present: Index) -> None:
        """Settle the accounts of Gaussians that the last keyframe took out of the map."""
        books = self._books
        gone = books.alive.copy()
        gone[present] = False
        serial = np.flatnonzero(gone)
        books.alive[serial] = False
        by_belief = np.isin(serial, self._mapper.removed_by_belief)
        self._waits.deleted(serial[by_belief], serial[~by_belief])
        removed = serial[by_belief]
        states, seen = self._look(frame, pose, books.means[removed], books.tainted[removed])
        self._learn_truth(removed, np.where(seen.visible, states, TrueState.UNKNOWN))
        books.removed[removed] = True
        self._judge(removed[~books.judged[removed]], called=True)

    def _follow(self, frame: RgbdFrame, pose: Pose, gaussians: Gaussians) -> None:
        """Compare the Gaussians that are in the map with the truth of this keyframe."""
        books, serial = self._books, gaussians.serial
        new = ~books.alive[serial]
        books.alive[serial] = True
        books.means[serial] = gaussians.means
        shown = gaussians.visible_mask()
        books.shown[serial] = shown
        at = project(gaussians.means, pose, frame.camera)
        states, seen = self._look(frame, pose, gaussians.means, books.tainted[serial])
        moving = self._truth.dynamic(frame.stamp_ns)[at.row, at.column] & seen.met
        near_static = moving & (states == TrueState.STATIC)
        books.tainted[serial[new & near_static]] = True
        states[near_static] = TrueState.UNKNOWN
        self._mark_things(frame.stamp_ns, serial, at, seen)
        self._learn_truth(serial, states)
        evident = seen.visible & (states != TrueState.UNKNOWN) & ~new
        books.views[serial[evident]] += 1
        due = evident & ~books.judged[serial] & (books.views[serial] >= VIEWS)
        self._judge(serial[due & shown], called=False)
        self._judge(serial[due & ~shown], called=True)
        static = books.truth[serial] == TrueState.STATIC
        here = seen.met & (states == TrueState.STATIC)
        self._waits.note(frame.stamp_ns, serial, static, here, shown)

    def _look(
        self, frame: RgbdFrame, pose: Pose, means: Array, tainted: Mask
    ) -> tuple[NDArray[np.uint8], Sight]:
        """Return the true states of some Gaussians at a keyframe, and what it sees of them."""
        at = project(means, pose, frame.camera)
        states = true_states(at, self._truth.static_depth(frame.stamp_ns))
        states[tainted & (states == TrueState.STATIC)] = TrueState.UNKNOWN
        return states, sight(at, frame.depth_m)

    def _mark_things(self, stamp_ns: int, serial: Index, at: Projection, seen: Sight) -> None:
        if self._things:
            seen_id = self._truth.object_id(stamp_ns)[at.row, at.column]
            self._books.is_thing[serial[seen.met & np.isin(seen_id, self._things)]] = True

    def _learn_truth(self, serial: Index, states: NDArray[np.uint8]) -> None:
        books = self._books
        changed = (states != TrueState.UNKNOWN) & (states != books.truth[serial])
        at = serial[changed]
        books.truth[at] = states[changed]
        books.views[at] = 0
        books.judged[at] = False

    def _judge(self, serial: Index, called: bool) -> None:
        books = self._books
        serial = serial[books.truth[serial] != TrueState.UNKNOWN]
        kind = 2 * books.is_thing[serial] + (books.truth[serial] == TrueState.DYNAMIC)
        self._judgements[:, :, int(called)] += np.bincount(kind, minlength=4).reshape(2, 2)
        books.judged[serial] = True

    def _compare_renders(self, stamp_ns: int, pose: Pose, camera: PinholeCamera) -> None:
        """Note the share of the static pixels that the map knows but belief does not show."""
        small = camera.scaled(min(1.0, _RENDER_WIDTH / camera.width))
        everything = self._mapper.render_everything(pose, small)
        wanted = _shrunk(self._truth.static_depth(stamp_ns), small)
        moving = _shrunk(self._truth.dynamic(stamp_ns).astype(np.uint8), small) > 0
        surface = everything.depth / np.maximum(everything.silhouette, np.float32(1e-6))
        known = (everything.silhouette > _SEEN) & ~moving
        known &= np.abs(surface - wanted) < near_surface(wanted)
        if known.any():
            shown = self._mapper.render(pose, small).silhouette > _SEEN
            self._hidden_percent.append(100.0 * float((known & ~shown).sum() / known.sum()))


def _shrunk(image: NDArray[Any], camera: PinholeCamera) -> NDArray[Any]:
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST))
