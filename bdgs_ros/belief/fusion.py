"""Evidence of several keyframes fused without counting any of it twice, Eq. 5, and Eq. 6."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief import filter as bayes
from bdgs_ros.belief.likelihood import Observation
from bdgs_ros.core import se3
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.types import Pose

Array = NDArray[np.float32]
Mask = NDArray[np.bool_]
Rows = NDArray[np.int64]


_MOST_LOG_ODDS = 10.0  # beyond, single precision does not tell beliefs apart


class State(IntEnum):
    """The decision of Eq. 6."""

    STATIC = 0
    UNCERTAIN = 1
    DYNAMIC = 2


def decide(
    belief: Array, margin: float, before: NDArray[np.uint8] | None = None
) -> NDArray[np.uint8]:
    """
    Return the `State` of each Gaussian, Eq. 6 with delta = `margin`, shape (N,).

    With the states `before`, a decision holds until the belief crosses 1/2: what hovers about a
    margin does not flicker.
    """
    state = np.full(belief.shape, State.UNCERTAIN, np.uint8)
    dynamic, static = belief > 0.5 + margin, belief < 0.5 - margin
    if before is not None:
        dynamic |= (before == State.DYNAMIC) & (belief > 0.5)
        static |= (before == State.STATIC) & (belief < 0.5)
    state[dynamic], state[static] = State.DYNAMIC, State.STATIC
    return state


def temporal_weight(decay_rate: float, elapsed_s: float) -> float:
    """Return w_k = exp(-alpha |t - t_k|) of Eq. 5."""
    return float(np.exp(-decay_rate * abs(elapsed_s)))


@dataclass(eq=False)
class View:
    """One remembered keyframe and what it said about each Gaussian."""

    observation: Observation
    evidence: Array
    """[N] log-likelihood ratios; 0 where not visible"""
    visible: Mask
    """[N]"""
    free: Mask
    """[N] where it looked through the Gaussian"""
    shared: dict[int, float] = field(default_factory=dict)
    """The edges of the co-visibility graph: `covisibility` by stamp of the other keyframe."""

    @property
    def stamp_ns(self) -> int:
        """Time of the keyframe."""
        return self.observation.stamp_ns

    def keep(self, mask: Mask) -> None:
        """Drop Gaussians."""
        self.evidence, self.visible = self.evidence[mask], self.visible[mask]
        self.free = self.free[mask]

    def append(self, count: int) -> None:
        """Add Gaussians about which nothing was said."""
        self.evidence = np.concatenate([self.evidence, np.zeros(count, np.float32)])
        nothing = np.zeros(count, bool)
        self.visible = np.concatenate([self.visible, nothing])
        self.free = np.concatenate([self.free, nothing])


def covisibility(a: Mask, b: Mask) -> float:
    """Return the overlap coefficient of two sets of visible Gaussians, each [N]."""
    smaller = min(np.count_nonzero(a), np.count_nonzero(b))
    return float(np.count_nonzero(a & b) / smaller) if smaller else 0.0


class BeliefTracker:
    """
    The belief of every Gaussian over time and views.

    The belief is held as a base, which has absorbed old evidence, plus the evidence of at most
    `config.views` remembered keyframes. The posterior of Eq. 5 is computed anew from both at
    each keyframe, so no observation enters twice. A keyframe that saw the scene from where an
    earlier one did (closer than tau_t and tau_r) takes its place; over the limit, the one that
    shares least with the newest goes. What they said is absorbed into the base.
    """

    def __init__(self, config: BeliefConfig) -> None:
        self._config = config
        self._base = np.zeros(0, np.float32)
        self._stamp_ns: int | None = None
        self.views: list[View] = []
        """Remembered keyframes, oldest first."""
        self.belief = np.zeros(0, np.float32)
        """[N] posterior P(dynamic)"""
        self.smoothed = np.zeros(0, np.float32)
        """[N] Eq. 10"""
        self.states = np.zeros(0, np.uint8)
        """[N] Eq. 6"""
        self.hidden = np.zeros(0, bool)
        """[N] where M_g of Eq. 11 is 0"""
        self.void = np.zeros(0, bool)
        """[N] never rendered, or looked through when last seen: these do not come back unseen"""

        self._waits = np.zeros(0, np.int32)  # keyframes that must still see a newcomer rest

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.belief)

    def append(self, initial: Array, smoothed: Array | None = None) -> None:
        """Add Gaussians with the given beliefs and smoothed beliefs, shape (M,)."""
        start = np.asarray(initial if smoothed is None else smoothed, np.float32)
        self._base = np.concatenate([self._base, bayes.logit(initial.astype(np.float32))])
        self.belief = np.concatenate([self.belief, initial.astype(np.float32)])
        self.smoothed = np.concatenate([self.smoothed, start])
        decided = decide(initial.astype(np.float32), self._config.margin)
        self.states = np.concatenate([self.states, decided])
        shown = bayes.render_mask(start, self._config.mask_threshold)
        self.hidden = np.concatenate([self.hidden, ~shown])
        self.void = np.concatenate([self.void, ~shown])
        self._waits = np.concatenate([self._waits, self._readmission(~shown)])
        for view in self.views:
            view.append(len(initial))

    def keep(self, mask: Mask) -> None:
        """Drop the Gaussians where `mask`, shape (N,), is False."""
        self._base, self.belief = self._base[mask], self.belief[mask]
        self.smoothed, self.hidden = self.smoothed[mask], self.hidden[mask]
        self.void, self.states = self.void[mask], self.states[mask]
        self._waits = self._waits[mask]
        for view in self.views:
            view.keep(mask)

    def pool(self, mean: Callable[[Array], Array]) -> None:
        """
        Replace groups of Gaussians by one each.

        Parameters
        ----------
        mean : callable
            Takes values of all Gaussians, shape (N,), to those of the groups, shape (M,).

        """

        def most(flags: Mask) -> Mask:
            return np.asarray(mean(flags.astype(np.float32)) > 0.5)

        self._base, self.belief = mean(self._base), mean(self.belief)
        self.smoothed, self.hidden = mean(self.smoothed), most(self.hidden)
        self.void = most(self.void)
        self._waits = self._readmission(most(self._waits > 0))
        self.states = decide(self.belief, self._config.margin)
        for view in self.views:
            view.evidence = mean(view.evidence)
            view.visible, view.free = most(view.visible), most(view.free)

    def observe(self, view: View) -> None:
        """
        Take what one keyframe says and recompute every belief, Eq. 1-6, 10 and 11.

        Parameters
        ----------
        view : View
            Its evidence is 0 where a Gaussian was not visible; those only decay.

        """
        self._decay_base(view.stamp_ns)
        view.shared = {
            other.stamp_ns: covisibility(view.visible, other.visible) for other in self.views
        }
        self._make_room(view)
        self.views.append(view)
        self.belief = self._posterior(slice(None))
        self.states = decide(self.belief, self._config.margin, self.states)
        self.smoothed = bayes.smooth(self.belief, self.smoothed, self._config.ema)
        self._mask()

    def recall(self, view: View, rows: Rows, said: View) -> None:
        """
        Take what a remembered keyframe says about Gaussians that came after it.

        It tells what they start from: call `restart` when all have been asked.

        Parameters
        ----------
        view : View
            The remembered keyframe.
        rows : ndarray of int, shape (M,)
            Which Gaussians.
        said : View
            About these, [M] each.

        """
        assert self._stamp_ns is not None
        view.visible[rows], view.free[rows] = said.visible, said.free
        self._base[rows] += self._weight(view, self._stamp_ns) * said.evidence

    def restart(self, rows: Rows) -> None:
        """
        Take the posterior of Gaussians that have just come as their smoothed belief.

        Keyframes that all saw a place empty say one thing, that something came since, so together
        they say no more than `config.max_memory_log_odds`, and as all that is old it fades by
        Eq. 4.
        """
        limit = self._config.max_memory_log_odds
        self._base[rows] = np.clip(self._base[rows], -limit, limit)
        self.belief[rows] = self._posterior(rows)
        self.states[rows] = decide(self.belief[rows], self._config.margin)
        self.smoothed[rows] = self.belief[rows]
        threshold = self._config.mask_threshold
        self.hidden[rows] = ~bayes.render_mask(self.smoothed[rows], threshold)
        self.void[rows] = self.hidden[rows]
        self._waits[rows] = self._readmission(self.hidden[rows])

    def overwrite(self, belief: Array, where: Mask) -> None:
        """Set beliefs without any filtering, for runs that switch the filter off (Table 6)."""
        self.belief = np.where(where, belief, self.belief).astype(np.float32)
        self.states = decide(self.belief, self._config.margin)
        self.restart_smoothing(self.belief.copy())

    def restart_smoothing(
        self, smoothed: Array, hidden: Mask | None = None, void: Mask | None = None
    ) -> None:
        """Set the smoothed beliefs, shape (N,), and what is hidden: by them alone if not given."""
        self.smoothed = smoothed
        by_threshold = ~bayes.render_mask(smoothed, self._config.mask_threshold)
        self.hidden = by_threshold if hidden is None else hidden
        self.void = self.hidden.copy() if void is None else void

    def seen_through(self, rows: Rows | slice = slice(None)) -> Array:
        """Return the share of the remembered keyframes that looked through Gaussians, [M]."""
        visible = np.zeros_like(self.belief[rows])
        free = np.zeros_like(visible)
        for view in self.views:
            free += view.free[rows]
            visible += view.visible[rows]
        return np.asarray(free / np.maximum(visible, 1), np.float32)

    def _mask(self) -> None:
        """
        Apply Eq. 11; what is hidden comes back only some way below the threshold.

        A belief that fades because nobody looks brings a Gaussian back too, but not one that was
        looked through when it was last seen, or that was never rendered: it is a ghost until it
        is seen in its place. What comes hidden must be seen to rest in some keyframes in a row:
        who stands still for one of them is no furniture.
        """
        newest, config = self.views[-1], self._config
        self.void = np.where(newest.visible, newest.free, self.void)
        rests = newest.visible & ~newest.free
        self._waits = np.where(rests, np.maximum(self._waits - 1, 0), self._waits)
        broken = newest.free & (self._waits > 0)
        self._waits = np.where(broken, config.readmission, self._waits).astype(np.int32)
        back = np.float32(config.mask_threshold - config.mask_hysteresis)
        limit = np.where(self.hidden, back, np.float32(config.mask_threshold))
        ghost = self.hidden & self.void & ~newest.visible
        self.hidden = ghost | (self._waits > 0) | (self.smoothed >= limit)

    def _readmission(self, newcomers: Mask) -> NDArray[np.int32]:
        return np.where(newcomers, self._config.readmission, 0).astype(np.int32)

    @property
    def _limit(self) -> float:
        return self._config.max_log_odds

    def _decay_base(self, stamp_ns: int) -> None:
        """Eq. 4 on what is known from before the remembered views."""
        if self._stamp_ns is not None:
            elapsed_s = (stamp_ns - self._stamp_ns) * 1e-9
            predicted = bayes.predict(
                bayes.sigmoid(self._base), self._config.decay_rate, elapsed_s
            )
            self._base = bayes.logit(predicted)
        self._stamp_ns = stamp_ns

    def _make_room(self, new: View) -> None:
        """Absorb views from the same place, and over the limit those that share least."""
        pose = new.observation.T_world_camera
        for view in list(self.views):
            if not self._diverse(view.observation.T_world_camera, pose):
                self._absorb(view, new.stamp_ns)
        limit = self._config.views if self._config.multi_view else 1
        while len(self.views) >= limit:
            least = min(self.views, key=lambda view: new.shared[view.stamp_ns])
            self._absorb(least, new.stamp_ns)

    def _absorb(self, view: View, stamp_ns: int) -> None:
        absorbed = self._base + self._weight(view, stamp_ns) * view.evidence
        self._base = np.clip(absorbed, -self._limit, self._limit)
        self.views.remove(view)

    def _diverse(self, T_world_a: Pose, T_world_b: Pose) -> bool:
        T_a_b = se3.inverse(T_world_a) @ T_world_b
        turn = np.rad2deg(se3.rotation_angle_rad(T_a_b))
        move = float(np.linalg.norm(T_a_b[:3, 3]))
        return bool(
            move > self._config.diversity_translation or turn > self._config.diversity_rotation_deg
        )

    def _posterior(self, rows: Rows | slice) -> Array:
        """
        Return beliefs by Eq. 5: the sum of w_k z_k is the logarithm of its product.

        What was known before the newest keyframe is clamped, as beliefs are in OctoMap, so that
        one that shows a change can be heard.
        """
        known, newest = self._base[rows].copy(), self.views[-1]
        for view in self.views[:-1]:
            known += self._weight(view, newest.stamp_ns) * view.evidence[rows]
        predicted = np.clip(known, -self._limit, self._limit)
        return bayes.update(bayes.sigmoid(predicted), newest.evidence[rows], _MOST_LOG_ODDS)

    def _weight(self, view: View, stamp_ns: int) -> np.float32:
        elapsed_s = (stamp_ns - view.stamp_ns) * 1e-9
        return np.float32(temporal_weight(self._config.decay_rate, elapsed_s))
