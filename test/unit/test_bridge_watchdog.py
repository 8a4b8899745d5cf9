"""Silence is noticed, named and forgiven."""

from __future__ import annotations

from bdgs_ros.bridge.watchdog import Watchdog


def make(publishers: int = 1) -> Watchdog:
    dog = Watchdog(3.0, 0.0, lambda _: publishers)
    for name in ('/color', '/depth'):
        dog.expect(name)
    dog.expect('/info', once=True)
    return dog


def test_quiet_before_the_limit() -> None:
    assert make().check(2.9) == []


def test_only_one_of_colour_and_depth() -> None:
    dog = make()
    dog.note('/color', 3.0)
    dog.note('/info', 0.5)
    (text,) = dog.check(3.2)
    assert "'/depth': nothing was ever received for 3.2 s" in text
    assert "'/color', '/info' did arrive" in text
    assert 'qos.reliability' in text
    assert dog.silent() == ['/depth']


def test_no_publisher_is_named() -> None:
    texts = make(publishers=0).check(3.5)
    assert len(texts) == 3
    assert all('no publisher' in text for text in texts)


def test_warns_once_and_says_when_it_is_back() -> None:
    dog = make()
    assert len(dog.check(4.0)) == 3
    assert dog.check(5.0) == []
    dog.note('/color', 6.0)
    assert dog.check(6.1) == ["'/color' is back"]


def test_one_camera_info_is_enough() -> None:
    dog = make()
    for name in ('/color', '/depth', '/info'):
        dog.note(name, 0.1)
    assert len(dog.check(10.0)) == 2
