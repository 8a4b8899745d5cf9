"""The map's part of the journal: states that are whole, and a run that goes on from one."""

from __future__ import annotations

import errno
import threading
import time
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
from test_map_files import CAMERA, SECOND, a_frame

from bdgs_ros.core import se3
from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.core.types import Keyframe, StampedPose, Trajectory
from bdgs_ros.journal import checkpoints, keeper
from bdgs_ros.journal.checkpoints import Checkpoints, read_newest, read_places
from bdgs_ros.journal.keeper import MapKeeper
from bdgs_ros.mapping.history import History
from bdgs_ros.mapping.mapper import Mapper

CONFIG = with_values(
    BdgsConfig(), {'mapping.iterations': 2, 'mapping.threads': 1, 'mapping.keyframes': 6}
)


def at(i: int) -> np.ndarray:
    return se3.exp(np.array([0.04 * i, 0.01 * i, 0, 0, 0.02 * i, 0.01 * i]))


def a_keyframe(i: int) -> Keyframe:
    return Keyframe(a_frame(i * SECOND, at(i)), at(i), np.zeros(CAMERA.shape, np.uint8))


@pytest.fixture
def mapper() -> Mapper:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    for i in range(1, 4):
        mapper.process(a_keyframe(i))
    return mapper


def keep(mapper: Mapper, written: Checkpoints) -> None:
    written.write(written.state(mapper.map, mapper.kept()))


def taken_up(folder: Path) -> Mapper:
    found = read_newest(folder, CONFIG.belief, CONFIG.mapping)
    assert found is not None
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    mapper.take(*found)
    return mapper


def test_a_map_is_taken_up_as_it_was(mapper: Mapper, tmp_path: Path) -> None:
    keep(mapper, Checkpoints(tmp_path / 'map'))
    again = taken_up(tmp_path / 'map')

    assert np.array_equal(again.map.means, mapper.map.means)
    assert np.allclose(again.map.p_dynamic, mapper.map.p_dynamic)
    assert [k.index for k in again.keyframes] == [k.index for k in mapper.keyframes]
    assert again.keyframe_poses().keys() == mapper.keyframe_poses().keys()
    for stamp_ns, pose in mapper.keyframe_poses().items():
        assert np.allclose(again.keyframe_poses()[stamp_ns], pose, atol=1e-9)
    online = Trajectory(tuple(StampedPose(round(s * SECOND), at(s)) for s in (1.0, 1.5, 2.6)))
    for one, other in zip(
        mapper.final_trajectory(online).poses, again.final_trajectory(online).poses, strict=True
    ):
        assert np.allclose(one.T_world_camera, other.T_world_camera, atol=1e-6)


def test_a_correction_moves_gaussians_that_came_before_the_restart(
    mapper: Mapper, tmp_path: Path
) -> None:
    keep(mapper, Checkpoints(tmp_path / 'map'))
    again = taken_up(tmp_path / 'map')
    before = again.map.means.copy()
    aside = se3.exp(np.array([0.0, 0.1, 0, 0, 0, 0]))
    again.correct_poses(dict.fromkeys(again.keyframe_poses(), aside))
    assert np.allclose(again.map.means - before, [0, 0.1, 0], atol=1e-5)


def test_images_are_written_once(mapper: Mapper, tmp_path: Path) -> None:
    written = Checkpoints(tmp_path / 'map')
    keep(mapper, written)
    image = tmp_path / 'map' / 'keyframes' / 'images' / '000000.png'
    first = image.stat().st_mtime_ns
    mapper.process(a_keyframe(4))
    state = written.state(mapper.map, mapper.kept())
    assert {Path(name).stem for name in state.images} == {'000003'}
    written.write(state)
    assert image.stat().st_mtime_ns == first
    assert len(taken_up(tmp_path / 'map').keyframes) == 4


def test_a_run_that_goes_on_writes_only_what_is_new(mapper: Mapper, tmp_path: Path) -> None:
    keep(mapper, Checkpoints(tmp_path / 'map'))
    again = taken_up(tmp_path / 'map')
    written = Checkpoints(tmp_path / 'map', again.kept())
    again.process(a_keyframe(4))
    assert len(written.state(again.map, again.kept()).images) == 4
    keep(again, written)
    assert len(taken_up(tmp_path / 'map').keyframes) == 4


def test_depth_is_brought_up_to_date_after_the_restart(mapper: Mapper, tmp_path: Path) -> None:
    written = Checkpoints(tmp_path / 'map')
    keep(mapper, written)
    mapper.depth_bend.coefficients = (0.02, 0.0, 0.0, 0.0, 0.0)
    keep(mapper, written)
    again = taken_up(tmp_path / 'map')
    for one, other in zip(mapper.keyframes, again.keyframes, strict=True):
        mapper.depth_bend.renew(one)
        again.depth_bend.renew(other)
        assert np.allclose(one.levels[0].depth_m, other.levels[0].depth_m, atol=1e-3)


@pytest.mark.parametrize('suffix', ['.rec', '.ply'])
def test_a_newest_state_that_is_damaged_gives_way_to_the_one_before(
    mapper: Mapper, tmp_path: Path, suffix: str, caplog: pytest.LogCaptureFixture
) -> None:
    written = Checkpoints(tmp_path / 'map')
    keep(mapper, written)
    mapper.process(a_keyframe(4))
    keep(mapper, written)
    newest = tmp_path / 'map' / f'map-000002{suffix}'
    data = bytearray(newest.read_bytes())
    data[len(data) // 2] ^= 0x55
    newest.write_bytes(data)
    assert len(taken_up(tmp_path / 'map').keyframes) == 3
    assert 'map-000002' in caplog.text


def test_no_more_than_two_states_and_their_images_stay(mapper: Mapper, tmp_path: Path) -> None:
    written = Checkpoints(tmp_path / 'map')
    for i in range(4, 12):
        mapper.process(a_keyframe(i))
        keep(mapper, written)
    assert len(list((tmp_path / 'map').glob('map-*'))) == 4
    assert len(list((tmp_path / 'map' / 'keyframes').rglob('*.png'))) <= 4 * (
        len(mapper.keyframes) + 1
    )
    assert len(taken_up(tmp_path / 'map').keyframes) == len(mapper.keyframes)


def test_a_crash_while_writing_costs_that_state_alone(
    mapper: Mapper, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    written = Checkpoints(tmp_path / 'map')
    keep(mapper, written)
    mapper.process(a_keyframe(4))
    real = checkpoints.write_bytes
    for survives in range(2):
        calls: list[Path] = []

        def fails(path: Path, *parts: bytes, calls: list[Path] = calls) -> None:
            calls.append(path)
            if len(calls) > survives:  # noqa: B023 (called in this round)
                raise OSError(errno.ENOSPC, 'No space left on device')
            real(path, *parts)

        monkeypatch.setattr(checkpoints, 'write_bytes', fails)
        with pytest.raises(OSError, match='No space'):
            keep(mapper, written)
        assert len(taken_up(tmp_path / 'map').keyframes) == 3
    monkeypatch.setattr(checkpoints, 'write_bytes', real)
    keep(mapper, written)
    assert len(taken_up(tmp_path / 'map').keyframes) == 4


def test_places_of_a_map_that_grows_can_be_read(mapper: Mapper, tmp_path: Path) -> None:
    assert read_places(tmp_path / 'map') == []
    keep(mapper, Checkpoints(tmp_path / 'map'))
    places = read_places(tmp_path / 'map')
    assert [p.frame.stamp_ns for p in places] == [k.stamp_ns for k in mapper.keyframes]


def wait(condition: Callable[[], bool]) -> None:
    deadline = time.monotonic() + 5.0
    while not condition():
        assert time.monotonic() < deadline
        time.sleep(0.005)


def test_the_keeper_writes_changes_tells_failures_and_forgets(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(keeper, '_LEAST_S', 0.0)
    monkeypatch.setattr(keeper, '_SHARE', 1.0)
    done: list[object] = []
    told: list[str] = []
    broken = threading.Event()

    def write(state: object) -> None:
        if broken.is_set():
            raise OSError(errno.EROFS, 'Read-only file system')
        done.append(state)

    kept = MapKeeper(SimpleNamespace(write=write, clear=done.clear), told.append)
    assert kept.is_due
    kept.put('first')
    wait(lambda: kept.is_due)
    assert done == ['first']
    broken.set()
    kept.put('second')
    wait(lambda: kept.is_due)
    assert 'Read-only file system' in told[0]
    broken.clear()
    kept.put('third')
    wait(lambda: kept.is_due)
    assert done == ['first', 'third'] and told[-1] == ''
    kept.forget()
    kept.put('of another world')
    kept.close()
    assert done == ['of another world']


def work(seconds: float) -> None:
    end = time.thread_time() + seconds
    while time.thread_time() < end:
        pass


def test_writing_takes_a_small_share_of_the_time(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keeper, '_LEAST_S', 0.0)
    slow = SimpleNamespace(write=lambda state: work(0.1))
    kept = MapKeeper(slow, lambda text: None)
    kept.put('state')
    started = time.monotonic()
    wait(lambda: kept.is_due)
    assert time.monotonic() - started > 0.5
    kept.close()


def test_a_history_hears_what_was_said_while_mapping_was_away() -> None:
    history = History()
    history.add(10, at(0))
    history.add(20, at(1))
    history.note_move(15, at(3))
    history.note_move(25, at(4))
    history.catch_up(
        20,
        [StampedPose(15, at(3)), StampedPose(25, at(4)), StampedPose(28, at(5))],
        [[StampedPose(26, at(2)), StampedPose(27, at(2))]],
    )
    assert [stamp_ns for stamp_ns, _ in history.moves_since(0)] == [15, 25, 28]
    assert [stamp_ns for stamp_ns, _ in history.moves_since(20)] == [25, 28]
    completed = history.completed(Trajectory((StampedPose(25, at(2)),)))
    assert [p.stamp_ns for p in completed.poses] == [25, 26, 27]
    history.catch_up(
        20,
        [StampedPose(25, at(4)), StampedPose(28, at(5))],
        [[StampedPose(26, at(2)), StampedPose(27, at(2))]],
    )
    assert len(history.completed(Trajectory(())).poses) == 2


def test_a_move_amid_a_piece_is_heard_once() -> None:
    history = History()
    history.add(100, at(0))
    piece = [StampedPose(200, at(2)), StampedPose(300, at(2))]
    for _ in range(2):
        history.catch_up(100, [StampedPose(250, at(3))], [piece])
        assert [stamp_ns for stamp_ns, _ in history.moves_since(0)] == [200]


def test_what_was_moved_before_tracking_began_again_is_void() -> None:
    history = History()
    history.add(100, at(0), at(1))
    history.note_move(110, at(2))
    history.note_move(150, at(3))  # while it was lost, and nothing came of it
    history.reenter(120, at(1))
    assert [stamp_ns for stamp_ns, _ in history.moves_since(0)] == [110, 121]
