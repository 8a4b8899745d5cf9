"""Fit a finished map better to all of its keyframes: Eq. 7 without the hurry of a run."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from bdgs_ros.core.config import MappingConfig
from bdgs_ros.core.errors import MapError
from bdgs_ros.mapping.densify import divide
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.keyframes import MapKeyframe
from bdgs_ros.mapping.optimise import Optimiser

_FINAL_RATE = 0.1  # share of the learning rates that is left at the end
_FINEST = 0


class Refiner:
    """
    Optimise a map over its keyframes, all of them alike.

    Parameters
    ----------
    gaussians : GaussianMap
        Changed in place.
    keyframes : sequence of MapKeyframe
        Their exposures and poses are adapted too, but for those of the oldest.
    config : MappingConfig
        Of the run; `seed` chooses the order of the keyframes.

    Raises
    ------
    MapError
        Without keyframes.

    """

    def __init__(
        self, gaussians: GaussianMap, keyframes: Sequence[MapKeyframe], config: MappingConfig
    ) -> None:
        if not keyframes:
            raise MapError(
                'the map has no keyframes to be refined with; save it together with them '
                '(bdgs run does, unless --no-keyframes was given)'
            )
        self._map = gaussians
        self._keyframes = keyframes
        self._config = config
        self._optimiser = Optimiser(config)
        self._rng = np.random.default_rng(config.seed)
        self._waiting: list[int] = []
        self._densified = 0
        self._gather()
        self._anchor = min(keyframes, key=lambda keyframe: keyframe.index)

    def step(self, progress: float) -> float:
        """
        Take one step on the next keyframe and return its loss.

        Parameters
        ----------
        progress : float
            Share of the refinement that is done, 0 to 1; learning rates fall with it.

        """
        self._densify(progress)
        keyframe = self._next_keyframe()
        exposure, pose = keyframe.exposure.copy(), keyframe.T_world_camera
        loss = self._optimiser.step(self._map, keyframe, _FINEST, rate_scale(progress))
        if keyframe is self._anchor:  # else all could drift together
            keyframe.exposure[:] = exposure
            keyframe.T_world_camera = pose
        return loss

    def _densify(self, progress: float) -> None:
        """Divide the Gaussians that are pulled most, at even intervals of the first half."""
        rounds = self._config.densify.rounds
        if self._densified >= rounds or progress < 0.5 * (self._densified + 1) / rounds:
            return
        self._densified += 1
        room = self._config.prune.max_gaussians - len(self._map)
        wanted = round(self._config.densify.share * len(self._map))
        if self._pull is not None and room > 0:
            divide(self._map, self._pull.strongest(min(wanted, room)))
        self._gather()

    def _gather(self) -> None:
        """Gather gradients for the next round, if there is one."""
        more = self._densified < self._config.densify.rounds
        self._pull = self._optimiser.gather(len(self._map) if more else None)

    def _next_keyframe(self) -> MapKeyframe:
        """Return keyframes in random order, each once before any comes again."""
        if not self._waiting:
            self._waiting = list(self._rng.permutation(len(self._keyframes)))
        return self._keyframes[self._waiting.pop()]


def rate_scale(progress: float) -> float:
    """Return the factor on the learning rates, which falls exponentially as in 3DGS."""
    return float(_FINAL_RATE ** min(max(progress, 0.0), 1.0))
