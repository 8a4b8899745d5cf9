"""Build the static Gaussian map from keyframes."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from collections.abc import Callable, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from sensor_msgs.msg import Image
from std_msgs.msg import Bool, Empty

from bdgs_ros.back_end.back_end import BackEnd
from bdgs_ros.bridge import conversions, parameters, topics
from bdgs_ros.bridge.adjuster import Adjuster
from bdgs_ros.bridge.cdr_image import CdrImage, image_from_cdr
from bdgs_ros.bridge.frames import FrameDecoder, FrameSource, RawFrame
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.map_output import MapOutput
from bdgs_ros.bridge.model_view import ModelPublisher
from bdgs_ros.bridge.node_config import MappingNodeConfig
from bdgs_ros.bridge.runner import GraphNode, run
from bdgs_ros.bridge.services import SideNode
from bdgs_ros.bridge.stamped import StampBuffer
from bdgs_ros.bridge.worker import Worker
from bdgs_ros.core import se3
from bdgs_ros.core.errors import BdgsError, ConfigError
from bdgs_ros.core.types import (
    NO_KEYFRAME_NS,
    Keyframe,
    Pose,
    ProbabilityImage,
    RgbdFrame,
    StampedPose,
    Trajectory,
)
from bdgs_ros.data.trajectory_io import parse_pose, write_trajectory
from bdgs_ros.mapping.entrance import check_entrance, entrance
from bdgs_ros.mapping.mapper import Mapper
from bdgs_ros.pipeline import Adjustment

_FRAME_WAIT_S = 2.0
_PENDING_S = 30.0
_LABELS_WAIT_S = 0.3
_LABELS_KEPT = 90
_MAX_LABEL_AGE_NS = 500_000_000
_POSES_KEPT = 1000
_AT_RUN_TIME = ('map_file', 'final_trajectory_file')


class MappingNode(GraphNode):
    """What the static world looks like: `bdgs/model`, `bdgs/rendered` and `bdgs/map`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('mapping_node', **options)
        config = parameters.declare(self, MappingNodeConfig(), runtime=_AT_RUN_TIME)
        cv2.setNumThreads(1)
        self.nice = config.mapping_nice
        self._config = config
        self._health = Health(self, 'mapping')
        self._mapper = Mapper(config.mapping, config.belief, self._is_hurried)
        self._start_pose = _parse_start_pose(config.start_pose)
        self._back_end = Adjuster(
            BackEnd(config.back_end),
            self._mapper,
            self._publish_keyframes,
            lambda view: self._models.publish(view.stamp_ns, view),
            at_once=not config.lockstep,
        )
        self._tracked: deque[StampedPose] = deque(maxlen=_POSES_KEPT)
        self._lock = threading.Lock()  # of the mapper: worker and services
        self._version = 0
        self._saved = (0, time.monotonic())
        self._frames: StampBuffer[RawFrame] = StampBuffer(config.frame_buffer)
        self._labels: StampBuffer[CdrImage] = StampBuffer(_LABELS_KEPT)
        self._decoder = FrameDecoder.of(self)
        self._models = ModelPublisher(self, self._config.map_frame)
        self._output = MapOutput(self, config, self._health)
        self._poses: list[StampedPose] = []
        self._newest: RawFrame | None = None
        self._is_asked = False
        self._adjusting: Worker[Callable[[], None]] = Worker(
            lambda task: task(), self._health.error, None, nice=config.back_end_nice
        )
        self._worker: Worker[Callable[[], None]] = Worker(
            lambda task: task(),
            self._health.error,
            None if config.lockstep else config.keyframe_queue,
            self._on_idle,
            nice=config.mapping_nice,
            source=self._adjusting,
        )
        self._subscribe()
        self._load_at_start()
        self._serve()
        self.get_logger().info(f'mapping is ready: mode {config.mode}')

    def _subscribe(self) -> None:
        self._source = FrameSource(
            self, self._config, self._health, self._keep_frame, self._forget
        )
        self.create_subscription(Image, topics.LABELS, self._keep_labels, topics.KEPT, raw=True)
        self.create_subscription(
            PoseStamped, topics.KEYFRAME, self._queue_keyframe, topics.RELIABLE
        )
        self.create_subscription(PoseStamped, topics.POSE, self._keep_pose, topics.RELIABLE)
        self.create_subscription(PoseStamped, topics.MOVE, self._note_move, topics.RELIABLE)
        self.create_subscription(
            Empty, topics.RESET_EVENT, lambda _: self._forget(), topics.RELIABLE
        )
        self.create_subscription(
            Empty, topics.MAP_REQUEST, lambda _: self._on_request(), topics.RELIABLE
        )
        self._keyframes = self.create_publisher(PathMessage, topics.KEYFRAMES, topics.LATCHED)
        self._localization = self.create_publisher(Bool, topics.LOCALIZATION, topics.LATCHED)

    def _serve(self) -> None:
        # A service waits for the keyframe at hand; meanwhile images must still be taken.
        self._side = SideNode(self)
        self._side.serve_trigger(topics.SAVE_MAP, self._on_save)
        self._side.serve_trigger(topics.LOAD_MAP, self._on_load)
        self._side.serve_trigger(topics.SAVE_FINAL_TRAJECTORY, self._on_save_trajectory)
        self._side.serve_switch(topics.SET_LOCALIZATION_MODE, self._on_localization)
        self._side.start()

    def _keep_frame(self, raw: RawFrame) -> None:
        self._frames.put(raw.stamp_ns, raw)
        self._newest = raw
        self._answer_request()

    def _keep_labels(self, message: bytes) -> None:
        image = image_from_cdr(message)
        self._labels.put(conversions.stamp_ns(image), image)

    def _keep_pose(self, message: PoseStamped) -> None:
        pose = conversions.pose_from_message(message.pose)
        self._poses.append(StampedPose(conversions.stamp_ns(message), pose))
        self._tracked.append(self._poses[-1])
        self._output.note_pose(message, frozen=self._mapper.frozen)
        if self._mapper.frozen:
            self._worker.wake()

    def _note_move(self, message: PoseStamped) -> None:
        T_new_old = conversions.motion_from_message(message)
        self._mapper.history.note_move(conversions.stamp_ns(message), T_new_old)

    def _on_request(self) -> None:
        self._is_asked = True
        self._answer_request()

    def _answer_request(self) -> None:
        """Show tracking the map that it begins in, as soon as the camera is known."""
        if self._is_asked and self._newest is not None:
            self._is_asked = False
            self._worker.put(partial(self._show_entrance, self._newest))

    def _show_entrance(self, raw: RawFrame) -> None:
        view = None
        try:
            camera = self._decoder.camera(raw)
            self._output.see_through(camera, raw.color.header.frame_id)
            with self._lock:
                if len(self._mapper.map):
                    width = self._config.mapping.width
                    view = entrance(self._mapper, self._where_it_starts(), camera, width)
            if view is not None:
                check_entrance(view, self._map_file())
        except BdgsError as error:
            self._health.error(error)
        finally:  # an empty answer says that there is no map
            self._models.publish(NO_KEYFRAME_NS, view)

    def _where_it_starts(self) -> Pose:
        """Return where the camera was last, if tracking asks because it was restarted."""
        return self._poses[-1].T_world_camera if self._poses else self._start_pose

    def _queue_keyframe(self, message: PoseStamped) -> None:
        # Its images are taken along now: they may be forgotten when its turn comes.
        raw = self._frames.get(conversions.stamp_ns(message))
        self._adjusting.put(partial(self._on_keyframe, message, raw))

    def _on_keyframe(self, message: PoseStamped, raw: RawFrame | None) -> None:
        """Have the back end look at a keyframe, then hand it over to the map."""
        stamp_ns = conversions.stamp_ns(message)
        try:
            keyframe = self._assemble(message, raw or self._wait_frame(stamp_ns))
        except BdgsError as error:
            keyframe = None
            self._health.error(error)
        if keyframe is None:
            self._answer_nothing(stamp_ns)
        elif not self._mapper.grows:
            self._worker.put(partial(self._show_map, keyframe))
        else:
            with self._health.timed('back_end'):
                adjustment = self._back_end.adjust(keyframe, self._tracked_until(stamp_ns))
            if adjustment is not None:
                self._worker.put(partial(self._map, keyframe, adjustment))
            self._health.counts['keyframes_dropped'] = self._worker.dropped

    def _answer_nothing(self, stamp_ns: int) -> None:
        """Tell tracking, which waits in lockstep, not to."""
        if self._config.lockstep:
            self._models.publish(stamp_ns, None)

    def _map(self, keyframe: Keyframe, adjustment: Adjustment) -> None:
        answered = False
        try:
            with self._health.timed('mapping'), self._lock:
                answered = self._back_end.into_map(keyframe, adjustment)
                self._version += 1
        except BdgsError as error:
            self._health.error(error)
        if not answered:
            self._answer_nothing(adjustment.stamp_ns)
        self._count_keyframe()

    def _show_map(self, keyframe: Keyframe) -> None:
        """Answer a keyframe with a view of a map that does not change."""
        with self._health.timed('mapping'), self._lock:
            view = self._mapper.process(keyframe)
        self._models.publish(keyframe.frame.stamp_ns, view)
        self._count_keyframe()

    def _count_keyframe(self) -> None:
        self._health.counts['keyframes'] += 1
        self._health.counts['gaussians'] = len(self._mapper.map)

    def _publish_keyframes(self, poses: Mapping[int, Pose]) -> None:
        """Say where the keyframes are now: a closed loop moves those of long ago."""
        stamped = [StampedPose(*item) for item in sorted(poses.items())]
        frame = self._config.map_frame
        self._keyframes.publish(conversions.path_message(stamped, stamped[-1].stamp_ns, frame))

    def _tracked_until(self, stamp_ns: int) -> list[StampedPose]:
        """Take the poses of frames up to a keyframe; the back end knows that one itself."""
        found = []
        while self._tracked and self._tracked[0].stamp_ns < stamp_ns:
            found.append(self._tracked.popleft())
        return found

    def _is_hurried(self) -> bool:
        waiting = self._adjusting.waiting + self._worker.waiting
        return not self._config.lockstep and waiting > 0

    def _wait_frame(self, stamp_ns: int) -> RawFrame | None:
        timeout_s = self._config.lockstep_timeout_s if self._config.lockstep else _FRAME_WAIT_S
        return self._frames.wait(stamp_ns, timeout_s)

    def _assemble(self, message: PoseStamped, raw: RawFrame | None) -> Keyframe | None:
        if raw is None:
            self._health.counts['keyframes_without_frame'] += 1
            self._health.warn('a keyframe was announced whose images never came; it is left out')
            return None
        frame = self._decoder.decode(raw)
        self._output.see_through(frame.camera, raw.color.header.frame_id)
        labels = self._labels_of(frame)
        return Keyframe(frame, conversions.pose_from_message(message.pose), labels)

    def _labels_of(self, frame: RgbdFrame) -> ProbabilityImage:
        """Return the labels of a frame; in real time the nearest ones will do."""
        if self._mapper.frozen:  # they would change nothing
            return np.zeros(frame.camera.shape, np.uint8)
        message = self._find_labels(frame.stamp_ns)
        if message is None:
            self._health.counts['keyframes_without_labels'] += 1
            return np.zeros(frame.camera.shape, np.uint8)
        return conversions.probability_from_message(message, topics.LABELS)

    def _find_labels(self, stamp_ns: int) -> CdrImage | None:
        """Find labels: detection passes images over in real time, so newer ones end the wait."""
        present = self.count_publishers(topics.LABELS) > 0
        if self._config.lockstep and present:
            found = self._labels.wait(stamp_ns, self._config.lockstep_timeout_s)
            if found is not None:
                return found
        wait_s = _LABELS_WAIT_S if present and not self._config.lockstep else 0.0
        return self._labels.nearest(stamp_ns, _MAX_LABEL_AGE_NS, wait_s)

    def _on_idle(self) -> None:
        """Between keyframes: show the map, and save it if that is due."""
        with self._lock:
            more_to_render = self._output.render(self._mapper)
            self._output.publish_map(self._mapper, self._version, self._config.belief.margin)
        period_s = self._config.autosave_s
        version, saved_s = self._saved
        if period_s and self._version != version and time.monotonic() - saved_s >= period_s:
            self._save()
        if more_to_render:
            self._worker.wake()

    def _forget(self) -> None:
        self._frames.clear()
        self._poses = []
        self._newest = None
        self._tracked.clear()
        self._back_end.forget()
        self._adjusting.restart(self._back_end.reset)
        self._worker.restart(self._start_over)

    def _start_over(self) -> None:
        with self._lock:
            if not self._mapper.frozen:  # a map to localise in outlives the camera's jumps
                self._mapper.reset()
                self._version += 1
        self._output.forget()

    def _map_file(self) -> Path:
        file = str(self.get_parameter('map_file').value)
        if not file:
            raise ConfigError("where? set the parameter 'map_file' of mapping_node")
        return Path(file)

    def _on_save(self) -> str:
        self._worker.wait_idle(_PENDING_S)  # keyframes that have arrived belong into the file
        return self._save()

    def _save(self) -> str:
        file = self._map_file()
        with self._lock:
            self._mapper.save(file)
            count = len(self._mapper.map)
        self._saved = (self._version, time.monotonic())
        self._health.publish()
        return f"{count} Gaussians in '{file}'"

    def _on_load(self) -> str:
        file = self._map_file()
        with self._lock:
            self._mapper.load(file)
            self._mapper.history.begin_run()
            self._back_end.start_from(self._mapper.readout_s)
            count = len(self._mapper.map)
        self._version += 1
        return f"{count} Gaussians from '{file}'"

    def _on_save_trajectory(self) -> str:
        file = str(self.get_parameter('final_trajectory_file').value)
        if not file:
            raise ConfigError(
                "where to? set the parameter 'final_trajectory_file' of mapping_node"
            )
        self._worker.wait_idle(_PENDING_S)
        with self._lock:
            final = self._mapper.final_trajectory(Trajectory(tuple(self._poses)))
        write_trajectory(Path(file), final)
        return f"{len(final)} poses in '{file}'"

    def _load_at_start(self) -> None:
        # Without the map there is nothing to localise in; mapping can begin without.
        if self._config.localization or (
            self._config.load_at_start and self._map_file().is_file()
        ):
            self.get_logger().info(self._on_load())
        self._on_localization(self._config.localization)

    def _on_localization(self, enabled: bool) -> str:
        with self._lock:
            self._mapper.frozen = enabled
        self._localization.publish(Bool(data=enabled))
        return 'the map is frozen' if enabled else 'the map grows'

    def close(self) -> None:
        """Stop working."""
        self._side.stop()
        self._adjusting.stop()
        self._worker.stop()


def _parse_start_pose(text: str) -> Pose:
    try:
        return parse_pose(text) if text else se3.identity()
    except ValueError as error:
        raise ConfigError(f"'start_pose': {error}") from error


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(MappingNode, args)


if __name__ == '__main__':
    sys.exit(main())
