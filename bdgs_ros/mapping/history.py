"""
What became of the keyframes: how late corrections reach the frames between them.

Frames are tracked relative to a keyframe, from where tracking believes that to be. When the map
later moves the keyframe, they move with it; between two keyframes the corrections of both are
blended. Tracking itself moves when mapping answers, in real time amid the frames of a keyframe:
those before that are corrected by all of it, those after by what came later.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter, itemgetter
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.types import Pose, StampedPose, Trajectory
from bdgs_ros.mapping.keyframes import MapKeyframe

Array = NDArray[np.float32]

Move = tuple[int, Pose]
"""The first frame after tracking moved all that it knew, and by what, `T_new_old`."""

_POSES = ('online', 'final')


@dataclass
class Anchor:
    """One keyframe's poses, `T_world_camera`, and its exposure."""

    online: Pose
    """As tracking gave it."""
    final: Pose
    exposure: Array


def moved_between(moves: Sequence[Move], earlier_ns: int, later_ns: int) -> Pose:
    """Return by what tracking moved a frame, `T_new_old`, before it tracked a later one."""
    first = bisect_right(moves, earlier_ns, key=itemgetter(0))
    last = bisect_right(moves, later_ns, key=itemgetter(0))
    moved = se3.identity()
    for _, T_new_old in moves[first:last]:
        moved = T_new_old @ moved
    return moved


def seen_from(moves: Sequence[Move], first_ns: int, last_ns: int) -> list[Move]:
    """
    Return the moves as they are for a piece of map that came into the world as a whole.

    What moved while the piece was made, from its first frame to its last, had moved before it.
    """
    return [(first_ns if first_ns < s <= last_ns else s, T_new_old) for s, T_new_old in moves]


def begun_again(moves: Sequence[Move], last_ns: int, T_new_old: Pose) -> list[Move]:
    """
    Return the moves where tracking began again after a frame, in the world as it is.

    What it had moved since that frame is void.
    """
    kept = [move for move in moves if move[0] <= last_ns]
    return [*kept, (last_ns + 1, T_new_old)]


class History:
    """All keyframes that ever were, also those whose images are forgotten."""

    def __init__(self) -> None:
        self._anchors: dict[int, Anchor] = {}
        self._earlier_ns: list[int] = []
        self._moves: list[Move] = []
        self._joined: list[StampedPose] = []

    @property
    def stamps_ns(self) -> list[int]:
        """Of all frames that the map was ever fitted to."""
        return [*self._earlier_ns, *self._anchors]

    def begin_run(self) -> None:
        """Keep of earlier runs nothing but the stamps: their poses correct no new frame."""
        self._earlier_ns, self._anchors = self.stamps_ns, {}
        self._moves, self._joined = [], []

    @property
    def newest(self) -> StampedPose | None:
        """The newest keyframe of this run, as tracking gave it."""
        if not self._anchors:
            return None
        stamp_ns = max(self._anchors)
        return StampedPose(stamp_ns, self._anchors[stamp_ns].online)

    @property
    def poses(self) -> dict[int, Pose]:
        """`T_world_camera` of this run's keyframes by stamp (ns), as they are now."""
        return {stamp_ns: anchor.final for stamp_ns, anchor in self._anchors.items()}

    def add(self, stamp_ns: int, online: Pose, final: Pose | None = None) -> None:
        """Take a keyframe, newer than all others: where tracking saw it, where it is now."""
        exposure = np.zeros(2, np.float32)
        if self._anchors:
            exposure = self._anchors[max(self._anchors)].exposure.copy()
        self._anchors[stamp_ns] = Anchor(online, online if final is None else final, exposure)

    def move(self, transforms: Mapping[int, Pose]) -> None:
        """Move keyframes by `T_new_old` in world, by stamp (ns)."""
        for stamp_ns, T_new_old in transforms.items():
            anchor = self._anchors.get(stamp_ns)
            if anchor is not None:
                anchor.final = se3.orthonormalise(T_new_old @ anchor.final)

    def note_move(self, stamp_ns: int, T_new_old: Pose) -> None:
        """Note that tracking moved everything before a frame: it learnt where keyframes are."""
        self._moves.append((stamp_ns, T_new_old))

    def catch_up(
        self,
        since_ns: int,
        moves: Sequence[StampedPose],
        pieces: Sequence[Sequence[StampedPose]],
    ) -> None:
        """Take what tracking said after a frame, some of it while nobody heard."""
        told = [(m.stamp_ns, m.T_world_camera) for m in moves if m.stamp_ns > since_ns]
        for piece in pieces:
            if piece:
                told = seen_from(told, piece[0].stamp_ns, piece[-1].stamp_ns)
        stamps = {stamp_ns for stamp_ns, _ in told}
        known = [move for move in self._moves if move[0] not in stamps]
        self._moves = sorted((*known, *told), key=itemgetter(0))
        joined = {pose.stamp_ns for pose in self._joined}
        for piece in pieces:
            if piece and piece[0].stamp_ns not in joined:
                self.join(piece)

    def reenter(self, last_ns: int, T_new_old: Pose) -> None:
        """Note that tracking began again, see `begun_again`."""
        self._moves = begun_again(self._moves, last_ns, T_new_old)

    def moves_since(self, stamp_ns: int) -> list[Move]:
        """Return by what tracking moved its world after a frame."""
        return [move for move in self._moves if move[0] > stamp_ns]

    def join(self, poses: Sequence[StampedPose]) -> None:
        """Take the frames of a piece of map that was placed in the world after it was made."""
        if poses:
            self._joined += poses
            self._moves = seen_from(self._moves, poses[0].stamp_ns, poses[-1].stamp_ns)

    def completed(self, online: Trajectory) -> Trajectory:
        """Return the trajectory with the frames of such pieces, uncorrected."""
        known = {pose.stamp_ns for pose in online.poses}
        more = [pose for pose in self._joined if pose.stamp_ns not in known]
        return Trajectory(tuple(sorted((*online.poses, *more), key=attrgetter('stamp_ns'))))

    def refresh(self, keyframes: Iterable[MapKeyframe]) -> None:
        """Take over the present poses and exposures."""
        for keyframe in keyframes:
            anchor = self._anchors.get(keyframe.stamp_ns)
            if anchor is not None:
                anchor.final = keyframe.T_world_camera
                anchor.exposure = keyframe.exposure.copy()

    def exposure(self, stamp_ns: int) -> Array:
        """Return (log gain, offset) at a time, blended between the keyframes around it."""
        if not self._anchors:
            return np.zeros(2, np.float32)
        before, after, share = self._around(stamp_ns)
        first, second = self._anchors[before].exposure, self._anchors[after].exposure
        return np.asarray((1 - share) * first + share * second, np.float32)

    def correct(self, online: Trajectory) -> Trajectory:
        """
        Return the trajectory with what mapping found out later.

        Parameters
        ----------
        online : Trajectory
            As tracking gave it.

        Returns
        -------
        final : Trajectory
            The same stamps; the same poses where there are no keyframes.

        """
        if not self._anchors:
            return online
        return Trajectory(
            tuple(
                StampedPose(pose.stamp_ns, self._correction(pose.stamp_ns) @ pose.T_world_camera)
                for pose in online.poses
            )
        )

    def _correction(self, stamp_ns: int) -> Pose:
        """Return T_final_online at a time."""
        before, after, share = self._around(stamp_ns)
        own = self._anchors[before]
        if stamp_ns <= before:
            return own.final @ se3.inverse(own.online)
        held = self._held(before, stamp_ns)
        if after == before:
            return held
        next_one = self._anchors[after]
        coming = next_one.final @ se3.inverse(next_one.online)
        step = se3.log(coming @ se3.inverse(self._held(before, after)))
        return se3.orthonormalise(se3.exp(share * step) @ held)

    def _held(self, keyframe_ns: int, stamp_ns: int) -> Pose:
        """Return T_final_online at a time that holds the motion since a keyframe."""
        own = self._anchors[keyframe_ns]
        believed = moved_between(self._moves, keyframe_ns, stamp_ns) @ own.online
        return own.final @ se3.inverse(believed)

    def _around(self, stamp_ns: int) -> tuple[int, int, float]:
        """Return the keyframes before and after a time, and how far between them it lies."""
        stamps = sorted(self._anchors)
        place = bisect_right(stamps, stamp_ns)
        before = stamps[max(place - 1, 0)]
        after = stamps[min(place, len(stamps) - 1)]
        share = (stamp_ns - before) / (after - before) if after > before else 0.0
        return before, after, float(np.clip(share, 0, 1))

    def to_document(self) -> dict[str, Any]:
        """Return everything as plain numbers."""
        anchors = [
            {
                'stamp_ns': stamp_ns,
                'exposure': [float(value) for value in anchor.exposure],
                **{name: getattr(anchor, name).tolist() for name in _POSES},
            }
            for stamp_ns, anchor in self._anchors.items()
        ]
        moves = [
            {'stamp_ns': stamp_ns, 'T_new_old': T_new_old.tolist()}
            for stamp_ns, T_new_old in self._moves
        ]
        joined = [
            {'stamp_ns': pose.stamp_ns, 'T_world_camera': pose.T_world_camera.tolist()}
            for pose in self._joined
        ]
        return {
            'anchors': anchors,
            'moves': moves,
            'joined': joined,
            'earlier_ns': self._earlier_ns,
        }

    @classmethod
    def from_document(cls, document: dict[str, Any]) -> History:
        """Undo `to_document`; KeyError, TypeError or ValueError if it is something else."""
        history = cls()
        history._earlier_ns = [int(stamp) for stamp in document['earlier_ns']]
        for entry in document['anchors']:
            online, final = (np.array(entry[n], float).reshape(4, 4) for n in _POSES)
            exposure = np.array(entry['exposure'], np.float32).reshape(2)
            history._anchors[int(entry['stamp_ns'])] = Anchor(online, final, exposure)
        for entry in document['moves']:
            T_new_old = np.array(entry['T_new_old'], float).reshape(4, 4)
            history.note_move(int(entry['stamp_ns']), T_new_old)
        for entry in document.get('joined', []):  # older maps have none
            pose = np.array(entry['T_world_camera'], float).reshape(4, 4)
            history._joined.append(StampedPose(int(entry['stamp_ns']), pose))
        return history
