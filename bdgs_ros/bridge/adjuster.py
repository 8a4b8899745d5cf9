"""
The back end beside a mapper that is busy; ROS-free.

A keyframe takes the back end a tenth of a second, and mapping half a second where all of the graph
shares two cores. So keyframes go through the back end in a thread of its own, each, as soon as
they come; tracking is told at once where they are. The map follows when the mapper takes its next
keyframe, which need not be each.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import replace

from bdgs_ros.back_end.back_end import BackEnd
from bdgs_ros.core import se3
from bdgs_ros.core.types import Keyframe, ModelView, Pose, StampedPose
from bdgs_ros.mapping.history import Move, begun_again, moved_between, seen_from
from bdgs_ros.mapping.mapper import Mapper
from bdgs_ros.pipeline import Adjustment, adjust

TellPoses = Callable[[dict[int, Pose]], None]
TellView = Callable[[ModelView], None]


class Adjuster:
    """
    Where the keyframes are, for two threads: one adjusts them, the other maps them.

    Parameters
    ----------
    back_end : BackEnd
        Used by `adjust` alone, from now on.
    mapper : Mapper
        Used by `into_map` alone; its owner locks it.
    tell_poses, tell_view : callable
        They tell tracking; called one at a time, so that what it hears last is newest.
    at_once : bool
        Tell what is known before the mapper is done; otherwise as `pipeline.take_keyframe` does.

    """

    def __init__(
        self,
        back_end: BackEnd,
        mapper: Mapper,
        tell_poses: TellPoses,
        tell_view: TellView,
        *,
        at_once: bool,
    ) -> None:
        self._back_end = back_end
        self._mapper = mapper
        self._tell_poses = tell_poses
        self._tell_view = tell_view
        self._at_once = at_once
        self._busy = threading.Lock()  # of the back end
        self._lock = threading.Lock()  # of everything below
        self._run = 0
        self._poses: dict[int, Pose] = {}  # in the mapper
        self._waiting: list[Adjustment] = []  # that the mapper has not made yet
        self._adjusted: set[int] = set()
        self._moves: list[Move] = []  # since the last keyframe
        self._last: StampedPose | None = None  # keyframe, as tracking gave it

    def forget(self) -> None:
        """Give up what is under way; from any thread, before anything newer is adjusted."""
        with self._lock:
            self._run += 1
            self._poses, self._waiting, self._adjusted = {}, [], set()
            self._moves, self._last = [], None

    @property
    def refused_in_row(self) -> int:
        """How many corrections in a row could not be believed."""
        return self._back_end.refused_in_row

    @property
    def refusals(self) -> int:
        """How many could not, since the last reset."""
        return self._back_end.refusals

    def reset(self) -> None:
        """Have the back end forget all keyframes."""
        with self._busy:
            self._back_end.reset()

    def start_from(self, readout_s: float | None) -> None:
        """Begin with a saved map: see `BackEnd.start_from`."""
        self.forget()
        with self._busy:
            self._back_end.start_from(readout_s)

    def resume(self, last: StampedPose | None) -> None:
        """Go on with the mapper's keyframes; `last` is the newest, as tracking gave it."""
        self.start_from(self._mapper.readout_s)
        with self._lock:
            self._poses = self._mapper.keyframe_poses()
            if last is not None:
                self._moves = self._mapper.history.moves_since(last.stamp_ns)
            self._last = last

    def adjust(self, keyframe: Keyframe, tracked: Iterable[StampedPose]) -> Adjustment | None:
        """
        Find out where a new keyframe and the earlier ones are, and tell tracking.

        Parameters
        ----------
        keyframe : Keyframe
            As tracking gave it.
        tracked : iterable of StampedPose
            Of the frames before it, since the last one.

        Returns
        -------
        adjustment : Adjustment or None
            For `into_map`; None if everything was forgotten meanwhile.

        """
        with self._lock:
            run, poses = self._run, self._present()
            stamp_ns, moves = keyframe.frame.stamp_ns, self._moves
            T_placed_tracked = self._placement(keyframe, poses)
            self._moves = [move for move in moves if move[0] > stamp_ns]
        here = se3.identity() if T_placed_tracked is None else T_placed_tracked
        with self._busy:
            for pose in tracked:
                T_tracked_then = moved_between(moves, pose.stamp_ns, stamp_ns)
                T_world_camera = here @ T_tracked_then @ pose.T_world_camera
                self._back_end.observe(pose.stamp_ns, T_world_camera)
            adjustment = adjust(self._back_end, keyframe, poses, T_placed_tracked)
        with self._lock:
            if run != self._run:
                return None
            self._waiting.append(adjustment)
            self._adjusted.add(adjustment.stamp_ns)
            if self._at_once:
                self._tell()
        return adjustment

    def note_move(self, stamp_ns: int, T_new_old: Pose) -> None:
        """Take by what tracking moved its world before the frame of a stamp."""
        with self._lock:
            if self._at_once:
                self._moves = [*self._moves, (stamp_ns, T_new_old)]

    def reenter(self, last_ns: int, T_new_old: Pose) -> None:
        """Take that tracking began again, see `begun_again`."""
        with self._lock:
            if self._at_once:
                self._moves = begun_again(self._moves, last_ns, T_new_old)

    def note_piece(self, first_ns: int, last_ns: int) -> None:
        """Take the time during which a piece of map was made that is part of the world now."""
        with self._lock:
            self._moves = seen_from(self._moves, first_ns, last_ns)

    def _placement(self, keyframe: Keyframe, poses: dict[int, Pose]) -> Pose | None:
        """
        Return what takes a keyframe to the world as it is here; None where that is tracking's.

        Tracking hears of corrections late, and a keyframe that it gives before is in a world that
        is no more. What it says of a keyframe relative to the last one holds in either.
        """
        new = StampedPose(keyframe.frame.stamp_ns, keyframe.T_world_camera)
        last, self._last = self._last, new
        if not self._at_once or last is None or last.stamp_ns not in poses:
            return None
        moved = moved_between(self._moves, last.stamp_ns, new.stamp_ns)
        T_tracked_last = moved @ last.T_world_camera
        return se3.orthonormalise(poses[last.stamp_ns] @ se3.inverse(T_tracked_last))

    def into_map(self, keyframe: Keyframe, adjustment: Adjustment) -> bool:
        """
        Move the map as was found out up to now, and take a keyframe into it.

        Parameters
        ----------
        keyframe : Keyframe
            As tracking gave it.
        adjustment : Adjustment
            What `adjust` said of it.

        Returns
        -------
        answered : bool
            Whether tracking was shown the map.

        """
        with self._lock:
            run = self._run
            if adjustment.stamp_ns not in self._adjusted:
                return False
            for waiting in self._waiting:
                waiting.apply(self._mapper)
            self._waiting = []
            self._poses = self._mapper.keyframe_poses()
        views: list[ModelView] = []

        def show(view: ModelView) -> None:
            views.append(view)
            self._show(view, run)

        ready = adjustment.ready(keyframe, self._mapper)
        view = self._mapper.process(ready, early=show if self._at_once else None)
        with self._lock:
            if run == self._run:
                self._poses = self._mapper.keyframe_poses()
        if view is not None:
            show(view)
        with self._lock:
            self._tell()
        return bool(views)

    def _show(self, view: ModelView, run: int) -> None:
        """Show tracking the map where it believes its keyframe to be, or learns that it is."""
        with self._lock:
            if run == self._run:
                pose = self._moved({view.stamp_ns: view.T_world_camera})[view.stamp_ns]
                self._tell_view(replace(view, T_world_camera=pose))

    def _tell(self) -> None:
        poses = self._present()
        if poses:
            self._tell_poses(poses)

    def _present(self) -> dict[int, Pose]:
        """Return where all keyframes are, with what the mapper is still to learn."""
        return self._moved(self._poses)

    def _moved(self, poses: dict[int, Pose]) -> dict[int, Pose]:
        for adjustment in self._waiting:
            poses = adjustment.moved(poses)
        return poses
