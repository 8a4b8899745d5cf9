"""Build the static Gaussian map from keyframes."""

from __future__ import annotations

import sys
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np
from geometry_msgs.msg import PoseStamped
from nav_msgs.msg import Path as PathMessage
from sensor_msgs.msg import Image
from std_msgs.msg import Empty

from bdgs_ros.back_end.back_end import BackEnd
from bdgs_ros.bridge import conversions, parameters, topics
from bdgs_ros.bridge.adjuster import Adjuster
from bdgs_ros.bridge.cdr_image import CdrImage, image_from_cdr
from bdgs_ros.bridge.frames import FrameDecoder, FrameSource, RawFrame
from bdgs_ros.bridge.governor import Shed, spare_processors
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.load import hear_load
from bdgs_ros.bridge.map_output import MapOutput
from bdgs_ros.bridge.model_view import ModelPublisher
from bdgs_ros.bridge.node_config import MappingNodeConfig
from bdgs_ros.bridge.priority import leave_one, processors
from bdgs_ros.bridge.runner import GraphNode, run
from bdgs_ros.bridge.stamped import StampBuffer
from bdgs_ros.bridge.worker import Worker
from bdgs_ros.core.config import MappingConfig
from bdgs_ros.core.errors import BdgsError
from bdgs_ros.core.images import fitted, halved
from bdgs_ros.core.threads import one_thread_in_cv2
from bdgs_ros.core.types import (
    Keyframe,
    Labels,
    Pose,
    ProbabilityImage,
    RgbdFrame,
    StampedPose,
)
from bdgs_ros.mapping.mapper import Mapper
from bdgs_ros.nodes.map_entrance import MapEntrance
from bdgs_ros.nodes.map_journal import MapJournal
from bdgs_ros.nodes.map_pieces import MapPieces
from bdgs_ros.nodes.map_services import AT_RUN_TIME, LiveMap, MapServices
from bdgs_ros.pipeline import Adjustment

_FRAME_WAIT_S = 2.0
_PENDING_S = 30.0
_LABELS_WAIT_S = 0.3
_LABELS_KEPT = 90
_MAX_LABEL_AGE_NS = 500_000_000
_POSES_KEPT = 1000
_KEYFRAMES_BEHIND = 2
"""That may wait for the back end: an older one is none to it, its frames go with another."""
_REFUSALS_TOLD = 3
"""Corrections in a row: one or two are of a keyframe or two that show little."""


class MappingNode(GraphNode):
    """What the static world looks like: `bdgs/model`, `bdgs/rendered` and `bdgs/map`."""

    def __init__(self, **options: Any) -> None:
        super().__init__('mapping_node', **options)
        config = parameters.declare(self, MappingNodeConfig(), runtime=AT_RUN_TIME)
        one_thread_in_cv2()
        self.nice = config.back_end_nice  # which waits for the images of its keyframes
        self._config = config
        self._health = Health(self, 'mapping')
        self._mapper = Mapper(_mapping_config(config), config.belief, self._is_hurried)
        self._live = LiveMap(self._mapper)
        self._back_end = Adjuster(
            BackEnd(config.back_end, self._sheds_pairs),
            self._mapper,
            self._publish_keyframes,
            lambda view: self._models.publish(view.stamp_ns, view),
            at_once=not config.lockstep,
        )
        self._tracked: deque[StampedPose] = deque(maxlen=_POSES_KEPT)
        self._shed = Shed.NOTHING
        self._lock = self._live.lock  # of the mapper: worker and services
        self._frames: StampBuffer[RawFrame] = StampBuffer(config.frame_buffer)
        self._labels: StampBuffer[CdrImage] = StampBuffer(_LABELS_KEPT)
        self._moving: StampBuffer[CdrImage] = StampBuffer(_LABELS_KEPT)
        self._decoder = FrameDecoder.of(self)
        self._models = ModelPublisher(self, self._config.map_frame)
        self._output = MapOutput(self, config, self._health)
        self._map_services = MapServices(
            self, config, self._health, self._live, self._settle, self._on_loaded
        )
        self._adjusting: Worker[Callable[[], None]] = Worker(
            lambda task: task(),
            self._health.error,
            None if config.lockstep else _KEYFRAMES_BEHIND,
            nice=config.back_end_nice,
        )
        self._worker: Worker[Callable[[], None]] = Worker(
            lambda task: task(),
            self._health.error,
            None if config.lockstep else config.keyframe_queue,
            self._on_idle,
            nice=config.mapping_nice,
            source=self._adjusting,
        )
        self._entrance = MapEntrance(
            self, self._live, self._decoder, self._models, self._output, self._health,
            config.mapping.width, self._worker.put, self._reenter,
        )  # fmt: skip
        self._journal = MapJournal(config, self._live, self._health)
        self._subscribe()
        self._map_services.start()
        self._take_up()
        self.get_logger().info(f'mapping is ready: mode {config.mode}')

    def _take_up(self) -> None:
        """Go on with what a run before has left, if that is wanted."""
        if self._journal.begin():
            self._back_end.resume(self._mapper.history.newest)
            self._publish_keyframes(self._mapper.keyframe_poses())
            self.get_logger().info(
                f'going on with {len(self._live.poses)} poses and {len(self._mapper.map)} '
                'Gaussians of the journal'
            )

    def results(self) -> list[Callable[[], str]]:
        """Return what saves the final trajectory and the map."""
        return self._map_services.results()

    def _subscribe(self) -> None:
        self._source = FrameSource(
            self, self._config, self._health, self._keep_frame, self._forget
        )
        self.create_subscription(Image, topics.LABELS, self._keep_labels, topics.KEPT, raw=True)
        self._pieces = MapPieces(
            self, self._assembling, self._adjusting.put, self._on_joined
        )  # before keyframes: of what comes at once, a piece is older
        self.create_subscription(
            PoseStamped, topics.KEYFRAME, self._queue_keyframe, topics.RELIABLE
        )
        self.create_subscription(PoseStamped, topics.POSE, self._keep_pose, topics.RELIABLE)
        self.create_subscription(PoseStamped, topics.MOVE, self._note_move, topics.RELIABLE)
        self.create_subscription(
            Empty, topics.RESET_EVENT, lambda _: self._forget(), topics.RELIABLE
        )
        self.create_subscription(
            Image, topics.KEYFRAME_MOVING, self._keep_moving, topics.RELIABLE, raw=True
        )
        hear_load(self, self._on_load)
        self._keyframes = self.create_publisher(PathMessage, topics.KEYFRAMES, topics.LATCHED)

    def _on_load(self, level: Shed) -> None:
        self._shed = level

    def _keep_frame(self, raw: RawFrame) -> None:
        self._frames.put(raw.stamp_ns, raw)
        self._entrance.note_frame(raw)

    def _keep_moving(self, message: bytes) -> None:
        image = image_from_cdr(message)
        self._moving.put(conversions.stamp_ns(image), image)

    def _keep_labels(self, message: bytes) -> None:
        image = image_from_cdr(message)
        self._labels.put(conversions.stamp_ns(image), image)

    def _keep_pose(self, message: PoseStamped) -> None:
        if not self._live.is_entered:
            return
        pose = conversions.pose_from_message(message.pose)
        self._live.poses.append(StampedPose(conversions.stamp_ns(message), pose))
        self._tracked.append(self._live.poses[-1])
        self._output.note_pose(message, frozen=self._mapper.frozen)
        if self._mapper.frozen:
            self._worker.wake()

    def _note_move(self, message: PoseStamped) -> None:
        if self._live.is_entered:
            T_new_old = conversions.motion_from_message(message)
            self._mapper.history.note_move(conversions.stamp_ns(message), T_new_old)
            self._back_end.note_move(conversions.stamp_ns(message), T_new_old)

    def _reenter(self, last_ns: int, T_new_old: Pose) -> None:
        """Take that tracking was restarted, and begins in the map as it is."""
        self._mapper.history.reenter(last_ns, T_new_old)
        self._back_end.reenter(last_ns, T_new_old)

    def _queue_keyframe(self, message: PoseStamped) -> None:
        stamp_ns = conversions.stamp_ns(message)
        if not self._live.is_entered:
            self._health.counts['keyframes_of_another_world'] += 1
            self._models.publish(stamp_ns, None)
            return
        # Its images are taken along now: they may be forgotten when its turn comes.
        raw = self._frames.get(stamp_ns)
        self._adjusting.put(partial(self._on_keyframe, message, raw))

    def _on_keyframe(self, message: PoseStamped, raw: RawFrame | None) -> None:
        """Have the back end look at a keyframe, then hand it over to the map."""
        keyframe = self._made(message, raw)
        for joined in self._pieces.take():
            self._adjust(joined)
        if keyframe is None:
            self._answer_nothing(conversions.stamp_ns(message))
        else:
            self._adjust(keyframe)

    def _made(self, message: PoseStamped, raw: RawFrame | None) -> Keyframe | None:
        try:
            return self._assemble(message, raw or self._wait_frame(conversions.stamp_ns(message)))
        except BdgsError as error:
            self._health.error(error)
            return None

    def _adjust(self, keyframe: Keyframe) -> None:
        if not self._mapper.grows:
            self._worker.put(partial(self._show_map, keyframe))
            return
        stamp_ns = keyframe.frame.stamp_ns
        with self._health.timed('back_end'):
            adjustment = self._back_end.adjust(keyframe, self._tracked_until(stamp_ns))
        self._tell_refusals()
        if adjustment is not None:
            self._worker.put(partial(self._map, keyframe, adjustment))
        self._health.counts['keyframes_dropped'] = self._worker.dropped
        self._health.counts['keyframes_passed_over'] = self._adjusting.dropped

    def _assembling(self, message: PoseStamped) -> Callable[[], Keyframe | None]:
        """Return what makes a keyframe of a message; its images are taken along now."""
        return partial(self._made, message, self._frames.get(conversions.stamp_ns(message)))

    def _on_joined(self, poses: Sequence[StampedPose]) -> None:
        """Take the frames of a piece of map into the world."""
        if self._live.is_entered and poses:
            self._mapper.history.join(poses)
            self._back_end.note_piece(poses[0].stamp_ns, poses[-1].stamp_ns)

    def _tell_refusals(self) -> None:
        """Say that drift stays, as long as nothing that the back end finds can be believed."""
        self._health.counts['corrections_refused'] = self._back_end.refusals
        count = self._back_end.refused_in_row
        told = (
            'keyframes contradict each other, and drift stays: show what was seen before, or reset'
        )
        self._health.set_failure('back_end', told if count >= _REFUSALS_TOLD else '')

    def _answer_nothing(self, stamp_ns: int) -> None:
        """Tell tracking, which waits in lockstep, not to."""
        if self._config.lockstep:
            self._models.publish(stamp_ns, None)

    def _map(self, keyframe: Keyframe, adjustment: Adjustment) -> None:
        answered = False
        if not self._config.lockstep:  # better ones may have come since the back end had it
            keyframe = replace(keyframe, p_dynamic=self._labels_of(keyframe.frame, _LABELS_WAIT_S))
        try:
            with self._health.timed('mapping'), self._lock:
                answered = self._back_end.into_map(keyframe, adjustment)
                self._live.version += 1
                self._journal.keep()
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
        newest_ns = max(poses, default=0)
        path = conversions.path_message(stamped, newest_ns, self._config.map_frame)
        self._keyframes.publish(path)

    def _tracked_until(self, stamp_ns: int) -> list[StampedPose]:
        """Take the poses of frames up to a keyframe; the back end knows that one itself."""
        found = []
        while self._tracked and self._tracked[0].stamp_ns < stamp_ns:
            found.append(self._tracked.popleft())
        return found

    def _sheds_pairs(self) -> bool:
        """Return whether the back end has no time for old pairs."""
        behind = self._adjusting.waiting > 0 or self._shed >= Shed.PAIRS
        return behind and not self._config.lockstep

    def _is_hurried(self) -> bool:
        if self._config.lockstep:
            return False
        next_ = self._adjusting.unfinished + self._worker.waiting
        return next_ > 0 or self._shed >= Shed.ITERATIONS or self._entrance.is_waited_for

    def _wait_frame(self, stamp_ns: int) -> RawFrame | None:
        """Wait for images; in real time some are lost on the way, and the next keyframe waits."""
        if self._config.lockstep:
            return self._frames.wait(stamp_ns, self._config.lockstep_timeout_s)
        return self._frames.wait(stamp_ns, _FRAME_WAIT_S, in_order=True)

    def _assemble(self, message: PoseStamped, raw: RawFrame | None) -> Keyframe | None:
        if raw is None:
            self._health.counts['keyframes_without_frame'] += 1
            self._health.warn('a keyframe was announced whose images never came; it is left out')
            return None
        frame = self._decoder.decode(raw)
        self._output.see_through(frame.camera, raw.color.header.frame_id)
        frame = halved(frame, self._config.camera.width)
        labels = self._labels_of(frame, 0.0)
        return Keyframe(frame, conversions.pose_from_message(message.pose), labels)

    def _labels_of(self, frame: RgbdFrame, wait_s: float) -> ProbabilityImage:
        """Return what may move in a frame: by its labels, and by what tracking saw move."""
        if self._mapper.frozen:  # they would change nothing
            return np.zeros(frame.camera.shape, np.uint8)
        labels = self._labels_alone(frame, wait_s)
        message = self._moving.get(frame.stamp_ns)
        if message is None:
            return labels
        moving = conversions.probability_from_message(message, topics.KEYFRAME_MOVING)
        return np.maximum(labels, moving) if moving.shape == labels.shape else labels

    def _labels_alone(self, frame: RgbdFrame, wait_s: float) -> ProbabilityImage:
        """Return the labels of a frame; in real time the nearest ones will do, after a wait."""
        message = self._find_labels(frame.stamp_ns, wait_s)
        lockstep = self._config.lockstep
        if message is None:
            # the back end asks without waiting, and the map once more
            self._health.counts['keyframes_without_labels'] += bool(wait_s) or lockstep
            return np.zeros(frame.camera.shape, np.uint8)
        labels = conversions.probability_from_message(message, topics.LABELS)
        return fitted(Labels(frame.stamp_ns, labels), frame).p_dynamic

    def _find_labels(self, stamp_ns: int, wait_s: float) -> CdrImage | None:
        """Find labels: detection passes images over in real time, so newer ones end the wait."""
        present = self.count_publishers(topics.LABELS) > 0
        if self._config.lockstep and present:
            found = self._labels.wait(stamp_ns, self._config.lockstep_timeout_s)
            if found is not None:
                return found
        return self._labels.nearest(stamp_ns, _MAX_LABEL_AGE_NS, wait_s if present else 0.0)

    def _on_idle(self) -> None:
        """Between keyframes: show the map."""
        with self._lock:
            shown = self._shed < Shed.RENDERS or self._mapper.frozen
            more_to_render = shown and self._output.render(self._mapper)
            self._output.publish_map(self._mapper, self._live.version, self._config.belief.margin)
            more_to_polish = self._polish()
            self._journal.keep()
        if more_to_render or more_to_polish:
            self._worker.wake()

    def _polish(self) -> bool:
        """Spend a processor that nobody needs on the map; say whether there is more to do."""
        if self._config.lockstep or self._adjusting.waiting or self._worker.waiting:
            return False
        spare = spare_processors(self._shed, processors())
        more = self._mapper.polish(self._config.mapping.spare * spare)
        self._live.version += more
        return more

    def _forget(self) -> None:
        self._frames.clear()
        self._journal.part()
        self._live.poses, self._live.is_entered = [], True
        self._entrance.forget()
        self._tracked.clear()
        self._back_end.forget()
        self._adjusting.restart(self._back_end.reset)
        self._worker.restart(self._start_over)

    def _start_over(self) -> None:
        with self._lock:
            if not self._mapper.frozen:  # a map to localise in outlives the camera's jumps
                self._mapper.reset()
                self._live.version += 1
                self._map_services.withdraw()
                self._journal.forget()
        self._output.forget()

    def _settle(self) -> None:
        self._worker.wait_idle(_PENDING_S)
        self._journal.catch_up()

    def _on_loaded(self) -> None:
        """Give up what belongs to the world before; the mapper is locked and has another map."""
        self._adjusting.restart(lambda: None)
        self._worker.restart(lambda: None)
        self._tracked.clear()
        self._back_end.start_from(self._mapper.readout_s)
        self._output.forget()
        self._journal.forget()
        self._publish_keyframes({})

    def close(self) -> None:
        """Stop working."""
        self._map_services.stop()
        self._adjusting.stop()
        self._worker.stop()
        self._journal.close()


def _mapping_config(config: MappingNodeConfig) -> MappingConfig:
    """Return the mapper's parameters; in real time tracking must not wait for its threads."""
    threads = config.mapping.threads
    return replace(config.mapping, threads=threads if config.lockstep else leave_one(threads))


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(MappingNode, args)


if __name__ == '__main__':
    sys.exit(main())
