"""The worker, the buffers by stamp, and the count of acknowledgements."""

from __future__ import annotations

import math
import os
import signal
import sys
import threading
import time

import numpy as np
import pytest

from bdgs_ros.bridge.acknowledgements import Acknowledgements
from bdgs_ros.bridge.governor import Shed
from bdgs_ros.bridge.pace import LabelsPace, Pace
from bdgs_ros.bridge.priority import leave_one
from bdgs_ros.bridge.stamped import Assembler, StampBuffer
from bdgs_ros.bridge.worker import Worker


def test_worker_drops_the_oldest_and_counts() -> None:
    gate, seen = threading.Event(), []

    def handle(item: int) -> None:
        gate.wait(2.0)
        seen.append(item)

    worker: Worker[int] = Worker(handle, lambda error: None, capacity=2)
    worker.put(0)
    while not worker._busy:
        time.sleep(0.001)
    for item in (1, 2, 3, 4):
        worker.put(item)
    gate.set()
    assert worker.wait_idle(2.0)
    assert seen == [0, 3, 4]
    assert worker.dropped == 2
    worker.stop()


def test_worker_survives_an_error() -> None:
    errors: list[Exception] = []
    seen: list[int] = []

    def handle(item: int) -> None:
        if item == 1:
            raise ValueError('one')
        seen.append(item)

    worker: Worker[int] = Worker(handle, errors.append, capacity=None)
    for item in range(3):
        worker.put(item)
    assert worker.wait_idle(2.0)
    assert seen == [0, 2]
    assert [str(e) for e in errors] == ['one']
    worker.stop()


def test_worker_restart_comes_before_newer_items() -> None:
    gate, seen = threading.Event(), []

    def handle(item: str) -> None:
        gate.wait(2.0)
        seen.append(item)

    worker: Worker[str] = Worker(handle, lambda error: None, capacity=None)
    worker.put('old')
    while not worker._busy:
        time.sleep(0.001)
    worker.put('forgotten')
    worker.restart(lambda: seen.append('restart'))
    worker.put('new')
    gate.set()
    assert worker.wait_idle(2.0)
    assert seen == ['old', 'restart', 'new']
    worker.stop()


def test_worker_idles() -> None:
    calls: list[int] = []
    worker: Worker[int] = Worker(
        lambda item: None, lambda error: None, None, lambda: calls.append(1), 0.01
    )
    time.sleep(0.2)
    worker.stop()
    assert len(calls) >= 3


def test_stamp_buffer_waits_across_threads() -> None:
    buffer: StampBuffer[str] = StampBuffer(2)
    threading.Timer(0.05, buffer.put, (7, 'seven')).start()
    assert buffer.wait(7, 2.0) == 'seven'
    assert buffer.wait(8, 0.01) is None


def test_what_was_lost_on_the_way_is_not_waited_for() -> None:
    buffer: StampBuffer[str] = StampBuffer(4)
    buffer.put(1, 'one')
    threading.Timer(0.05, buffer.put, (3, 'three')).start()
    start = time.monotonic()
    assert buffer.wait(2, 5.0, in_order=True) is None
    assert 0.04 < time.monotonic() - start < 2.0
    assert buffer.wait(3, 5.0, in_order=True) == 'three'


def test_stamp_buffer_finds_the_newest_within_an_age() -> None:
    buffer: StampBuffer[int] = StampBuffer(3)
    for stamp in (10, 20, 30, 40):
        buffer.put(stamp, stamp)
    assert buffer.newest(35, 10) == 30
    assert buffer.newest(19, 10) is None  # 10 was forgotten
    assert buffer.newest(29, 5) is None
    assert buffer.take_newest() == 40
    assert buffer.take_newest() is None


def test_assembler_gives_complete_sets_and_forgets_old_ones() -> None:
    assembler: Assembler[int] = Assembler(('a', 'b'), capacity=2)
    assert assembler.add(1, 'a', 10) is None
    assert assembler.add(1, 'b', 20) == {'a': 10, 'b': 20}
    for stamp in (2, 3, 4):
        assembler.add(stamp, 'a', stamp)
    assert assembler.add(2, 'b', 0) is None
    assert assembler.add(4, 'b', 0) == {'a': 4, 'b': 0}


def test_acknowledgements_count_what_is_missed() -> None:
    acks = Acknowledgements()
    now = time.perf_counter()
    acks.arrived(1, 'ok')  # before it was known to be a frame
    acks.expect(1, now)
    acks.expect(2, now)
    acks.expect(3, now)
    acks.arrived(2, 'lost')
    acks.arrived(2, 'lost')
    acks.arrived(99, 'ok')
    assert (acks.sent, acks.missed, dict(acks.states)) == (3, 1, {'ok': 1, 'lost': 1})
    assert acks.wait(2, 0.0)
    assert not acks.wait(3, 0.01)


@pytest.mark.skipif(not sys.platform.startswith('linux'), reason='priorities of threads')
def test_a_worker_gives_way_and_others_do_not() -> None:
    before = os.getpriority(os.PRIO_PROCESS, 0)
    seen: list[int] = []
    worker: Worker[int] = Worker(
        lambda _: seen.append(os.getpriority(os.PRIO_PROCESS, threading.get_native_id())),
        lambda error: None,
        capacity=None,
        nice=before + 3,
    )
    worker.put(0)
    assert worker.wait_idle(2.0)
    worker.stop()
    assert seen == [before + 3]
    assert os.getpriority(os.PRIO_PROCESS, threading.get_native_id()) == before


def test_what_waits_is_counted() -> None:
    gate = threading.Event()
    worker: Worker[int] = Worker(lambda _: gate.wait(2.0), lambda error: None, capacity=None)
    worker.put(0)
    while worker.waiting:
        time.sleep(0.001)
    assert worker.unfinished == 1
    worker.put(1)
    assert (worker.waiting, worker.unfinished) == (1, 2)
    gate.set()
    assert worker.wait_idle(2.0)
    assert worker.unfinished == 0
    worker.stop()


@pytest.mark.parametrize(('rate_hz', 'chosen'), [(15, 150), (10, 100), (30, 300), (math.inf, 300)])
def test_a_pace_chooses_evenly(rate_hz: float, chosen: int) -> None:
    rng = np.random.default_rng(0)
    stamps = (np.arange(300) / 30 * 1e9 + rng.uniform(-2e6, 2e6, 300)).astype(int)
    pace = Pace(rate_hz)
    kept = [stamp for stamp in stamps.tolist() if pace.is_due(stamp)]
    assert len(kept) == chosen
    assert max(np.diff(kept)) < 1.1e9 / min(rate_hz, 30) + 4e6


def test_a_pace_goes_on_after_a_gap() -> None:
    pace = Pace(10)
    assert pace.is_due(0)
    assert not pace.is_due(30_000_000)
    assert pace.is_due(5_000_000_000)
    assert not pace.is_due(5_020_000_000)
    pace.reset()
    assert pace.is_due(0)


def test_half_of_the_labels_are_made_under_load_and_where_nobody_is() -> None:
    pace, stamp_ns = LabelsPace(10), 0

    def per_second() -> int:
        nonlocal stamp_ns
        stamps = [stamp_ns + i * 33_333_333 for i in range(30)]
        stamp_ns = stamps[-1] + 33_333_333
        return sum(pace.is_due(stamp) for stamp in stamps)

    assert per_second() == 10
    for _ in range(10):
        pace.note_labels(show_anybody=False)
    assert per_second() == pytest.approx(5, abs=1)
    pace.note_labels(show_anybody=True)
    assert per_second() == pytest.approx(10, abs=1)
    pace.note_load(Shed.LABELS)
    assert per_second() == pytest.approx(5, abs=1)
    pace.note_load(Shed.NOTHING)
    assert per_second() == pytest.approx(10, abs=1)


def test_signals_are_counted_without_a_lock() -> None:
    pytest.importorskip('rclpy', reason='needs rclpy')
    from bdgs_ros.bridge import runner

    before = {n: signal.getsignal(n) for n in (signal.SIGINT, signal.SIGTERM)}
    try:
        received = runner._catch_signals()
        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGTERM):
            signal.raise_signal(number)
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
    assert received == [signal.SIGTERM, signal.SIGINT, signal.SIGTERM]


def test_a_worker_that_is_woken_calls_idle_at_once() -> None:
    idle = threading.Event()
    worker: Worker[int] = Worker(
        lambda item: None, lambda error: None, None, idle.set, idle_period_s=30.0
    )
    time.sleep(0.05)
    assert not idle.is_set()
    worker.wake()
    assert idle.wait(2.0)
    worker.stop()


def test_waiting_for_idle_includes_what_another_worker_is_to_hand_over() -> None:
    gate = threading.Event()
    done: list[int] = []
    last: Worker[int]

    def hand_over(item: int) -> None:
        gate.wait(2.0)
        last.put(item)

    first: Worker[int] = Worker(hand_over, lambda error: None, capacity=None)
    last = Worker(done.append, lambda error: None, capacity=None, source=first)
    first.put(7)
    assert not last.wait_idle(0.05)
    gate.set()
    assert last.wait_idle(2.0)
    assert done == [7]
    first.stop()
    last.stop()


def test_the_nearest_item_is_known_once_a_newer_one_is_there() -> None:
    buffer: StampBuffer[str] = StampBuffer(5)
    assert buffer.nearest(100, 50, timeout_s=0.01) is None
    buffer.put(60, 'before')
    assert buffer.nearest(100, 50, timeout_s=0.01) == 'before'
    threading.Timer(0.05, buffer.put, (110, 'after')).start()
    started = time.monotonic()
    assert buffer.nearest(100, 50, timeout_s=5.0) == 'after'
    assert time.monotonic() - started < 2.0
    assert buffer.nearest(80, 50, timeout_s=0.0) == 'before'
    assert buffer.nearest(300, 50, timeout_s=0.0) is None


@pytest.mark.parametrize(('processors', 'threads'), [(1, 1), (2, 1), (3, 2), (16, 2)])
def test_one_processor_is_left(
    processors: int, threads: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, 'sched_getaffinity', lambda _: set(range(processors)), raising=False)
    assert leave_one(2) == threads
