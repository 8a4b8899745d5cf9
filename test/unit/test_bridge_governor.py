"""What is left out when tracking is behind, and that it is given back."""

from __future__ import annotations

import threading
import time

import pytest

from bdgs_ros.bridge.governor import Governor, Shed, spare_processors
from bdgs_ros.bridge.worker import Worker

PERIOD_S = 1 / 30


def run(governor: Governor, start_s: float, seconds: float, latency_s: float) -> list[Shed]:
    """Play frames at 30 Hz whose poses all come equally late; return the levels."""
    levels = []
    for i in range(round(seconds / PERIOD_S)):
        now_s = start_s + i * PERIOD_S
        governor.note_arrival(now_s)
        governor.note_pose(now_s, now_s + latency_s)
        levels.append(governor.level)
    return levels


def test_nothing_is_left_out_while_poses_are_in_time() -> None:
    assert set(run(Governor(), 10.0, 20.0, 0.025)) == {Shed.NOTHING}


def test_a_fast_camera_does_not_make_a_prompt_pose_late() -> None:
    governor = Governor()
    for i in range(600):
        governor.note_arrival(i / 90)
        governor.note_pose(i / 90, i / 90 + 0.025)
    assert governor.level is Shed.NOTHING


def test_late_poses_leave_out_one_thing_after_the_other_and_get_it_back() -> None:
    governor = Governor()
    levels = run(governor, 10.0, 5.0, 0.08)
    assert levels == sorted(levels)
    assert set(levels) == set(Shed)
    assert '80 ms' in governor.reason
    back = run(governor, 15.0, 20.0, 0.02)
    assert back == sorted(back, reverse=True)
    assert back[-1] is Shed.NOTHING
    assert governor.reason == ''


def test_frames_passed_over_are_pressure_even_if_the_others_are_in_time() -> None:
    governor = Governor()
    run(governor, 10.0, 1.0, 0.02)
    governor.note_passed_over()
    assert run(governor, 11.0, 1.0, 0.02)[-1] is Shed.RENDERS
    assert 'passed over' in governor.reason


def test_tracking_looks_as_closely_as_its_period_allows() -> None:
    governor = Governor()

    def play(rate_hz: float, start_s: float) -> float:
        for i in range(round(10 * rate_hz)):
            governor.note_arrival(start_s + i / rate_hz)
            governor.note_cost(0.006 + 0.010 * governor.points_share)
        return governor.points_share

    assert play(30, 0.0) == 1
    assert play(60, 100.0) == 0.5
    assert play(90, 200.0) == 0.25
    assert play(300, 300.0) == 1 / 8
    assert play(30, 400.0) == 1


def test_the_map_gets_the_processors_that_nobody_needs() -> None:
    assert [spare_processors(Shed.NOTHING, count) for count in (1, 2, 4, 8)] == [0, 0, 2, 6]
    assert spare_processors(Shed.RENDERS, 8) == 0


@pytest.mark.parametrize('rate_hz', [5.0, 30.0, 60.0])
def test_a_frame_is_late_after_two_periods_of_its_camera(rate_hz: float) -> None:
    governor = Governor()
    for i in range(20):
        governor.note_arrival(i / rate_hz)
    assert governor.period_s == pytest.approx(1 / rate_hz)
    assert not governor.is_late(100.0, 100.0 + 1.9 / rate_hz)
    assert governor.is_late(100.0, 100.0 + 2.1 / rate_hz)


def test_a_pause_of_the_camera_is_no_period() -> None:
    governor = Governor()
    run(governor, 0.0, 1.0, 0.02)
    run(governor, 60.0, 1.0, 0.02)
    assert governor.period_s == pytest.approx(PERIOD_S)


def test_words_name_everything_that_is_left_out() -> None:
    assert Shed.NOTHING.words == 'nothing'
    assert Shed.LABELS.words == 'renders, iterations, labels'


def test_under_overload_the_worker_takes_the_newest_and_hands_the_others_back() -> None:
    """Handling takes five times as long as a frame lasts: no item is older than the bound."""
    ages, dropped = [], []

    def handle(put_s: float) -> None:
        ages.append(time.monotonic() - put_s)
        time.sleep(0.05)

    worker: Worker[float] = Worker(
        handle,
        lambda error: None,
        capacity=30,
        is_late=lambda put_s: time.monotonic() - put_s > 0.02,
        on_drop=dropped.append,
    )
    count = 60
    for _ in range(count):
        worker.put(time.monotonic())
        time.sleep(0.01)
    assert worker.wait_idle(2.0)
    worker.stop()
    assert worker.dropped == len(dropped) == count - len(ages)
    assert len(dropped) > count / 2
    assert max(ages) < 0.1  # one item's handling and the bound; all that waits would be 0.3 s


def test_without_overload_nothing_is_passed_over() -> None:
    seen: list[int] = []
    gate = threading.Event()

    def handle(item: int) -> None:
        gate.wait(1.0)
        seen.append(item)

    worker: Worker[int] = Worker(handle, lambda error: None, 30, is_late=lambda item: False)
    for item in range(5):
        worker.put(item)
    gate.set()
    assert worker.wait_idle(2.0)
    worker.stop()
    assert seen == [0, 1, 2, 3, 4]
