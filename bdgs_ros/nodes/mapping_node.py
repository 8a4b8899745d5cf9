"""Build the static Gaussian map from keyframes."""

from __future__ import annotations

import sys
import threading
import time
from collections import deque
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from geometry_msgs.msg import PoseStamped
from rclpy.callback_groups import MutuallyExclusiveCallbackGroup
from rclpy.executors import MultiThreadedExecutor
from sensor_msgs.msg import Image
from std_msgs.msg import Empty

from bdgs_ros.back_end.back_end import BackEnd
from bdgs_ros.bridge import conversions, parameters, topics
from bdgs_ros.bridge.frames import FrameDecoder, FrameSource, RawFrame
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.map_output import MapOutput, Viewpoint
from bdgs_ros.bridge.model_view import ModelPublisher
from bdgs_ros.bridge.node_config import MappingNodeConfig
from bdgs_ros.bridge.runner import GraphNode, run
from bdgs_ros.bridge.services import serve_switch, serve_trigger
from bdgs_ros.bridge.stamped import StampBuffer
from bdgs_ros.bridge.worker import Worker
from bdgs_ros.core.errors import BdgsError, ConfigError
from bdgs_ros.core.types import Keyframe, ModelView, ProbabilityImage, RgbdFrame
from bdgs_ros.mapping.mapper import Mapper
from bdgs_ros.pipeline import take_keyframe

_FRAME_WAIT_S = 2.0
_PENDING_S = 30.0
_LABELS_WAIT_S = 0.3
_LABELS_KEPT = 90
_MAX_LABEL_AGE_NS = 500_000_000
_POSES_KEPT = 1000


class MappingNode(GraphNode):
    """What the static world looks like: `bdgs/model`, `bdgs/rendered` and `bdgs/map`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('mapping_node', **options)
        config = parameters.declare(self, MappingNodeConfig(), runtime=('map_file',))
        cv2.setNumThreads(1)
        self._config = config
        self._health = Health(self, 'mapping')
        self._mapper = Mapper(config.mapping, config.belief)
        self._back_end = BackEnd(config.back_end)
        self._tracked: deque[PoseStamped] = deque(maxlen=_POSES_KEPT)
        self._lock = threading.Lock()  # of the mapper: worker and services
        self._version = 0
        self._saved = (0, time.monotonic())
        self._frames: StampBuffer[RawFrame] = StampBuffer(config.frame_buffer)
        self._labels: StampBuffer[Image] = StampBuffer(_LABELS_KEPT)
        self._decoder = FrameDecoder.of(self)
        self._models = ModelPublisher(self, self._config.map_frame)
        self._output = MapOutput(self, config)
        self._viewpoint: Viewpoint | None = None
        self._pose: PoseStamped | None = None
        self._frame: tuple[RgbdFrame, str] | None = None
        self._worker: Worker[tuple[PoseStamped, RawFrame | None]] = Worker(
            self._on_keyframe,
            self._health.error,
            None if config.lockstep else config.keyframe_queue,
            self._on_idle,
            nice=config.mapping_nice,
        )
        self._load_at_start()
        self._subscribe()
        self._serve()
        self.get_logger().info(f'mapping is ready: mode {config.mode}')

    def _subscribe(self) -> None:
        self._source = FrameSource(
            self, self._config, self._health, self._keep_frame, self._forget
        )
        self.create_subscription(
            Image,
            topics.LABELS,
            lambda message: self._labels.put(conversions.stamp_ns(message), message),
            topics.KEPT,
        )
        self.create_subscription(
            PoseStamped, topics.KEYFRAME, self._queue_keyframe, topics.RELIABLE
        )
        self.create_subscription(PoseStamped, topics.POSE, self._keep_pose, topics.RELIABLE)
        self.create_subscription(
            Empty, topics.RESET_EVENT, lambda _: self._forget(), topics.RELIABLE
        )

    def _serve(self) -> None:
        # A service waits for the keyframe at hand; meanwhile images must still be taken.
        group = MutuallyExclusiveCallbackGroup()
        serve_trigger(self, topics.SAVE_MAP, self._on_save, group)
        serve_trigger(self, topics.LOAD_MAP, self._on_load, group)
        serve_switch(self, topics.SET_LOCALIZATION_MODE, self._on_localization, group)

    def _keep_frame(self, raw: RawFrame) -> None:
        self._frames.put(raw.stamp_ns, raw)

    def _keep_pose(self, message: PoseStamped) -> None:
        self._pose = message
        self._tracked.append(message)

    def _queue_keyframe(self, message: PoseStamped) -> None:
        # Its images are taken along now: they may be forgotten when its turn comes.
        self._worker.put((message, self._frames.get(conversions.stamp_ns(message))))

    def _on_keyframe(self, item: tuple[PoseStamped, RawFrame | None]) -> None:
        message, raw = item
        stamp_ns = conversions.stamp_ns(message)
        view = None
        try:
            keyframe = self._assemble(message, raw or self._wait_frame(stamp_ns))
            if keyframe is not None:
                view = self._map(keyframe)
        except BdgsError as error:
            self._health.error(error)
        finally:  # an empty answer tells tracking not to wait
            self._models.publish(stamp_ns, view)
        self._health.counts['gaussians'] = len(self._mapper.map)
        self._health.counts['keyframes_dropped'] = self._worker.dropped

    def _map(self, keyframe: Keyframe) -> ModelView | None:
        with self._health.timed('mapping'), self._lock:
            self._observe_until(keyframe.frame.stamp_ns)
            view = take_keyframe(self._back_end, self._mapper, keyframe)
        self._version += 1
        self._health.counts['keyframes'] += 1
        return view

    def _observe_until(self, stamp_ns: int) -> None:
        """Give the back end the poses of frames up to a keyframe; it knows that one itself."""
        while self._tracked and conversions.stamp_ns(self._tracked[0]) < stamp_ns:
            message = self._tracked.popleft()
            pose = conversions.pose_from_message(message.pose)
            self._back_end.observe(conversions.stamp_ns(message), pose)

    def _wait_frame(self, stamp_ns: int) -> RawFrame | None:
        timeout_s = self._config.lockstep_timeout_s if self._config.lockstep else _FRAME_WAIT_S
        return self._frames.wait(stamp_ns, timeout_s)

    def _assemble(self, message: PoseStamped, raw: RawFrame | None) -> Keyframe | None:
        if raw is None:
            self._health.counts['keyframes_without_frame'] += 1
            self._health.warn('a keyframe was announced whose images never came; it is left out')
            return None
        frame = self._decoder.decode(raw)
        self._frame = (frame, raw.color.header.frame_id)
        labels = self._labels_of(frame)
        return Keyframe(frame, conversions.pose_from_message(message.pose), labels)

    def _labels_of(self, frame: RgbdFrame) -> ProbabilityImage:
        """Return the labels of a frame; in real time the nearest older ones will do."""
        present = self.count_publishers(topics.LABELS) > 0
        limit_s = self._config.lockstep_timeout_s if self._config.lockstep else _LABELS_WAIT_S
        message = self._labels.wait(frame.stamp_ns, limit_s if present else 0.0)
        if message is None:
            message = self._labels.newest(frame.stamp_ns, _MAX_LABEL_AGE_NS)
        if message is None:
            self._health.counts['keyframes_without_labels'] += 1
            return np.zeros(frame.camera.shape, np.uint8)
        return conversions.probability_from_message(message, topics.LABELS)

    def _on_idle(self) -> None:
        """Between keyframes: show the map, and save it if that is due."""
        with self._lock:
            self._output.render(self._mapper, self._latest_viewpoint())
            self._output.publish_map(self._mapper, self._version, self._config.belief.margin)
        period_s = self._config.autosave_s
        version, saved_s = self._saved
        if period_s and self._version != version and time.monotonic() - saved_s >= period_s:
            self._save()

    def _latest_viewpoint(self) -> Viewpoint | None:
        if self._pose is None or self._frame is None:
            return None
        frame, frame_id = self._frame
        width = min(self._config.mapping.width, frame.camera.width)
        return Viewpoint(
            conversions.stamp_ns(self._pose),
            conversions.pose_from_message(self._pose.pose),
            frame.camera.scaled(width / frame.camera.width),
            frame_id,
        )

    def _forget(self) -> None:
        self._frames.clear()
        self._worker.restart(self._start_over)

    def _start_over(self) -> None:
        with self._lock:
            if not self._mapper.frozen:  # a map to localise in outlives the camera's jumps
                self._mapper.reset()
            self._back_end.reset()
            self._tracked.clear()
        self._pose = None
        self._version += 1

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
            self._back_end.reset()
            count = len(self._mapper.map)
        self._version += 1
        return f"{count} Gaussians from '{file}'"

    def _load_at_start(self) -> None:
        if self._config.load_at_start and self._map_file().is_file():
            self.get_logger().info(self._on_load())

    def _on_localization(self, enabled: bool) -> str:
        with self._lock:
            self._mapper.frozen = enabled
        return 'the map is frozen' if enabled else 'the map grows'

    def close(self) -> None:
        """Stop working."""
        self._worker.stop()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(MappingNode, args, lambda: MultiThreadedExecutor(2))


if __name__ == '__main__':
    sys.exit(main())
