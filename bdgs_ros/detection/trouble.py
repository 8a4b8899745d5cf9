"""A detector in trouble, for tests and benches: misses, sees ghosts, answers late."""

from __future__ import annotations

from collections import deque

import numpy as np

from bdgs_ros.core.types import ColorImage, Detection
from bdgs_ros.detection.classes import COCO_NAMES, p_dynamic
from bdgs_ros.detection.detector import Answer, Detector

_PERSON = 'person'
_GHOST_SCORES = (0.36, 0.9)


class TroubledDetector:
    """
    Spoils the answers of a detector, the same way in every run.

    Time is that of the stamps, so a run does not depend on the speed of the machine.

    Parameters
    ----------
    inner : Detector
        Whose answers are spoilt.
    drop : float
        Probability that a detection is not reported, each on its own.
    false : float
        Probability that an image gets a box of class person at a random place, of random size
        and score.
    delay_s : float
        From an image's stamp to its answer, in seconds.
    period_s : float
        Images that come earlier after the last one worked on are passed over, in seconds; 0:
        all are answered, however late.
    seed : int
        Of the drops and the ghosts.

    """

    def __init__(
        self,
        inner: Detector,
        drop: float = 0.3,
        false: float = 0.1,
        delay_s: float = 0.3,
        period_s: float = 0.0,
        seed: int = 0,
    ) -> None:
        self._inner = inner
        self._drop, self._false, self._seed = drop, false, seed
        self._delay_ns, self._period_ns = round(delay_s * 1e9), round(period_s * 1e9)
        self.name = f'{inner.name}, in trouble'
        self.reset()

    def reset(self) -> None:
        """Forget the images offered."""
        self._waiting: deque[Answer] = deque()
        self._now_ns: int | None = None
        self._worked_ns: int | None = None

    def close(self) -> None:
        """Nothing runs."""

    def submit(self, stamp_ns: int, color: ColorImage) -> None:
        """Work on an image, unless it comes too early."""
        self._now_ns = stamp_ns
        if self._worked_ns is not None and stamp_ns - self._worked_ns < self._period_ns:
            return
        self._worked_ns = stamp_ns
        found = self._spoilt(stamp_ns, self._inner.detect(color), color.shape)
        self._waiting.append(Answer(stamp_ns, found))

    def poll(self) -> list[Answer]:
        """Return the answers that are due at the stamp of the newest image."""
        due = []
        while self._waiting and self._is_due(self._waiting[0]):
            due.append(self._waiting.popleft())
        return due

    def _is_due(self, answer: Answer) -> bool:
        return self._now_ns is not None and answer.stamp_ns + self._delay_ns <= self._now_ns

    def _spoilt(
        self, stamp_ns: int, found: list[Detection], shape: tuple[int, ...]
    ) -> list[Detection]:
        rng = np.random.default_rng([self._seed, stamp_ns])
        kept = [d for d in found if rng.random() >= self._drop]
        if rng.random() < self._false:
            kept.append(_ghost(rng, shape))
        return sorted(kept, key=lambda d: -d.score)


def _ghost(rng: np.random.Generator, shape: tuple[int, ...]) -> Detection:
    """Return a person of random place and size, wholly inside the image."""
    height = rng.uniform(0.2, 0.9) * shape[0]
    width = min(rng.uniform(0.3, 0.6) * height, shape[1] - 1.0)
    x0, y0 = rng.uniform(0, shape[1] - width), rng.uniform(0, shape[0] - height)
    score = float(rng.uniform(*_GHOST_SCORES))
    box = (float(x0), float(y0), float(x0 + width), float(y0 + height))
    return Detection(box, score, COCO_NAMES.index(_PERSON), _PERSON, p_dynamic(_PERSON, score))
