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
    (change,) = dog.check(3.2)
    assert change.is_bad
    assert "'/depth': never received anything for 3.2 s" in change.text
    assert "'/color', '/info' did arrive" in change.text
    assert 'qos.reliability' in change.text
    assert dog.silent() == ['/depth']


def test_no_camera_at_all_is_one_warning() -> None:
    (change,) = make(publishers=0).check(3.5)
    assert change.text.startswith("'/color', '/depth', '/info': never received")
    assert 'no publisher' in change.text


def test_a_camera_that_stops() -> None:
    dog = make()
    for name in ('/color', '/depth', '/info'):
        dog.note(name, 1.0)
    (change,) = dog.check(4.5)
    assert "'/color', '/depth': nothing received for 3.5 s; its publisher went" in change.text
    assert "'/info' did arrive" in change.text  # one camera_info is enough


def test_warns_once_and_says_when_it_is_back() -> None:
    dog = make()
    assert len(dog.check(4.0)) == 1
    assert dog.check(5.0) == []
    dog.note('/color', 6.0)
    (change,) = dog.check(6.1)
    assert (change.is_bad, change.text) == (False, "'/color': back")
