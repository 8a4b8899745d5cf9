"""One-to-one matching of stamps."""

from __future__ import annotations

import numpy as np

from bdgs_ros.data.associate import associate


def ns(*values: int) -> np.ndarray:
    return np.array(values, dtype=np.int64)


def test_the_closest_pair_wins_even_if_it_comes_later() -> None:
    # in order of time, 100 would take 110 and leave 112 alone
    assert associate(ns(100, 112), ns(110), 30) == [(1, 0)]


def test_every_index_is_used_once() -> None:
    rng = np.random.default_rng(3)
    first = np.sort(rng.integers(0, 10_000, 200))
    second = np.sort(rng.integers(0, 10_000, 190))
    pairs = associate(first, second, 60)
    assert len({i for i, _ in pairs}) == len({j for _, j in pairs}) == len(pairs) > 100
    assert all(abs(int(first[i]) - int(second[j])) <= 60 for i, j in pairs)
    assert [i for i, _ in pairs] == sorted(i for i, _ in pairs)


def test_the_limit_is_part_of_it() -> None:
    assert associate(ns(0), ns(30), 30) == [(0, 0)]
    assert associate(ns(0), ns(31), 30) == []


def test_unsorted_stamps_of_today_do_not_overflow() -> None:
    base = 1_548_339_819_000_000_000
    first, second = ns(base + 50, base), ns(base + 1, base + 52)
    assert associate(first, second, 10) == [(1, 0), (0, 1)]


def test_nothing_to_match() -> None:
    assert associate(ns(), ns(1), 5) == [] == associate(ns(1), ns(), 5)
