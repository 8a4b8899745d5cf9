"""The Bayesian dynamic inference of one keyframe, sections 3.2 and 3.3 of the paper."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief import likelihood
from bdgs_ros.belief.fusion import View
from bdgs_ros.belief.likelihood import Features, Observation, Points
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.mapping.gaussians import GaussianMap

Rows = NDArray[np.int64]

_LEAST_SHARED = 0.05  # of what two keyframes see: with less they say nothing about each other


class Inference:
    """Asks each keyframe about every Gaussian, and remembered keyframes about new Gaussians."""

    def __init__(self, config: BeliefConfig) -> None:
        self._config = config

    def observe(self, gaussians: GaussianMap, observation: Observation, index: int) -> Features:
        """
        Update every belief with what a keyframe says, Eq. 1-6, 10 and 11.

        Parameters
        ----------
        gaussians : GaussianMap
            Its beliefs and records change.
        observation : Observation
            The keyframe, in the colours of the map.
        index : int
            Number of the keyframe, as in `GaussianMap.keyframe_index`.

        Returns
        -------
        features : Features
            What the keyframe showed of each Gaussian.

        """
        points = self.points(gaussians, index)
        features = likelihood.extract(points, observation, self._config.likelihood)
        if self._config.enabled:
            gaussians.belief.observe(self._view(observation, features))
        else:
            gaussians.belief.overwrite(likelihood.label(features), features.visible)
        gaussians.note(features)
        return features

    def ask_memory(self, gaussians: GaussianMap, rows: Rows, index: int) -> None:
        """
        Ask the remembered keyframes about Gaussians that have just come, Eq. 5.

        What now stands where they saw free space came there; nothing need be waited for to know.

        Parameters
        ----------
        gaussians : GaussianMap
            Its beliefs change.
        rows : ndarray of int, shape (M,)
            The new Gaussians.
        index : int
            Number of the keyframe that brought them.

        """
        belief = gaussians.belief
        if not (self._config.enabled and self._config.multi_view and len(rows) and belief.views):
            return
        newest = belief.views[-1]
        points = self.points(gaussians, index, rows)
        for view in belief.views[:-1]:  # that they are where the newest saw them is no news
            if newest.shared[view.stamp_ns] > _LEAST_SHARED:
                features = likelihood.extract(points, view.observation, self._config.likelihood)
                belief.recall(view, rows, self._view(view.observation, features))
        belief.restart(rows)

    @staticmethod
    def points(gaussians: GaussianMap, index: int, rows: Rows | slice = slice(None)) -> Points:
        """Return what is known of Gaussians before a keyframe; of all by default."""
        return Points(
            gaussians.means[rows],
            gaussians.colors[rows],
            gaussians.contribution[rows],
            gaussians.streak[rows],
            index - gaussians.keyframe_index[rows],
            gaussians.observations[rows],
            gaussians.belief.seen_through(rows),
            gaussians.surface[rows],
        )

    def _view(self, observation: Observation, features: Features) -> View:
        evidence = likelihood.evidence(features, self._config.likelihood)
        return View(observation, evidence, features.visible, features.seen_through)
