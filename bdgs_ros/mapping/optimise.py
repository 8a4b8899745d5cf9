"""The adaptive optimisation of section 3.4 on the pyramid of section 3.5."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cached_property

import numpy as np

from bdgs_ros.core.config import MappingConfig
from bdgs_ros.mapping.densify import Pull
from bdgs_ros.mapping.gaussians import GaussianMap
from bdgs_ros.mapping.keyframes import MapKeyframe, Window
from bdgs_ros.mapping.steps import Steps, open_steps

Plan = list[tuple[MapKeyframe, int]]


class Optimiser:
    """
    Fit the map to its keyframes: Eq. 7-9 with Adam, coarse to fine by Eq. 12-13.

    Parameters
    ----------
    config : MappingConfig
        Steps and rates.
    hurried : callable
        Whether the next keyframe waits already: then there are `config.hurried` iterations.

    """

    def __init__(self, config: MappingConfig, hurried: Callable[[], bool] = lambda: False) -> None:
        self._config = config
        self._hurried = hurried
        self._rng = np.random.default_rng(config.seed)

    @cached_property
    def _steps(self) -> Steps:
        """Opened when first used: what is on a card takes seconds."""
        return open_steps(self._config)

    def gather(self, count: int | None) -> Pull | None:
        """Gather from now on how `count` Gaussians are pulled, or with None no longer."""
        return self._steps.gather(count)

    def run(
        self, gaussians: GaussianMap, newest: MapKeyframe, others: Sequence[MapKeyframe]
    ) -> list[float]:
        """
        Optimise after a new keyframe.

        Parameters
        ----------
        gaussians : GaussianMap
            Changed in place.
        newest : MapKeyframe
            Every second iteration looks at it.
        others : sequence of MapKeyframe
            The rest of the window and a few older ones; the other iterations take them in turn.

        Returns
        -------
        losses : list of float
            One per iteration, each of its own view.

        """
        coarse, fine = self._plan(newest, others)
        steps = self._steps
        steps.begin(gaussians, [newest, *others])
        done = self._take(coarse, 0)
        losses = steps.losses()
        seen = [loss for (kf, _), loss in zip(coarse, losses, strict=False) if kf is newest]
        if _gain(seen[len(seen) // 2 :]) < self._config.enough:
            fine = fine[: self._config.min_fine]
        self._take(fine, done)
        steps.end()
        return steps.losses()

    def _take(self, plan: Plan, done: int) -> int:
        """Take the steps of a plan after `done` others; return how many there are then."""
        for keyframe, level_index in self._until_hurried(plan, done):
            # poses settle: Adam's steps do not get smaller by themselves
            calm = (1 - done / self._config.iterations) ** 2
            window = self._look(keyframe, level_index)
            self._steps.take(keyframe, level_index, window, pose_scale=calm)
            done += 1
        return done

    def _until_hurried(self, plan: Plan, done: int) -> Iterator[tuple[MapKeyframe, int]]:
        """Yield from a plan, and end where enough is done for as long as a keyframe waits."""
        for count, view in enumerate(plan, done):
            if count >= self._config.hurried and self._hurried():
                return
            yield view

    def step(
        self,
        gaussians: GaussianMap,
        keyframe: MapKeyframe,
        level_index: int,
        rate_scale: float = 1.0,
        *,
        move: bool = True,
    ) -> float:
        """
        Take one step of Eq. 7 on one view and return its loss.

        Parameters
        ----------
        gaussians : GaussianMap
            Changed in place.
        keyframe : MapKeyframe
            The view; its exposure and pose are adapted too.
        level_index : int
            Of the keyframe's pyramid, 0 is the finest.
        rate_scale : float
            Factor on every learning rate.
        move : bool
            Whether the keyframe's pose is adapted; else it stays as it was told.

        """
        self._steps.begin(gaussians, [keyframe])
        self._steps.take(
            keyframe,
            level_index,
            self._look(keyframe, level_index),
            rate_scale=rate_scale,
            pose_scale=rate_scale**2 if move else 0.0,
        )
        self._steps.end()
        return self._steps.losses()[-1]

    def settle(
        self, gaussians: GaussianMap, views: Sequence[MapKeyframe], rate_scale: float
    ) -> None:
        """
        Take a step on each of some views, whose poses stay.

        Parameters
        ----------
        gaussians : GaussianMap
            Changed in place.
        views : sequence of MapKeyframe
            In this order, at the finest level, until the next keyframe waits.
        rate_scale : float
            Factor on every learning rate.

        """
        self._steps.begin(gaussians, views)
        for keyframe in views:
            if self._hurried():
                break
            window = self._look(keyframe, 0)
            self._steps.take(keyframe, 0, window, rate_scale=rate_scale, pose_scale=0.0)
        self._steps.end()

    def _plan(self, newest: MapKeyframe, others: Sequence[MapKeyframe]) -> tuple[Plan, Plan]:
        """Return keyframe and pyramid level of each iteration: coarse ones, finest ones."""
        levels = self._levels(len(newest.levels))
        plan = [
            (newest if i % 2 == 0 or not others else others[(i // 2) % len(others)], level)
            for i, level in enumerate(levels)
        ]
        first_fine = levels.index(0) if 0 in levels else len(levels)
        return plan[:first_fine], plan[first_fine:]

    def _levels(self, count: int) -> list[int]:
        """Return the level of each iteration, i = L, ..., 0 as in Eq. 12."""
        coarse = round(self._config.iterations * self._config.pyramid.coarse_share)
        each = coarse // max(count - 1, 1)
        levels = [level for level in range(count - 1, 0, -1) for _ in range(each)]
        return levels + [0] * (self._config.iterations - len(levels))

    def _look(self, keyframe: MapKeyframe, level_index: int) -> Window | None:
        """Choose the window of a large image that a step sees; None: small ones it sees whole."""
        height, width = keyframe.levels[level_index].camera.shape
        share = np.sqrt(self._config.step_pixels / (height * width))
        if share >= 1:
            return None
        rows, columns = (self._stretch(length, share) for length in (height, width))
        return Window(rows, columns)

    def _stretch(self, length: int, share: float) -> slice:
        """Return a random stretch; its ends reach beyond the image, so that rims are seen too."""
        wanted = round(length * share)
        anywhere = self._rng.integers(-wanted // 2, length - wanted // 2)
        start = int(np.clip(anywhere, 0, length - wanted))
        return slice(start, start + wanted)


def _gain(losses: Sequence[float]) -> float:
    """Return the share by which a loss fell; infinite where too little is known."""
    return 1 - losses[-1] / losses[0] if len(losses) > 1 and losses[0] > 0 else float('inf')
