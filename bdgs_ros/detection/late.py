"""Detectors behind the question-and-answer protocol: at once, or in a thread of their own."""

from __future__ import annotations

import contextlib
import os
import sys
import threading

from bdgs_ros.core.errors import ModelError
from bdgs_ros.core.types import ColorImage
from bdgs_ros.detection.detector import Answer, Detector


class AtOnce:
    """
    Answers while it is asked: every run gives the same, and every image has its answer.

    Parameters
    ----------
    detector : Detector
        Who answers.

    """

    def __init__(self, detector: Detector) -> None:
        self._detector = detector
        self._answers: list[Answer] = []
        self.name = detector.name

    def submit(self, stamp_ns: int, color: ColorImage) -> None:
        """Run the detector on an image."""
        self._answers.append(Answer(stamp_ns, self._detector.detect(color)))

    def poll(self) -> list[Answer]:
        """Return the answers since the last call."""
        answers, self._answers = self._answers, []
        return answers

    def reset(self) -> None:
        """Forget what was not fetched."""
        self._answers = []

    def close(self) -> None:
        """Nothing runs."""


class InBackground:
    """
    Answers when it is done: a thread works on the newest image, others are passed over.

    Parameters
    ----------
    detector : Detector
        Who answers.
    nice : int
        How much the thread gives way to others (Linux).

    """

    def __init__(self, detector: Detector, nice: int = 0) -> None:
        self._detector = detector
        self._nice = nice
        self._changed = threading.Condition()
        self._next: tuple[int, ColorImage] | None = None
        self._answers: list[Answer] = []
        self._error: ModelError | None = None
        self._epoch = 0
        self._stopping = False
        self.name = detector.name
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()

    def submit(self, stamp_ns: int, color: ColorImage) -> None:
        """Replace the image that waits for the thread."""
        with self._changed:
            self._next = (stamp_ns, color)
            self._changed.notify()

    def poll(self) -> list[Answer]:
        """Return the answers since the last call; raise what the detector raised."""
        with self._changed:
            if self._error is not None:
                raise self._error
            answers, self._answers = self._answers, []
            return answers

    def reset(self) -> None:
        """Forget the image that waits, and the answer to the one at hand."""
        with self._changed:
            self._epoch += 1
            self._next = None
            self._answers = []

    def close(self) -> None:
        """End the thread after the image at hand."""
        with self._changed:
            self._stopping = True
            self._changed.notify()
        self._thread.join(2.0)

    def _run(self) -> None:
        if self._nice and sys.platform.startswith('linux'):  # elsewhere it is per process
            with contextlib.suppress(OSError):  # a wish, not a need
                os.setpriority(os.PRIO_PROCESS, threading.get_native_id(), self._nice)
        while (item := self._take()) is not None:
            epoch, stamp_ns, color = item
            try:
                answer = Answer(stamp_ns, self._detector.detect(color))
            except Exception as error:  # whatever it was: who polls must hear of it
                self._fail(error)
                return
            with self._changed:
                if epoch == self._epoch:
                    self._answers.append(answer)

    def _take(self) -> tuple[int, int, ColorImage] | None:
        """Wait for an image; None at the end."""
        with self._changed:
            while self._next is None and not self._stopping:
                self._changed.wait()
            if self._stopping or self._next is None:
                return None
            (stamp_ns, color), self._next = self._next, None
            return self._epoch, stamp_ns, color

    def _fail(self, error: Exception) -> None:
        with self._changed:
            text = f'{type(error).__name__}: {error}'
            self._error = error if isinstance(error, ModelError) else ModelError(text)
