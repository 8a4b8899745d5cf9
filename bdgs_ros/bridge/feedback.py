"""What tracking gets from the other nodes: labels of its frame, model views of its keyframes."""

from __future__ import annotations

import math
import time
from collections import OrderedDict
from typing import TypeVar

from nav_msgs.msg import Path
from rclpy.node import Node
from sensor_msgs.msg import Image
from std_msgs.msg import Bool, Empty, String

from bdgs_ros.bridge import conversions, topics
from bdgs_ros.bridge.cdr_image import CdrImage, image_from_cdr
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.model_view import ModelMessages, ModelSubscription, decode_model
from bdgs_ros.bridge.node_config import TrackingNodeConfig
from bdgs_ros.bridge.stamped import StampBuffer
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import NO_KEYFRAME_NS, Labels, ModelView, Pose, RgbdFrame, TrackingResult
from bdgs_ros.data.trajectory_io import seconds_to_ns

Item = TypeVar('Item')

_LABELS_KEPT = 30
_MODELS_KEPT = 4
_KEYFRAMES_KEPT = 300
_ASK_PERIOD_S = 0.3  # discovery may be under way, and what is said then gets lost
_ABSENT_S = 1.0
FIRST_ABSENT_S = 5.0  # the first message can be later than the discovery of its publisher


class Feedback:
    """
    Labels and model views, found by stamp.

    In lockstep the exact ones are waited for, since `BdgsSlam` has them too; in real time the
    newest are taken and nothing is waited for.

    Parameters
    ----------
    node : Node
        It subscribes.
    config : TrackingNodeConfig
        Mode and time limits.
    health : Health
        Gets told when a peer is silent.

    """

    def __init__(self, node: Node, config: TrackingNodeConfig, health: Health) -> None:
        self._node = node
        self._config = config
        self._health = health
        self._labels: StampBuffer[CdrImage] = StampBuffer(_LABELS_KEPT)
        self._models: StampBuffer[tuple[int, ModelMessages]] = StampBuffer(_MODELS_KEPT)
        self._heard: set[str] = set()
        self._keyframes: OrderedDict[int, PinholeCamera] = OrderedDict()
        self._asked_s = -math.inf
        self._map_is_frozen = config.localization
        self.loaded_map = ''
        """The file of the map that mapping has loaded at run time and still has."""
        self._is_replaced = False
        self.goes_on = config.resume
        """Whether mapping may have the map of a run before, which this one goes on with."""
        self._has_heard_of_map = False
        self._request = node.create_publisher(Empty, topics.MAP_REQUEST, topics.RELIABLE)
        node.create_subscription(Bool, topics.LOCALIZATION, self._on_localization, topics.LATCHED)
        node.create_subscription(String, topics.MAP_LOADED, self._on_map_loaded, topics.LATCHED)
        node.create_subscription(Image, topics.LABELS, self._keep_labels, topics.KEPT, raw=True)
        self._moved: dict[int, Pose] = {}
        node.create_subscription(Path, topics.KEYFRAMES, self._on_keyframes, topics.LATCHED)
        self._subscription = ModelSubscription(
            node, lambda stamp_ns, found: self._models.put(stamp_ns, (stamp_ns, found))
        )

    def _keep_labels(self, message: bytes) -> None:
        image = image_from_cdr(message)
        self._labels.put(conversions.stamp_ns(image), image)

    def _on_keyframes(self, message: Path) -> None:
        self._moved = conversions.poses_from_path(message)

    def moved_keyframes(self) -> dict[int, Pose]:
        """Return where mapping has the keyframes, if it has said so since the last call."""
        moved, self._moved = self._moved, {}
        return moved

    def _on_localization(self, message: Bool) -> None:
        self._map_is_frozen = message.data

    def _on_map_loaded(self, message: String) -> None:
        is_news = self._has_heard_of_map or not self.goes_on  # else it was loaded in that run
        self._has_heard_of_map = True
        self.loaded_map, self._is_replaced = message.data, bool(message.data) and is_news

    def map_was_replaced(self) -> bool:
        """Return whether mapping has loaded another map since the last call."""
        replaced, self._is_replaced = self._is_replaced, False
        return replaced

    def forget_map(self) -> None:
        """Expect mapping to forget its map with everything else, unless it is frozen."""
        if not self._map_is_frozen:
            self.loaded_map = ''

    @property
    def begins_in_map(self) -> bool:
        """Whether the first frame is to be found in a map that exists."""
        in_file = self._config.begins_in_map or self._map_is_frozen or bool(self.loaded_map)
        return in_file or self.goes_on

    def entrance(self, camera: PinholeCamera) -> tuple[bool, ModelView | None]:
        """
        Return whether mapping has answered, and the view of its map if it has one.

        Mapping is asked again and again until it answers; lockstep waits for the answer.
        """
        limit_s = self._config.lockstep_timeout_s if self._config.lockstep else 0.0
        deadline = time.monotonic() + limit_s
        while True:
            now = time.monotonic()
            if now - self._asked_s >= _ASK_PERIOD_S:
                self._asked_s = now
                self._request.publish(Empty())
            found = self._models.wait(NO_KEYFRAME_NS, min(_ASK_PERIOD_S, max(0.0, deadline - now)))
            if found is not None or now >= deadline:
                break
        self._keyframes[NO_KEYFRAME_NS] = camera
        return found is not None, None if found is None else self._decode(*found)

    def labels(self, frame: RgbdFrame) -> Labels | None:
        """Return the labels of a frame, in real time of the newest frame that has any."""
        message = self._find_labels(frame.stamp_ns)
        self._health.mark('labels', '' if message else f'no labels on {topics.LABELS}')
        if message is None:
            self._health.counts['frames_without_labels'] += 1
            return None
        try:
            p_dynamic = conversions.probability_from_message(message, topics.LABELS)
            if p_dynamic.shape != frame.camera.shape:
                raise DatasetError(
                    f"topic '{topics.LABELS}': expected shape {frame.camera.shape}, "
                    f'received {p_dynamic.shape}'
                )
        except DatasetError as error:
            self._health.warn(str(error))
            return None
        stamp_ns = conversions.stamp_ns(message)
        self._health.add_timing('labels_age', (frame.stamp_ns - stamp_ns) * 1e-6)
        return Labels(stamp_ns, p_dynamic)

    def _find_labels(self, stamp_ns: int) -> CdrImage | None:
        if self._config.lockstep:
            return self._wait(self._labels, stamp_ns, topics.LABELS)
        max_age_ns = seconds_to_ns(self._config.labels_max_age_s)
        return self._labels.newest(stamp_ns, max_age_ns)

    def _wait(self, buffer: StampBuffer[Item], stamp_ns: int, topic: str) -> Item | None:
        """Wait for a stamp; not for long where nobody publishes."""
        patience_s = _ABSENT_S if topic in self._heard else FIRST_ABSENT_S
        item = buffer.wait(stamp_ns, patience_s)
        present = self._node.count_publishers(topic) > 0
        if item is None and present:
            item = buffer.wait(stamp_ns, self._config.lockstep_timeout_s - patience_s)
        self._heard.add(topic)
        if item is None:
            state = 'its publisher is silent' if present else 'it has no publisher'
            self._health.counts['lockstep_timeouts'] += 1
            self._health.warn(
                f"lockstep: nothing on '{self._node.resolve_topic_name(topic)}' for the frame at "
                f'hand, {state}; going on without'
            )
        return item

    def note_keyframe(self, result: TrackingResult, camera: PinholeCamera) -> None:
        """Remember a keyframe's camera: its model view comes back without."""
        if not result.is_keyframe:
            return
        mapped = self._node.count_publishers(topics.MODEL_IMAGE) > 0
        self._health.mark('mapping', '' if mapped else 'no mapping: frame to keyframe only')
        self._keyframes[result.stamp_ns] = camera
        while len(self._keyframes) > _KEYFRAMES_KEPT:
            self._keyframes.popitem(last=False)

    def wait_model(self, stamp_ns: int) -> ModelView | None:
        """Return the model view of a keyframe; None if mapping has none, or is absent."""
        found = self._wait(self._models, stamp_ns, topics.MODEL_IMAGE)
        self._models.clear()
        return None if found is None else self._decode(*found)

    def new_models(self) -> list[ModelView]:
        """Return the newest model view that has come since the last call, or nothing."""
        found = self._models.take_newest()
        view = None if found is None else self._decode(*found)
        return [] if view is None else [view]

    def _decode(self, stamp_ns: int, messages: ModelMessages) -> ModelView | None:
        if stamp_ns not in self._keyframes:  # from before a reset or a restart
            self._health.counts['models_of_unknown_keyframes'] += 1
            return None
        try:
            return decode_model(stamp_ns, messages, self._keyframes[stamp_ns])
        except (DatasetError, ValueError) as error:
            self._health.warn(str(error))
            return None

    def clear(self) -> None:
        """Forget the models; labels of another time are not found by their stamps anyway."""
        self._models.clear()
        self._keyframes.clear()
        self._moved = {}
        self._asked_s = -math.inf
