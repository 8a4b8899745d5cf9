"""Evidence of several keyframes fused without counting any of it twice, Eq. 5, and Eq. 6."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from enum import IntEnum

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief import filter as bayes
from bdgs_ros.core import se3
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.types import Pose

Array = NDArray[np.float32]


class State(IntEnum):
    """The decision of Eq. 6."""

    STATIC = 0
    UNCERTAIN = 1
    DYNAMIC = 2


def decide(belief: Array, margin: float) -> NDArray[np.uint8]:
    """Return the `State` of each Gaussian, Eq. 6 with delta = `margin`."""
    state = np.full(belief.shape, State.UNCERTAIN, np.uint8)
    state[belief > 0.5 + margin] = State.DYNAMIC
    state[belief < 0.5 - margin] = State.STATIC
    return state


def temporal_weight(decay_rate: float, elapsed_s: float) -> float:
    """Return w_k = exp(-alpha |t - t_k|) of Eq. 5."""
    return float(np.exp(-decay_rate * abs(elapsed_s)))


@dataclass
class _View:
    """One remembered keyframe: where and when it was, and what it said (0 where not visible)."""

    stamp_ns: int
    T_world_camera: Pose
    evidence: Array


class BeliefTracker:
    """
    The belief of every Gaussian over time and views.

    The belief is held as a base, which has absorbed old evidence, plus the evidence of at most
    `config.views` remembered keyframes. The posterior of Eq. 5 is computed anew from both at
    each keyframe, so no observation enters twice. A keyframe that saw the scene from where an
    earlier one did (closer than tau_t and tau_r) is absorbed into the base at once.
    """

    def __init__(self, config: BeliefConfig) -> None:
        self._config = config
        self._views: list[_View] = []
        self._base = np.zeros(0, np.float32)
        self._stamp_ns: int | None = None
        self.belief = np.zeros(0, np.float32)
        """[N] posterior P(dynamic)"""
        self.smoothed = np.zeros(0, np.float32)
        """[N] Eq. 10"""

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.belief)

    def append(self, initial: Array) -> None:
        """Add Gaussians with the given beliefs, shape (M,)."""
        initial = initial.astype(np.float32)
        self._base = np.concatenate([self._base, bayes.logit(initial)])
        self.belief = np.concatenate([self.belief, initial])
        self.smoothed = np.concatenate([self.smoothed, initial])
        nothing = np.zeros(len(initial), np.float32)
        for view in self._views:
            view.evidence = np.concatenate([view.evidence, nothing])

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Drop the Gaussians where `mask`, shape (N,), is False."""
        self._base = self._base[mask]
        self.belief = self.belief[mask]
        self.smoothed = self.smoothed[mask]
        for view in self._views:
            view.evidence = view.evidence[mask]

    def pool(self, mean: Callable[[Array], Array]) -> None:
        """
        Replace groups of Gaussians by one each.

        Parameters
        ----------
        mean : callable
            Takes values of all Gaussians, shape (N,), to those of the groups, shape (M,).

        """
        self._base = mean(self._base)
        self.belief = mean(self.belief)
        self.smoothed = mean(self.smoothed)
        for view in self._views:
            view.evidence = mean(view.evidence)

    def observe(self, stamp_ns: int, T_world_camera: Pose, evidence: Array) -> None:
        """
        Take the evidence of one keyframe and recompute every belief, Eq. 1-5 and 10.

        Parameters
        ----------
        stamp_ns : int
            Time of the keyframe.
        T_world_camera : ndarray, shape (4, 4)
            Its pose, for the choice of diverse views.
        evidence : ndarray, shape (N,)
            Log-likelihood ratios; 0 where a Gaussian was not visible.

        """
        self._decay_base(stamp_ns)
        self._make_room(T_world_camera, stamp_ns)
        self._views.append(_View(stamp_ns, T_world_camera, evidence.astype(np.float32)))
        self.belief = bayes.update(bayes.sigmoid(self._base), self._fused(stamp_ns), self._limit)
        self.smoothed = bayes.smooth(self.belief, self.smoothed, self._config.ema)

    def overwrite(self, belief: Array, where: NDArray[np.bool_]) -> None:
        """Set beliefs without any filtering, for runs that switch the filter off (Table 6)."""
        self.belief = np.where(where, belief, self.belief).astype(np.float32)
        self.smoothed = self.belief.copy()

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

    def _make_room(self, T_world_camera: Pose, stamp_ns: int) -> None:
        """Absorb the view that adds least: one from the same place, or the oldest."""
        limit = self._config.views if self._config.multi_view else 1
        similar = [v for v in self._views if not self._diverse(v.T_world_camera, T_world_camera)]
        for view in similar or self._views[: max(0, len(self._views) - limit + 1)]:
            self._absorb(view, stamp_ns)

    def _absorb(self, view: _View, stamp_ns: int) -> None:
        absorbed = self._base + self._weight(view, stamp_ns) * view.evidence
        self._base = np.clip(absorbed, -self._limit, self._limit)
        self._views = [v for v in self._views if v is not view]

    def _diverse(self, T_world_a: Pose, T_world_b: Pose) -> bool:
        T_a_b = se3.inverse(T_world_a) @ T_world_b
        turn = np.rad2deg(se3.rotation_angle_rad(T_a_b))
        move = float(np.linalg.norm(T_a_b[:3, 3]))
        return bool(
            move > self._config.diversity_translation or turn > self._config.diversity_rotation_deg
        )

    def _fused(self, stamp_ns: int) -> Array:
        """Sum w_k z_k over the remembered keyframes, the logarithm of the product in Eq. 5."""
        total = np.zeros_like(self._base)
        for view in self._views:
            total += self._weight(view, stamp_ns) * view.evidence
        return total

    def _weight(self, view: _View, stamp_ns: int) -> np.float32:
        elapsed_s = (stamp_ns - view.stamp_ns) * 1e-9
        return np.float32(temporal_weight(self._config.decay_rate, elapsed_s))
