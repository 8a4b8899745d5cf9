"""A recording played forth and back, again and again: long runs from short recordings."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import ColorImage, DepthImage, StampedPose, Trajectory
from bdgs_ros.data.sequence import RearrangedSequence, Sequence


def forth_and_back(available: int, count: int) -> NDArray[np.int64]:
    """
    Return which of `available` frames stands at each of `count` places: 0 1 2 1 0 1 2 ...

    The frames at which the recording turns are not repeated.
    """
    period = max(2 * (available - 1), 1)
    phase = np.arange(count) % period
    return np.where(phase < available, phase, period - phase).astype(np.int64)


class LoopedSequence(RearrangedSequence):
    """
    A sequence forth and back until it has `count` frames, with stamps that only grow.

    On the way back time runs backward in the recording, so everything keeps its speed, and the
    camera turns round at the ends as it never does in one frame; a hand-held one may.

    Parameters
    ----------
    sequence : Sequence
        At least two frames.
    count : int
        Frames of the loop.

    Raises
    ------
    DatasetError
        If the sequence is too short to go back, or `count` is not positive.

    """

    def __init__(self, sequence: Sequence, count: int) -> None:
        if len(sequence) < 2 or count < 1:
            raise DatasetError(
                f"'{sequence.name}' with {len(sequence)} frames cannot be looped to {count}; "
                'at least 2 frames and a count of 1 are needed'
            )
        indices = forth_and_back(len(sequence), count)
        own = np.asarray(sequence.stamps_ns, np.int64)
        super().__init__(sequence, indices, np.abs(np.diff(own[indices])))

    @property
    def ground_truth(self) -> Trajectory | None:
        """The poses of the camera during the frames, looped like them."""
        truth = self._sequence.ground_truth
        return None if truth is None else self._looped(truth)

    def _looped(self, truth: Trajectory) -> Trajectory:
        own = self._sequence.stamps_ns
        first, span = int(own[0]), int(own[-1] - own[0])
        inside = [p for p in truth.poses if 0 <= p.stamp_ns - first <= span]
        poses: list[StampedPose] = []
        last = int(self.stamps_ns[-1])
        for turn, start in enumerate(range(first, last + 1, span)):
            for pose in inside if turn % 2 == 0 else reversed(inside):
                since = pose.stamp_ns - first
                stamp_ns = start + (since if turn % 2 == 0 else span - since)
                # the pose at which the camera turns belongs to both ways
                if stamp_ns <= last and not (poses and stamp_ns <= poses[-1].stamp_ns):
                    poses.append(StampedPose(stamp_ns, pose.T_world_camera))
        return Trajectory(tuple(poses))

    def source_index(self, index: int) -> int:
        """Return which frame of the recording stands at a place of the loop."""
        return int(self._indices[index])

    def source_stamp_ns(self, stamp_ns: int) -> int:
        """Return the recorded stamp of the frame nearest to a stamp of the loop."""
        place = int(np.argmin(np.abs(self.stamps_ns - stamp_ns)))
        return int(self._sequence.stamps_ns[self._indices[place]])


class _Truth(Protocol):
    def dynamic(self, stamp_ns: int) -> NDArray[np.bool_]: ...

    def static_color(self, stamp_ns: int) -> ColorImage: ...

    def static_depth(self, stamp_ns: int) -> DepthImage: ...


@dataclass(frozen=True)
class LoopedTruth:
    """The truth of a synthetic recording, asked by the stamps of a loop."""

    truth: _Truth
    loop: LoopedSequence

    def dynamic(self, stamp_ns: int) -> NDArray[np.bool_]:
        """Return the true mask of moving things, shape (H, W)."""
        return self.truth.dynamic(self.loop.source_stamp_ns(stamp_ns))

    def static_color(self, stamp_ns: int) -> ColorImage:
        """Return the view without anything that moves."""
        return self.truth.static_color(self.loop.source_stamp_ns(stamp_ns))

    def static_depth(self, stamp_ns: int) -> DepthImage:
        """Return the depth without anything that moves."""
        return self.truth.static_depth(self.loop.source_stamp_ns(stamp_ns))
