"""Publish a recorded bag, in real time or in lockstep with tracking."""

from __future__ import annotations

import json
import sys
import threading
import time
from collections import OrderedDict
from pathlib import Path
from typing import Any

from diagnostic_msgs.msg import DiagnosticArray
from rosgraph_msgs.msg import Clock

from bdgs_ros.bridge import conversions, parameters, topics
from bdgs_ros.bridge.acknowledgements import Acknowledgements
from bdgs_ros.bridge.health import Health
from bdgs_ros.bridge.node_config import ReplayConfig
from bdgs_ros.bridge.playback import Pair, Playback, flush, pair_up
from bdgs_ros.bridge.raw_publishers import RawPublishers
from bdgs_ros.bridge.runner import REFUSED, GraphNode, run
from bdgs_ros.bridge.services import serve_switch, serve_trigger
from bdgs_ros.bridge.status import FrameState, status_from_message
from bdgs_ros.core.errors import BdgsError, ConfigError
from bdgs_ros.data.bag import open_bag
from bdgs_ros.data.bag_cursor import RawMessage
from bdgs_ros.data.trajectory_io import write_text_atomically

_POLL_S = 0.05
_SETTLE_S = 1.0
"""A subscriber that we know of may not know of us yet."""
_RESEND_S = 5.0
_QUIET_S = 1.0
_SENT_KEPT = 200


class _StoppedError(Exception):
    """The node is going down."""


class ReplayNode(GraphNode):
    """Play a bag: its bytes untouched, `/clock`, and a count of what consumers missed."""

    def __init__(self, **options: Any) -> None:
        super().__init__('replay_node', **options)
        config = parameters.declare(self, ReplayConfig())
        if not config.bag:
            raise ConfigError("what to play? set the parameter 'bag' to the path of a recording")
        self._config = config
        self._reader = open_bag(config.bag)
        self._playback = Playback(self._reader, config)
        self._health = Health(self, 'replay')
        self._acks = Acknowledgements(FrameState.PASSED_OVER.value)
        self._raw = RawPublishers(
            self, self._playback.topics, self._playback.layout, topics.image_qos(config.qos)
        )
        self._clock_publisher = self.create_publisher(Clock, topics.CLOCK, topics.RELIABLE)
        self.create_subscription(DiagnosticArray, topics.STATUS, self._on_status, topics.RELIABLE)
        self._running = threading.Event()
        self._stopping = False
        self._steps = 0
        self._played_s = 0.0
        self._last_sent_s = 0.0
        self._sent_s: OrderedDict[tuple[str, int], float] = OrderedDict()
        if not config.paused:
            self._running.set()
        serve_switch(self, topics.REPLAY_PAUSE, self._on_pause)
        serve_trigger(self, topics.REPLAY_STEP, self._on_step)
        self._thread = threading.Thread(target=self._play, daemon=True)
        self._thread.start()

    def _play(self) -> None:
        try:
            self._wait_for_subscribers()
            while True:
                self._play_lockstep() if self._config.lockstep else self._play_realtime()
                if not self._config.loop:
                    break
            self._report()
            self.finish()
        except _StoppedError:
            return
        except BdgsError as error:
            self.get_logger().fatal(str(error))
            self.finish(REFUSED)

    def _wait_for_subscribers(self) -> None:
        wanted = self._config.wait_subscribers
        deadline = time.monotonic() + self._config.wait_timeout_s
        while not self._ready(wanted):
            self._check_stopping()
            if time.monotonic() >= deadline:
                self.get_logger().warning(
                    f'{self._raw.subscribers()} of {wanted} subscribers of the camera '
                    f'topics after {self._config.wait_timeout_s:g} s; starting anyway'
                )
                break
            time.sleep(_POLL_S)
        time.sleep(_SETTLE_S if wanted else 0.0)
        self.get_logger().info(f"playing '{self._config.bag}', mode {self._config.mode}")

    def _ready(self, wanted: int) -> bool:
        listening = not self._config.lockstep or self.count_publishers(topics.STATUS) > 0
        return self._raw.subscribers() >= wanted and (listening or not wanted)

    def _play_realtime(self) -> None:
        """Send every message at its time; who cannot keep up misses it."""
        began_s = time.time()
        started_s: float | None = None
        pairing = self._playback.make_pairing()
        layout = self._playback.layout
        for message in self._playback.messages():
            if started_s is None:
                started_s, first_ns = time.monotonic(), message.stamp_ns
            due_s = started_s + (message.stamp_ns - first_ns) * 1e-9 / self._config.rate
            is_color = message.topic == layout.color
            started_s += self._pause(due_s, step=is_color)
            self._send(message)
            if message.topic in (layout.color, layout.depth):
                for pair in pair_up(pairing, message, layout):
                    self._expect(pair)
        for pair in flush(pairing):
            self._expect(pair)
        self._played_s = self._last_sent_s - began_s
        self._acks.wait_quiet(_QUIET_S)

    def _expect(self, pair: Pair) -> None:
        """Note a frame, which left when the later of its images did."""
        sent = [self._sent_s.pop((m.topic, m.stamp_ns), 0.0) for m in (pair.color, pair.depth)]
        self._acks.expect(pair.stamp_ns, max(sent))

    def _play_lockstep(self) -> None:
        """Send a pair when the pose of the last one came back."""
        for item in self._playback.matched():
            if isinstance(item, RawMessage):
                self._send(item)
                continue
            self._pause(time.monotonic(), step=True)
            self._acks.expect(item.stamp_ns, time.perf_counter())
            self._send_pair(item)
            self._wait_for_pose(item)

    def _send_pair(self, pair: Pair) -> None:
        self._send(pair.color)
        self._send(pair.depth)

    def _wait_for_pose(self, pair: Pair) -> None:
        deadline = time.monotonic() + self._config.lockstep_timeout_s
        resend_s = time.monotonic() + _RESEND_S
        while not self._acks.wait(pair.stamp_ns, 0.5):
            self._check_stopping()
            now = time.monotonic()
            if now >= deadline:
                self.get_logger().warning(
                    f"lockstep: no '{topics.STATUS}' for a frame within "
                    f'{self._config.lockstep_timeout_s:g} s; going on'
                )
                return
            if not self._acks.any and now >= resend_s:  # the first may get lost in discovery
                resend_s = now + _RESEND_S
                self._send_pair(pair)

    def _send(self, message: RawMessage) -> None:
        self._check_stopping()
        self._clock_publisher.publish(Clock(clock=conversions.time_message(message.stamp_ns)))
        self._raw.publish(message)
        self._last_sent_s = time.time()
        self._sent_s[message.topic, message.stamp_ns] = time.perf_counter()
        while len(self._sent_s) > _SENT_KEPT:
            self._sent_s.popitem(last=False)
        self._health.counts[f'sent {message.topic}'] += 1

    def _pause(self, due_s: float, *, step: bool) -> float:
        """Wait until a time, and while paused; return how long the pause was."""
        paused_s = 0.0
        while not self._running.is_set():
            if self._steps > 0:
                self._steps -= step
                break
            self._check_stopping()
            before = time.monotonic()
            self._running.wait(_POLL_S)
            paused_s += time.monotonic() - before
        time.sleep(max(0.0, due_s + paused_s - time.monotonic()))
        return paused_s

    def _check_stopping(self) -> None:
        if self._stopping:
            raise _StoppedError

    def _on_status(self, message: DiagnosticArray) -> None:
        status = status_from_message(message)
        self._acks.arrived(status.stamp_ns, status.state.value)
        self._health.counts['frames_missed_by_tracking'] = self._acks.missed

    def _report(self) -> None:
        acks = self._acks
        states = ', '.join(f'{n} {state}' for state, n in sorted(acks.states.items()))
        text = f'end of the bag: {acks.sent} frames sent; tracking: {states or "nothing"}'
        logger = self.get_logger()
        if acks.missed:
            logger.warning(f'{text}; {acks.missed} missed')
        else:
            logger.info(text)
        for milliseconds in acks.round_trips_ms:
            self._health.add_timing('image_to_status', milliseconds)
        self._health.counts['frames_sent'] = acks.sent
        self._health.counts['frames_missed_by_tracking'] = acks.missed
        if acks.unanswered:
            self._raw.wait_delivered(_QUIET_S)
        self._health.publish()
        if self._config.report_file:  # a short replay may end before its topics are discovered
            times = {
                'played_s': f'{self._played_s:.2f}',
                'last_sent_s': f'{self._last_sent_s:.2f}',
            }
            text = json.dumps({**self._health.values(), **times}, indent=1)
            write_text_atomically(Path(self._config.report_file), text)

    def _on_pause(self, paused: bool) -> str:
        if paused:
            self._steps = 0
            self._running.clear()
        else:
            self._running.set()
        return 'paused' if paused else 'playing'

    def _on_step(self) -> str:
        if self._running.is_set():
            raise ConfigError(f"pause first: call '{topics.REPLAY_PAUSE}' with true")
        self._steps += 1
        return 'one frame'

    def close(self) -> None:
        """Stop playing."""
        self._stopping = True
        self._thread.join(2.0)
        self._reader.close()


def main(args: list[str] | None = None) -> int:
    """Run the node."""
    return run(ReplayNode, args)


if __name__ == '__main__':
    sys.exit(main())
