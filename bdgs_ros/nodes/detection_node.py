"""Publish the dynamic prior of every colour image."""

from __future__ import annotations

import math
import sys
from functools import partial
from typing import Any

import numpy as np
from sensor_msgs.msg import Image
from std_msgs.msg import Empty

from bdgs_ros.bridge import conversions, optional, parameters, topics
from bdgs_ros.bridge.frames import FrameDecoder, FrameSource, RawFrame
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.load import hear_load
from bdgs_ros.bridge.node_config import DetectionNodeConfig
from bdgs_ros.bridge.pace import LabelsPace
from bdgs_ros.bridge.runner import GraphNode, run
from bdgs_ros.bridge.worker import Worker
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.threads import one_thread_in_cv2
from bdgs_ros.core.types import Labels
from bdgs_ros.detection.late import AtOnce, InBackground
from bdgs_ros.detection.stage import DetectionStage

_QUEUE = 1  # images that may wait for their labels in real time: the newest is of most use


class DetectionNode(GraphNode):
    """Who could be moving: `bdgs/labels`, for the colour image of the same stamp."""

    def __init__(self, **options: Any) -> None:
        super().__init__('detection_node', **options)
        config = parameters.declare(self, DetectionNodeConfig())
        one_thread_in_cv2()
        self.nice = config.detection_nice
        self._health = Health(self, 'detection')
        # In real time the network has a thread of its own and the newest image, and labels come
        # at camera rate from the object tracks; in lockstep every image is waited for.
        runner = AtOnce if config.lockstep else partial(InBackground, nice=config.detection_nice)
        self._stage = DetectionStage(config.detection, runner=runner)
        self._answered_ns: int | None = None
        self._labels = self.create_publisher(Image, topics.LABELS, topics.KEPT)
        self._detections = optional.DetectionsPublisher(self)
        self._decoder = FrameDecoder.of(self)
        self._worker: Worker[RawFrame] = Worker(
            self._on_frame,
            self._health.error,
            None if config.lockstep else _QUEUE,
            nice=config.detection_nice,
        )
        self._pace = LabelsPace(math.inf if config.lockstep else config.labels_rate)
        hear_load(self, self._pace.note_load)
        self._source = FrameSource(self, config, self._health, self._on_pair, self._reset)
        self.create_subscription(
            Empty, topics.RESET_EVENT, lambda _: self._reset(), topics.RELIABLE
        )
        self.get_logger().info(f'detection is ready ({self._stage.status}): mode {config.mode}')

    def _on_pair(self, raw: RawFrame) -> None:
        if self._pace.is_due(raw.stamp_ns):
            self._worker.put(raw)

    def _on_frame(self, raw: RawFrame) -> None:
        try:
            frame = self._decoder.decode(raw)
        except DatasetError as error:
            self._health.counts['frames_skipped'] += 1
            self._health.warn(str(error))
            return
        try:
            with self._health.timed('detection'):
                labels = self._stage.process(frame)
        except Exception as error:  # the prior is a help, not a must: nobody waits in vain
            self._health.error(error)
            labels = Labels(raw.stamp_ns, np.zeros(frame.camera.shape, np.uint8))
        self._note_answers(raw.stamp_ns)
        self._pace.note_labels(bool(labels.p_dynamic.any()))
        weights = self._stage.status if self._stage.degraded else ''
        self._health.set_problem('detector', weights)
        self._publish(labels, raw)

    def _note_answers(self, stamp_ns: int) -> None:
        """How late the detector answers, and how often: in the time of the images."""
        for age_s in self._stage.answer_ages_s:
            answered_ns = stamp_ns - round(age_s * 1e9)
            self._health.counts['detector_answers'] += 1
            self._health.add_timing('detector_latency', age_s * 1e3)
            if self._answered_ns is not None and answered_ns > self._answered_ns:
                self._health.add_timing(
                    'detector_period', (answered_ns - self._answered_ns) * 1e-6
                )
            self._answered_ns = answered_ns

    def _publish(self, labels: Labels, raw: RawFrame) -> None:
        head = conversions.header(labels.stamp_ns, raw.color.header.frame_id)
        self._labels.publish(conversions.probability_to_message(labels.p_dynamic, head))
        self._detections.publish(labels, head)
        self._health.counts['labels'] += 1
        self._health.counts['frames_dropped'] = self._worker.dropped

    def _reset(self) -> None:
        self._pace.reset()
        self._worker.restart(self._stage.reset)

    def close(self) -> None:
        """Stop working."""
        self._worker.stop()
        self._stage.close()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(DetectionNode, args)


if __name__ == '__main__':
    sys.exit(main())
