"""
Recordings in which something goes wrong with the view: to test loss and recovery.

Ground truth is used to choose a fault, and travels with the frames for scoring; the frames
themselves carry nothing of it.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bdgs_ros.core import se3
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import RgbdFrame, StampedPose, Trajectory
from bdgs_ros.data.sequence import RearrangedSequence, Sequence

Cover = Callable[[RgbdFrame, np.random.Generator], RgbdFrame]


def black(frame: RgbdFrame, rng: np.random.Generator) -> RgbdFrame:
    """Put a lid on the lens: sensor noise on black, no depth."""
    return _blank(frame, rng, 12.0, 3.0, np.zeros_like(frame.depth_m))


def grey(frame: RgbdFrame, rng: np.random.Generator) -> RgbdFrame:
    """Put frosted glass before the lens: noise on grey, no depth."""
    return _blank(frame, rng, 128.0, 6.0, np.zeros_like(frame.depth_m))


def blind(frame: RgbdFrame, rng: np.random.Generator) -> RgbdFrame:
    """Lose the depth alone, as where a driver drops it or the sun outshines its projector."""
    return replace(frame, depth_m=np.zeros_like(frame.depth_m))


def wall(frame: RgbdFrame, rng: np.random.Generator) -> RgbdFrame:
    """Stand before a wall of one colour, 1.5 m away, measured as a Kinect does."""
    depth_m = rng.normal(1.5, 0.0015 * 1.5**2, frame.depth_m.shape)
    return _blank(frame, rng, 150.0, 3.0, depth_m.astype(np.float32))


def _blank(
    frame: RgbdFrame,
    rng: np.random.Generator,
    level: float,
    noise: float,
    depth_m: NDArray[np.float32],
) -> RgbdFrame:
    color = np.clip(rng.normal(level, noise, frame.color.shape), 0, 255).astype(np.uint8)
    return replace(frame, color=color, depth_m=depth_m)


@dataclass(frozen=True)
class Jump:
    """After frame `at` comes frame `to`."""

    at: int
    to: int
    distance_m: float
    angle_deg: float


def choose_jump(
    truth: Trajectory,
    stamps_ns: NDArray[np.int64],
    distance_m: float = 0.5,
    angle_deg: float = 30.0,
    rest: int = 45,
) -> Jump:
    """
    Choose a jump back to where the camera has been, so that it can know the place again.

    Parameters
    ----------
    truth : Trajectory
        Poses of the camera.
    stamps_ns : ndarray, shape (N,)
        Of the frames.
    distance_m, angle_deg : float
        Either is far enough.
    rest : int
        Frames before the place jumped to, and after the jump.

    Returns
    -------
    jump : Jump
        The farthest from the latest frame that can jump far enough; where none can, the farthest
        of all.

    Raises
    ------
    DatasetError
        If the recording is too short for a jump.

    """
    poses = np.array(poses_at(truth, stamps_ns))
    jumps = []
    for at in range(len(poses) - 1, 2 * rest, -1):
        T_at_world = se3.inverse(poses[at])
        moves = T_at_world @ poses[rest : at - rest]
        far = np.linalg.norm(moves[:, :3, 3], axis=1)
        turn = np.rad2deg(Rotation.from_matrix(moves[:, :3, :3]).magnitude())
        i = int(np.argmax(np.maximum(far / distance_m, turn / angle_deg)))
        jumps.append(Jump(at, rest + i, float(far[i]), float(turn[i])))
        if far[i] >= distance_m or turn[i] >= angle_deg:
            return jumps[-1]
    if not jumps:
        raise DatasetError(
            f'{len(poses)} frames are too few for a jump; at least {2 * rest + 2} are needed'
        )
    return max(jumps, key=lambda j: max(j.distance_m / distance_m, j.angle_deg / angle_deg))


def poses_at(truth: Trajectory, stamps_ns: NDArray[np.int64]) -> list[NDArray[np.float64]]:
    """Return the true pose nearest in time to each stamp."""
    known = truth.stamps_ns
    nearest = [int(np.argmin(np.abs(known - stamp))) for stamp in stamps_ns]
    return [truth.poses[i].T_world_camera for i in nearest]


class FaultySequence(RearrangedSequence):
    """
    A recording with a covered view, or with a jump, at camera rate.

    Parameters
    ----------
    sequence : Sequence
        The recording.
    indices : ndarray, shape (N,), int
        Which of its frames are shown, in this order; stamps go on as if nothing had happened.
    covered : range
        Places of `indices` at which the view is covered.
    cover : callable, optional
        What covers it: `black`, `grey`, `blind` or `wall`.
    seed : int
        Of the noise.

    """

    def __init__(
        self,
        sequence: Sequence,
        indices: NDArray[np.int64],
        covered: range = range(0),
        cover: Cover = black,
        seed: int = 0,
    ) -> None:
        own = np.asarray(sequence.stamps_ns, np.int64)
        usual = int(np.median(np.diff(own)))
        steps = np.where(np.diff(indices) == 1, np.diff(own[indices]), usual)
        super().__init__(sequence, indices, steps)
        self.covered = covered
        """Places at which the view is covered."""
        self._cover, self._seed = cover, seed

    @property
    def ground_truth(self) -> Trajectory | None:
        """The pose of the camera in every frame, covered or not."""
        truth = self._sequence.ground_truth
        if truth is None:
            return None
        poses = poses_at(truth, np.asarray(self._sequence.stamps_ns)[self._indices])
        stamped = zip(self.stamps_ns, poses, strict=True)
        return Trajectory(tuple(StampedPose(int(s), T) for s, T in stamped))

    def __getitem__(self, index: int) -> RgbdFrame:
        """Read one frame; negative indices count from the end."""
        place = range(len(self))[index]
        frame = super().__getitem__(place)
        if place not in self.covered:
            return frame
        return self._cover(frame, np.random.default_rng([self._seed, place]))


def covered(
    sequence: Sequence, start: int, duration_s: float, cover: Cover = black, seed: int = 0
) -> FaultySequence:
    """Return a recording whose view is covered from a frame on, for a time."""
    stamps_ns = np.asarray(sequence.stamps_ns, np.int64)
    stop = int(np.searchsorted(stamps_ns, stamps_ns[start] + round(duration_s * 1e9)))
    return FaultySequence(sequence, np.arange(len(sequence)), range(start, stop), cover, seed)


def jumped(sequence: Sequence, jump: Jump) -> FaultySequence:
    """Return a recording that jumps, and goes on from there."""
    before, after = np.arange(jump.at + 1), np.arange(jump.to, len(sequence))
    return FaultySequence(sequence, np.concatenate([before, after]))
