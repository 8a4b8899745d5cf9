"""The camera's topics in, rectified RGB-D frames out."""

from __future__ import annotations

import time
from collections import deque
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
from rclpy.clock import Clock
from rclpy.clock_type import ClockType
from rclpy.event_handler import SubscriptionEventCallbacks
from rclpy.node import Node
from sensor_msgs.msg import CameraInfo, Image
from std_msgs.msg import Float64

from bdgs_ros.bridge import conversions, topics
from bdgs_ros.bridge.cdr_image import CdrImage, image_from_cdr
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.node_config import GraphConfig
from bdgs_ros.bridge.synchroniser import Patience, Synchroniser
from bdgs_ros.bridge.watchdog import Watchdog
from bdgs_ros.core.camera import PinholeCamera, Rectifier
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import DepthImage, RgbdFrame
from bdgs_ros.data.trajectory_io import seconds_to_ns

_WATCH_PERIOD_S = 0.5
_HELD_FOR_INFO = 10
_DEPTH_STRIDE = 8
_PLAUSIBLE_M = (0.02, 30.0)


@dataclass(frozen=True)
class RawFrame:
    """A colour message with its depth and the camera that made them, not decoded yet."""

    stamp_ns: int
    color: CdrImage
    depth: CdrImage
    info: CameraInfo
    received_s: float
    """When the later of the two arrived, monotonic clock."""
    depth_delay_ns: int = 0
    """From the stamp of colour to that of depth, as corrected."""


class FrameSource:
    """
    Subscribe to colour, depth and camera_info, and pair them.

    Parameters
    ----------
    node : Node
        It subscribes.
    config : GraphConfig
        Tolerances, quality of service, and whether the graph runs in lockstep.
    health : Health
        Gets counts and problems.
    on_frame : callable
        Called with every pair, in order, in the executor's thread.
    on_jump : callable
        Called when the stamps jump back, before anything newer.

    """

    def __init__(
        self,
        node: Node,
        config: GraphConfig,
        health: Health,
        on_frame: Callable[[RawFrame], None],
        on_jump: Callable[[], None],
    ) -> None:
        self._node = node
        self._health = health
        self._on_frame = on_frame
        self._info: CameraInfo | None = None
        self._offset_ns = seconds_to_ns(config.camera.depth_offset_s)
        self._held: deque[tuple[CdrImage, CdrImage]] = deque(maxlen=_HELD_FOR_INFO)
        self._sync: Synchroniser[CdrImage, CdrImage] = Synchroniser(
            seconds_to_ns(config.sync.tolerance_s),
            seconds_to_ns(config.sync.jump_back_s),
            Patience.EAGER if config.lockstep else Patience.PREDICT,
            on_jump,
        )
        node.create_subscription(Float64, topics.DEPTH_OFFSET, self._on_offset, topics.LATCHED)
        self._names = {
            topic: node.resolve_topic_name(topic)
            for topic in (topics.COLOR, topics.DEPTH, topics.COLOR_INFO)
        }
        self._watchdog = Watchdog(config.silence_s, time.monotonic(), node.count_publishers)
        for topic, name in self._names.items():
            self._watchdog.expect(name, once=topic == topics.COLOR_INFO)
        self._subscribe(config)
        self._timer = node.create_timer(
            _WATCH_PERIOD_S, self._watch, clock=Clock(clock_type=ClockType.STEADY_TIME)
        )

    @property
    def depth_offset_s(self) -> float:
        """By how much stamps of depth are taken to be late."""
        return 1e-9 * self._offset_ns

    def _on_offset(self, message: Float64) -> None:
        self._offset_ns = seconds_to_ns(message.data)
        self._sync.clear()  # what waits has stamps as they were

    def clear(self) -> None:
        """Forget images that wait for a partner."""
        self._sync.clear()
        self._held.clear()

    def _subscribe(self, config: GraphConfig) -> None:
        qos = topics.image_qos(config.qos)
        for topic, kind, callback in (
            (topics.COLOR, Image, self._on_color),
            (topics.DEPTH, Image, self._on_depth),
            (topics.COLOR_INFO, CameraInfo, self._on_info),
        ):
            events = SubscriptionEventCallbacks(
                incompatible_qos=lambda event, name=self._names[topic]: self._on_incompatible(
                    name, event.last_policy_kind
                ),
                message_lost=lambda event: self._on_lost(event.total_count_change),
            )
            self._node.create_subscription(
                kind, topic, callback, qos, event_callbacks=events, raw=kind is Image
            )

    def _on_incompatible(self, name: str, policy: object) -> None:
        self._health.set_problem(
            f'qos {name}',
            f"'{name}': a publisher offers a quality of service ({policy}) that this subscription "
            'does not accept, so nothing will arrive; try qos.reliability:=best_effort',
        )

    def _on_lost(self, count: int) -> None:
        self._health.counts['messages_lost_by_dds'] += count

    def _on_info(self, message: CameraInfo) -> None:
        self._watchdog.note(self._names[topics.COLOR_INFO], time.monotonic())
        self._info = message
        while self._held:
            self._emit([self._held.popleft()])

    def _on_color(self, message: bytes) -> None:
        self._watchdog.note(self._names[topics.COLOR], time.monotonic())
        image = image_from_cdr(message)
        self._emit(self._sync.add_left(conversions.stamp_ns(image), image))

    def _on_depth(self, message: bytes) -> None:
        self._watchdog.note(self._names[topics.DEPTH], time.monotonic())
        image = image_from_cdr(message)
        self._emit(self._sync.add_right(self._stamp_of_depth(image), image))

    def _stamp_of_depth(self, image: CdrImage) -> int:
        return conversions.stamp_ns(image) - self._offset_ns

    def _emit(self, pairs: list[tuple[CdrImage, CdrImage]]) -> None:
        for color, depth in pairs:
            if self._info is None:
                self._held.append((color, depth))
                continue
            stamp_ns = conversions.stamp_ns(color)
            delay_ns = self._stamp_of_depth(depth) - stamp_ns
            now_s = time.monotonic()
            self._on_frame(RawFrame(stamp_ns, color, depth, self._info, now_s, delay_ns))
        self._count()

    def _count(self) -> None:
        counts = self._sync.counts
        self._health.counts['frames_received'] = counts.pairs
        self._health.counts['color_without_depth'] = counts.unpaired_left
        self._health.counts['depth_without_color'] = counts.unpaired_right
        self._health.counts['out_of_order'] = counts.out_of_order
        self._health.counts['duplicates'] = counts.duplicates
        self._health.counts['jumps_back'] = counts.jumps
        self._health.counts['strange_stamps'] = counts.strange

    def _watch(self) -> None:
        logger = self._node.get_logger()
        for change in self._watchdog.check(time.monotonic()):
            if change.is_bad:  # rclpy wants one line of code per severity
                logger.warning(change.text)
            else:
                logger.info(change.text)
        silent = self._watchdog.silent()
        self._health.mark('silent', f'silent: {", ".join(silent)}' if silent else '')
        counts = self._sync.counts
        stand = counts.pairs <= 1 and counts.duplicates > _HELD_FOR_INFO
        self._health.set_problem(
            'stamps',
            f"{counts.duplicates} images on '{self._names[topics.COLOR]}' and "
            f"'{self._names[topics.DEPTH]}' have the stamp of the one before and are left out: "
            'stamps must advance; have the driver fill header.stamp'
            if stand
            else '',
        )
        apart = not silent and counts.pairs == 0 and counts.unpaired_left > _HELD_FOR_INFO
        self._health.set_problem(
            'apart',
            f"colour on '{self._names[topics.COLOR]}' and depth on '{self._names[topics.DEPTH]}' "
            'both arrive, but no two stamps are close enough; synchronise the camera, or raise '
            'sync.tolerance_s'
            if apart
            else '',
        )


class FrameDecoder:
    """
    Decode and rectify frames, and refuse what cannot be used with one clear message.

    Parameters
    ----------
    color_topic, depth_topic, info_topic : str
        Resolved names, for the messages.

    """

    def __init__(self, color_topic: str, depth_topic: str, info_topic: str) -> None:
        self._color_topic = color_topic
        self._depth_topic = depth_topic
        self._info_topic = info_topic
        self._rectifier: tuple[PinholeCamera, Rectifier] | None = None

    @classmethod
    def of(cls, node: Node) -> FrameDecoder:
        """Make a decoder that names the topics as a node resolves them."""
        color, depth, info = (
            node.resolve_topic_name(t) for t in (topics.COLOR, topics.DEPTH, topics.COLOR_INFO)
        )
        return cls(color, depth, info)

    def decode(self, raw: RawFrame) -> RgbdFrame:
        """
        Turn messages into a frame.

        Raises
        ------
        DatasetError
            If an encoding or size is not as expected, the camera is not calibrated, or the scale
            of the depth is not plausible. No depth at all is no error: a lens may be covered.

        """
        camera = conversions.camera_from_message(raw.info, self._info_topic)
        self._check_size('colour image', self._color_topic, raw.color, camera)
        self._check_size('depth image', self._depth_topic, raw.depth, camera)
        color = conversions.color_from_message(raw.color, self._color_topic)
        depth_m = conversions.depth_from_message(raw.depth, self._depth_topic)
        self._check_depth(depth_m, raw.depth.encoding)
        rectifier = self._rectifier_of(camera)
        return RgbdFrame(
            raw.stamp_ns,
            rectifier.color(color),
            rectifier.depth(depth_m),
            rectifier.camera,
            raw.depth_delay_ns,
        )

    def camera(self, raw: RawFrame) -> PinholeCamera:
        """Return the camera of the frame that `decode` would make; raises `DatasetError`."""
        camera = conversions.camera_from_message(raw.info, self._info_topic)
        return self._rectifier_of(camera).camera

    def _rectifier_of(self, camera: PinholeCamera) -> Rectifier:
        if self._rectifier is None or self._rectifier[0] != camera:
            self._rectifier = (camera, Rectifier(camera))
        return self._rectifier[1]

    def lack_of_depth(self, frame: RgbdFrame) -> str:
        """Say in words that a frame has no depth; nothing where it has."""
        if frame.depth_m.any():
            return ''
        return (
            f"topic '{self._depth_topic}': expected depth, received an image of zeros or NaN; "
            'unless the camera is covered, check it: colour alone tells the pose for a while, but '
            'no keyframe can be made'
        )

    def _check_size(self, what: str, topic: str, image: CdrImage, camera: PinholeCamera) -> None:
        if (image.width, image.height) != (camera.width, camera.height):
            raise DatasetError(
                f"topic '{topic}': expected a {what} of {camera.width}x{camera.height} as "
                f"camera_info on '{self._info_topic}' says, received "
                f'{image.width}x{image.height}; depth must be registered to colour '
                '(aligned_depth_to_color or the like)'
            )

    def _check_depth(self, depth_m: DepthImage, encoding: str) -> None:
        sample = depth_m[::_DEPTH_STRIDE, ::_DEPTH_STRIDE]
        median = float(np.median(sample[sample > 0])) if sample.any() else 1.0
        low, high = _PLAUSIBLE_M
        if not low <= median <= high:
            limit = f'more than {high:g} m' if median > high else f'less than {low:g} m'
            raise DatasetError(
                f"topic '{self._depth_topic}': expected depth in mm (16UC1) or m (32FC1), "
                f"received '{encoding}' of {limit} in the median; check its scale"
            )
