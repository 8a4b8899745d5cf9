"""How long the parts of tracking take, measured from outside: hot code has no clocks."""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Callable
from types import TracebackType
from typing import Any

from bdgs_ros.tracking import camera_tracker
from bdgs_ros.tracking.align import Aligner
from bdgs_ros.tracking.camera_tracker import CameraTracker
from bdgs_ros.tracking.motion import MotionPredictor
from bdgs_ros.tracking.movers import MoverMask

PARTS = ('pyramid', 'predict', 'coarse', 'world', 'movers', 'refine')

_Method = Callable[..., Any]


def _of_alignment(
    reference: Any, current: Any, start: Any, fine_only: bool = False, *_: Any, **__: Any
) -> str:
    return 'refine' if fine_only else 'coarse'


def _always(name: str) -> Callable[..., str]:
    return lambda *_, **__: name


# Public functions and where they are called, and which part of a frame's time they are.
_WATCHED: tuple[tuple[Any, str, Callable[..., str]], ...] = (
    (Aligner, 'pyramid', _always('pyramid')),
    (Aligner, 'with_dynamic', _always('pyramid')),
    (Aligner, 'align', _of_alignment),
    (Aligner, 'cells', _always('world')),
    (camera_tracker, 'find_world', _always('world')),
    (Aligner, 'residual_maps', _always('movers')),
    (MoverMask, 'expected', _always('movers')),
    (MoverMask, 'update', _always('movers')),
    (MotionPredictor, 'predict', _always('predict')),
    (MotionPredictor, 'update', _always('predict')),
)


class PartTimes:
    """
    Stand in front of the methods of tracking while the context lasts.

    Only what happens inside `CameraTracker.process` counts: detection aligns images too.

    Examples
    --------
    >>> with PartTimes() as times:
    ...     tracker.process(frame)
    ...     times.take()['coarse']  # ms

    """

    def __init__(self) -> None:
        self._ms: dict[str, float] = defaultdict(float)
        self._inside = False
        self._replaced: list[tuple[Any, str, _Method]] = []

    def take(self) -> dict[str, float]:
        """Return the milliseconds since the last call, by part; `all` is the whole frame."""
        taken, self._ms = dict(self._ms), defaultdict(float)
        return taken

    def __enter__(self) -> PartTimes:
        for owner, name, part in _WATCHED:
            self._replace(owner, name, self._timed(getattr(owner, name), part))
        self._replace(CameraTracker, 'process', self._whole(CameraTracker.process))
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        for owner, name, method in self._replaced:
            setattr(owner, name, method)
        self._replaced = []

    def _replace(self, owner: Any, name: str, method: _Method) -> None:
        self._replaced.append((owner, name, getattr(owner, name)))
        setattr(owner, name, method)

    def _timed(self, method: _Method, part: Callable[..., str]) -> _Method:
        def timed(owner: Any, *arguments: Any, **named: Any) -> Any:
            start = time.perf_counter()
            try:
                return method(owner, *arguments, **named)
            finally:
                if self._inside:
                    name = part(*arguments, **named)
                    self._ms[name] += 1e3 * (time.perf_counter() - start)

        return timed

    def _whole(self, method: _Method) -> _Method:
        def whole(owner: Any, *arguments: Any, **named: Any) -> Any:
            self._inside = True
            start = time.perf_counter()
            try:
                return method(owner, *arguments, **named)
            finally:
                self._ms['all'] += 1e3 * (time.perf_counter() - start)
                self._inside = False

        return whole
