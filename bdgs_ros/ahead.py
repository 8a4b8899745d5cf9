"""Read and label the next frames of a recording while a frame is tracked and mapped."""

from __future__ import annotations

from collections import deque
from collections.abc import Generator, Iterable
from concurrent.futures import ThreadPoolExecutor
from typing import Any

from bdgs_ros.core.types import Labels, RgbdFrame

_AHEAD = 3  # frames; more would only take memory


class DetectedAhead:
    """
    A detection stage that has seen the frames before they are asked for.

    Detection depends on frames alone, so the labels are those that the stage gives in turn,
    whatever the threads do.

    Parameters
    ----------
    stage : DetectionStage
        Used in a thread of its own while `frames` is iterated.

    """

    def __init__(self, stage: Any) -> None:
        self._stage = stage
        self._newest: tuple[RgbdFrame, Labels] | None = None

    def frames(self, recording: Iterable[RgbdFrame]) -> Generator[RgbdFrame, None, None]:
        """Yield the frames of a recording; between two of them `process` answers for the first."""
        source = iter(recording)

        def label() -> tuple[RgbdFrame, Labels] | None:
            frame = next(source, None)
            return None if frame is None else (frame, self._stage.process(frame))

        worker = ThreadPoolExecutor(1, 'detection')
        try:
            waiting = deque(worker.submit(label) for _ in range(_AHEAD))
            while (labelled := waiting.popleft().result()) is not None:
                waiting.append(worker.submit(label))
                self._newest = labelled
                yield labelled[0]
        finally:
            worker.shutdown(cancel_futures=True)

    def process(self, frame: RgbdFrame) -> Labels:
        """Return the labels of the frame that `frames` yielded last."""
        assert self._newest is not None and self._newest[0] is frame
        return self._newest[1]

    def __getattr__(self, name: str) -> Any:
        """Return what else the stage has."""
        return getattr(self._stage, name)
