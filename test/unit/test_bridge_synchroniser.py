"""Pairing of streams: the live pairs are those of the offline association."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.bridge.synchroniser import Patience, Synchroniser
from bdgs_ros.data.associate import associate

MS = 1_000_000
Pairs = list[tuple[int, int]]


def make(patience: Patience = Patience.STRICT) -> tuple[Synchroniser[int, int], list[int]]:
    jumps: list[int] = []
    sync: Synchroniser[int, int] = Synchroniser(
        30 * MS, 1000 * MS, patience, lambda: jumps.append(1)
    )
    return sync, jumps


def feed(sync: Synchroniser[int, int], colors: list[int], depths: list[int]) -> Pairs:
    """Feed two streams in order of their stamps, as a camera would."""
    events = sorted([(s, 0) for s in colors] + [(s, 1) for s in depths])
    found: Pairs = []
    for stamp, side in events:
        found += sync.add_right(stamp, stamp) if side else sync.add_left(stamp, stamp)
    return found


def offline(colors: list[int], depths: list[int]) -> Pairs:
    first, second = np.array(colors, np.int64), np.array(depths, np.int64)
    return [(colors[i], depths[j]) for i, j in associate(first, second, 30 * MS)]


@pytest.mark.parametrize('seed', range(20))
def test_strict_pairs_are_the_offline_pairs(seed: int) -> None:
    rng = np.random.default_rng(seed)
    base = np.arange(60) * 33.4
    colors = base + rng.uniform(-1, 1, 60)
    depths = base + rng.uniform(5, 20) + rng.uniform(-1, 1, 60)
    colors = [int(s * MS) for s in colors[rng.random(60) > 0.1]]
    depths = [int(s * MS) for s in depths[rng.random(60) > 0.1]]
    sync, _ = make()
    found = feed(sync, colors, depths) + sync.flush()
    assert found == offline(colors, depths)
    assert sync.counts.pairs == len(found)
    assert sync.counts.unpaired_left == len(colors) - len(found)
    assert sync.counts.unpaired_right == len(depths) - len(found)


@pytest.mark.parametrize('offset_ms', [0.0, 5.0, 14.25, -12.0])
def test_prediction_pairs_a_steady_camera_without_waiting(offset_ms: float) -> None:
    colors = [int(i * 33.35 * MS) for i in range(40)]
    depths = [int((i * 33.35 + offset_ms) * MS) for i in range(40)]
    sync, _ = make(Patience.PREDICT)
    late = []
    for color, depth in zip(colors, depths, strict=True):
        found = []
        for stamp, side in sorted([(color, 0), (depth, 1)]):
            found += sync.add_right(stamp, stamp) if side else sync.add_left(stamp, stamp)
        late.append((color, depth) not in found)
    assert not any(late[2:])  # two intervals are needed to know the period


def test_eager_pairs_at_once() -> None:
    sync, _ = make(Patience.EAGER)
    assert sync.add_left(100 * MS, 1) == []
    assert sync.add_right(119 * MS, 2) == [(1, 2)]


def test_beyond_the_tolerance_there_is_no_pair() -> None:
    sync, _ = make()
    assert feed(sync, [0, 100 * MS, 200 * MS], [31 * MS, 131 * MS, 231 * MS]) == []
    assert sync.flush() == []
    assert sync.counts.unpaired_left == 3


def test_duplicates_and_small_steps_back_are_dropped_and_counted() -> None:
    sync, jumps = make(Patience.EAGER)
    sync.add_left(100 * MS, 1)
    sync.add_left(100 * MS, 2)
    sync.add_left(60 * MS, 3)
    assert sync.add_right(100 * MS, 9) == [(1, 9)]
    assert (sync.counts.duplicates, sync.counts.out_of_order, jumps) == (1, 1, [])


def test_a_jump_back_is_one_event_although_both_streams_jump() -> None:
    sync, jumps = make(Patience.PREDICT)
    feed(sync, [5000 * MS, 5033 * MS], [5000 * MS, 5033 * MS])
    assert sync.add_left(0, 10) == []
    assert jumps == []  # one stamp alone may be wrong
    assert sync.add_left(33 * MS, 11) == []
    assert jumps == [1]
    assert sync.add_right(5066 * MS, 12) == []  # the last one from before the jump
    pairs = [*sync.add_right(34 * MS, 13), *sync.add_left(66 * MS, 14)]
    pairs += [*sync.add_right(67 * MS, 15), *sync.flush()]
    assert pairs == [(11, 13), (14, 15)]
    assert jumps == [1]


def test_who_is_sent_pairs_one_by_one_takes_a_jump_at_once() -> None:
    sync, jumps = make(Patience.EAGER)
    feed(sync, [5000 * MS], [5000 * MS])
    assert sync.add_left(0, 10) == []
    assert sync.add_right(1 * MS, 11) == [(10, 11)]
    assert jumps == [1]


@pytest.mark.parametrize('off_s', [3600, 100, -10, -3600])
def test_one_stamp_that_is_far_off_costs_itself_alone(off_s: int) -> None:
    sync, jumps = make(Patience.PREDICT)
    pairs = []
    for i in range(10):
        at = 10**13 + i * 33 * MS
        pairs += sync.add_left(at + off_s * 1000 * MS if i == 5 else at, i)
        pairs += sync.add_right(at, i)
    assert pairs == [(i, i) for i in range(10) if i != 5]
    assert jumps == [] and sync.counts.strange == 1


def test_a_pause_is_gone_on_after() -> None:
    sync, jumps = make(Patience.PREDICT)
    pairs = []
    for i in range(6):
        at = i * 33 * MS + (3600 * 1000 * MS if i >= 3 else 0)
        pairs += [*sync.add_left(at, i), *sync.add_right(at, i)]
    assert pairs == [(i, i) for i in range(6) if i != 3]
    assert jumps == []


def test_a_stream_without_partner_does_not_pile_up() -> None:
    sync, _ = make()
    for i in range(1000):
        sync.add_left(i * 33 * MS, i)
    assert sync.counts.unpaired_left == 970
