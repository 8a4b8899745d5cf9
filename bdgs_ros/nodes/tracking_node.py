"""Publish the camera pose of every frame."""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
from diagnostic_msgs.msg import DiagnosticArray
from std_msgs.msg import Empty, Float64

from bdgs_ros.bridge import parameters, topics
from bdgs_ros.bridge.feedback import FIRST_ABSENT_S, Feedback
from bdgs_ros.bridge.frames import FrameDecoder, FrameSource, RawFrame
from bdgs_ros.bridge.governor import Shed
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.load import LoadWatch
from bdgs_ros.bridge.node_config import TrackingNodeConfig
from bdgs_ros.bridge.pose_output import PoseOutput
from bdgs_ros.bridge.priority import keep_to
from bdgs_ros.bridge.runner import GraphNode, run
from bdgs_ros.bridge.services import serve_switch, serve_trigger
from bdgs_ros.bridge.status import FrameState, FrameStatus, status_to_message
from bdgs_ros.bridge.worker import Worker
from bdgs_ros.core.errors import BdgsError, ConfigError, DatasetError, MapError
from bdgs_ros.core.images import fitted, halved
from bdgs_ros.core.threads import one_thread_in_cv2
from bdgs_ros.core.types import Keyframe, Labels, RgbdFrame, TrackingResult, TrackingStatus
from bdgs_ros.data.trajectory_io import write_trajectory
from bdgs_ros.journal.checkpoints import read_places
from bdgs_ros.journal.folder import map_folder
from bdgs_ros.mapping.map_files import load_places
from bdgs_ros.tracking.camera_tracker import CameraTracker
from bdgs_ros.tracking.piece import Explorer, Piece
from bdgs_ros.tracking.registration import RegistrationWatch

_MOST_WAITING = 30  # frames, however slow tracking is; it takes the newest of them
_AT_RUN_TIME = ('map_file', 'trajectory_file')


class TrackingNode(GraphNode):
    """Where the camera is: `bdgs/pose` and its kin, and `bdgs/status` for every image."""

    def __init__(self, **options: Any) -> None:
        super().__init__('tracking_node', **options)
        config = parameters.declare(self, TrackingNodeConfig(), runtime=_AT_RUN_TIME)
        one_thread_in_cv2()
        keep_to(config.tracking_cpus)
        self._config = config
        self._paused = False
        self._has_begun = False
        self._keyframes = 0
        self._health = Health(self, 'tracking')
        self._tracker = CameraTracker(config.tracking)
        self._explorer = Explorer(config.tracking)
        self._registration = RegistrationWatch(config.tracking.registration)
        self._newest: RgbdFrame | None = None  # to measure that by
        self._joined: list[Piece] = []  # that mapping is to hear of
        self._late_places: list[Keyframe] = []  # that the tracker does not know yet
        self._world = 0  # counts: what was read for one is nothing to the next
        self._output = PoseOutput(self, config, self._health)
        self._status = self.create_publisher(DiagnosticArray, topics.STATUS, topics.RELIABLE)
        self._offset = self.create_publisher(Float64, topics.DEPTH_OFFSET, topics.LATCHED)
        self._reset_event = self.create_publisher(Empty, topics.RESET_EVENT, topics.RELIABLE)
        self._feedback = Feedback(self, config, self._health)
        self._decoder = FrameDecoder.of(self)
        self._load = LoadWatch(self, self._health, enabled=not config.lockstep)
        self.realtime_priority = 0 if config.lockstep else config.realtime_priority
        self._worker: Worker[RawFrame] = Worker(
            self._on_frame,
            self._health.error,
            None if config.lockstep else _MOST_WAITING,
            idle=self._on_idle,
            is_late=self._load.is_late,
            on_drop=self._on_passed_over,
        )
        serve_trigger(self, topics.RESET, self._on_reset)
        serve_switch(self, topics.PAUSE, self._on_pause)
        serve_trigger(self, topics.SAVE_TRAJECTORY, self._on_save)
        self._source = FrameSource(self, config, self._health, self._put, self._forget)
        self.get_logger().info(f'tracking is ready: mode {config.mode}')

    def _put(self, raw: RawFrame) -> None:
        self._load.note_arrival(raw)
        self._worker.put(raw)

    def _on_passed_over(self, raw: RawFrame) -> None:
        self._load.note_passed_over()
        self._finish(raw, FrameStatus(raw.stamp_ns, FrameState.PASSED_OVER))

    def _on_frame(self, raw: RawFrame) -> None:
        with self._load.one_frame():
            self._take(raw)
        self._tracker.compare(self._load.points_share)

    def _take(self, raw: RawFrame) -> None:
        if self._feedback.map_was_replaced():
            self._start_over()
            self.get_logger().info(f"the map is now '{self._feedback.loaded_map}'")
        try:
            frame = None if self._paused else self._decoder.decode(raw)
        except DatasetError as error:
            self._health.set_problem('frame', str(error))
            self._finish(raw, FrameStatus(raw.stamp_ns, FrameState.SKIPPED))
            return
        if frame is None:
            self._finish(raw, FrameStatus(raw.stamp_ns, FrameState.PAUSED))
            return
        self._health.mark('frame', '')
        self._note_depth(frame)
        if not self._has_begun and not self._begin(frame):
            self._finish(raw, FrameStatus(raw.stamp_ns, FrameState.LOST))
            return
        self._track(raw, frame)

    def _note_depth(self, frame: RgbdFrame) -> None:
        lack = self._decoder.lack_of_depth(frame)
        self._health.counts['frames_without_depth'] += bool(lack)
        self._health.set_problem('depth', lack)

    def _begin(self, frame: RgbdFrame) -> bool:
        """Begin at the origin of a new world, or in a map once mapping has shown it."""
        if self._feedback.goes_on and frame.stamp_ns <= self._output.newest_ns:
            self._begin_anew(
                f'the first image, at {frame.stamp_ns} ns, is not newer than the last pose of the '
                f'journal, at {self._output.newest_ns} ns'
            )
        if self._feedback.begins_in_map:
            answered, view = self._feedback.entrance(frame.camera)
            waiting = '' if answered else 'LOST: mapping has not shown the map to begin in'
            self._health.set_problem('lost', waiting)
            if not answered:
                return False
            if view is not None:
                if self._feedback.goes_on and not self._config.lockstep:
                    # It is most likely where it was last: the rest can come later.
                    self._tracker.start_from(view)
                    threading.Thread(
                        target=self._read_places, args=[self._world], daemon=True
                    ).start()
                else:
                    self._tracker.start_from(view, self._places())
                self._explorer.reset(is_known=True)
            elif self._feedback.goes_on:
                self._begin_anew('mapping has no map of the world that the trajectory is in')
        self._has_begun = True
        return True

    def _begin_anew(self, why: str) -> None:
        """Give up what the journal holds, here and in mapping: it cannot be gone on with."""
        if len(self._output.trajectory):
            self.get_logger().warning(f'another world begins: {why}')
        self._feedback.goes_on = False
        self._leave_world()

    def _leave_world(self) -> None:
        """Give up the trajectory and what is known of places, and have the others forget."""
        self._feedback.forget_map()
        self._forget_places()
        self._output.clear()
        self._reset_event.publish(Empty())

    def _forget_places(self) -> None:
        """Give up places that the tracker does not know yet, and those that are being read."""
        self._world += 1
        self._late_places = []

    def _read_places(self, world: int) -> None:
        try:
            places = self._places()
        except (BdgsError, OSError) as error:
            self._health.error(error)
            return
        if world == self._world:
            self._late_places = places

    def _learn_places(self) -> None:
        late, self._late_places = self._late_places, []
        if late:
            self._tracker.learn(late, [np.zeros((6, 6))] * len(late))

    def _places(self) -> list[Keyframe]:
        """Read the keyframes of the map that mapping has: the camera may be anywhere in it."""
        folder = self._config.journal_folder
        kept = read_places(map_folder(folder)) if self._feedback.goes_on and folder else []
        if kept:
            return kept
        begun = str(self.get_parameter('map_file').value) if self._config.begins_in_map else ''
        file = self._feedback.loaded_map or begun
        if not file:
            return []
        try:
            places = load_places(Path(file))
        except MapError as error:  # on another computer, perhaps
            self.get_logger().warning(f'the camera must start near start_pose: {error}')
            return []
        self.get_logger().info(f"{len(places)} places to recognise from '{file}'")
        return places

    def _track(self, raw: RawFrame, frame: RgbdFrame) -> None:
        self._tell_joined()
        self._newest = frame
        labels = self._feedback.labels(frame)
        frame = halved(frame, self._config.camera.width)
        labels = labels and fitted(labels, frame)
        for view in self._feedback.new_models():
            self._tracker.set_model(view)
        self._tracker.note_keyframes(self._feedback.moved_keyframes())
        move = self._tracker.take_move()
        if move is not None:
            self._output.publish_move(raw.stamp_ns, move)
        self._learn_places()
        started = time.perf_counter()
        result = self._tracker.process(frame, labels, self._is_hurried())
        self._explore(frame, labels, result)
        tracking_ms = (time.perf_counter() - started) * 1e3
        result = self._announced(result)
        if result.is_keyframe and self._config.lockstep and self._keyframes == 1:
            self._output.wait_for_mapping(FIRST_ABSENT_S)  # the first one would be lost on it
        if result.status is TrackingStatus.OK:
            self._feedback.note_keyframe(result, frame.camera)
            self._output.publish(result, raw.color.header.frame_id)
        latency_ms = (time.monotonic() - raw.received_s) * 1e3
        self._load.note_pose(raw)
        if result.is_keyframe and self._config.lockstep:
            self._tracker.set_model(self._feedback.wait_model(result.stamp_ns))
        self._report(raw, result, tracking_ms, latency_ms)

    def _explore(self, frame: RgbdFrame, labels: Labels | None, result: TrackingResult) -> None:
        """Follow a camera that is lost, until it is known where it has been meanwhile."""
        piece = self._explorer.follow(frame, labels, result)
        self._health.counts['piece_s'] = round(self._explorer.length_s)
        if self._explorer.keyframe_ns == frame.stamp_ns:
            self._output.publish_piece_keyframe(frame.stamp_ns)
        if piece is None:
            return
        self._joined.append(piece)
        if piece.is_new_world:  # mapping shall forget first, and hear of the rest after that
            self._give_up_for(piece)
        else:
            self._tell_joined()
        self._tracker.learn(piece.keyframes, piece.covariances)

    def _give_up_for(self, piece: Piece) -> None:
        """Begin anew with a piece of map, all of which was seen since the camera was lost."""
        self._feedback.clear()
        self._leave_world()
        self._tracker.start_from(piece.entrance())

    def _tell_joined(self) -> None:
        for piece in self._joined:
            self._output.publish_piece(piece)
        self._joined = []

    def _announced(self, result: TrackingResult) -> TrackingResult:
        """Under the greatest load every other keyframe is one to tracking alone."""
        if not result.is_keyframe:
            return result
        self._keyframes += 1
        is_left_out = self._load.level >= Shed.KEYFRAMES and self._keyframes % 2 == 0
        self._health.counts['keyframes_left_out'] += is_left_out
        return replace(result, is_keyframe=not is_left_out)

    def _is_hurried(self) -> bool:
        return not self._config.lockstep and self._worker.waiting > 0

    def _report(
        self, raw: RawFrame, result: TrackingResult, tracking_ms: float, latency_ms: float
    ) -> None:
        lost = result.status is TrackingStatus.LOST
        self._health.add_timing('tracking', tracking_ms)
        self._health.add_timing('image_to_pose', latency_ms)
        self._health.counts['keyframes'] += result.is_keyframe
        self._health.set_problem('lost', 'LOST: no pose is published' if lost else '')
        status = FrameStatus(
            raw.stamp_ns,
            FrameState.LOST if lost else FrameState.OK,
            result.is_keyframe,
            result.inlier_ratio,
            result.overlap,
            tracking_ms,
            latency_ms,
        )
        self._finish(raw, status)

    def _finish(self, raw: RawFrame, status: FrameStatus) -> None:
        """Acknowledge an image, whatever became of it."""
        self._health.counts[f'frames_{status.state.value}'] += 1
        self._health.counts['frames_dropped'] = self._worker.dropped
        self._status.publish(status_to_message(status, raw.color.header.frame_id))

    def _on_idle(self) -> None:
        """After each frame, its pose being out."""
        if self._has_begun:
            self._tracker.rest()
        if self._newest is not None and not self._is_hurried():
            self._measure(self._newest)
        self._newest = None

    def _measure(self, frame: RgbdFrame) -> None:
        """Find out whether colour and depth belong together; correct stamps if that is allowed."""
        watch = self._registration
        watch.add(frame)
        self._health.mark('registration', watch.objection)
        found, config = watch.found, self._config
        is_late = found is not None and found.is_late(config.tracking.registration)
        if found is None or not is_late or not config.camera.estimate_depth_offset:
            return
        offset_s = self._source.depth_offset_s + found.depth_offset_s
        self.get_logger().warning(f'stamps of depth are late by {offset_s:.3f} s: corrected')
        self._offset.publish(Float64(data=offset_s))
        watch.reset()

    def _forget(self) -> None:
        """Start over: the next frame is the origin of the world."""
        self._feedback.forget_map()
        self._worker.restart(self._reset)

    def _reset(self) -> None:
        self._start_over()
        self.get_logger().info('reset: the next frame is the origin')

    def _start_over(self) -> None:
        self._forget_places()
        self._tracker.reset()
        self._explorer.reset()
        self._joined = []
        self._has_begun = False
        self._feedback.clear()
        self._feedback.goes_on = False
        self._output.clear()

    def _on_reset(self) -> str:
        self._source.clear()
        self._forget()
        self._reset_event.publish(Empty())
        return 'everything forgotten'

    def _on_pause(self, paused: bool) -> str:
        self._paused = paused
        return 'paused' if paused else 'going on'

    def results(self) -> list[Callable[[], str]]:
        """Return what saves the trajectory."""
        return [self._on_save] if self.get_parameter('trajectory_file').value else []

    def _on_save(self) -> str:
        file = str(self.get_parameter('trajectory_file').value)
        if not file:
            raise ConfigError("where to? set the parameter 'trajectory_file' of tracking_node")
        trajectory = self._output.trajectory
        write_trajectory(Path(file), trajectory)
        self._health.publish()
        return f"{len(trajectory)} poses in '{file}'"

    def close(self) -> None:
        """Stop working."""
        self._worker.stop()
        self._output.close()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(TrackingNode, args)


if __name__ == '__main__':
    sys.exit(main())
