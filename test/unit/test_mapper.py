"""The map grows where it should, leaves movers out, and explains its keyframes."""

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.belief.fusion import State
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig, BeliefConfig, MappingConfig, with_values
from bdgs_ros.core.types import Keyframe, RgbdFrame
from bdgs_ros.mapping.growth import surface_depth
from bdgs_ros.mapping.mapper import Mapper

CAMERA = PinholeCamera(96, 72, 90.0, 90.0, 47.5, 35.5)
SECOND = 1_000_000_000
WALL_Z = 2.0
CONFIG = with_values(
    BdgsConfig(), {'mapping.iterations': 20, 'mapping.threads': 1, 'mapping.insert.doublings': 0}
)


def wall(stamp_ns: int, T_world_camera: np.ndarray) -> RgbdFrame:
    """A striped wall at z = 2 m in world, seen by a camera that looks along z."""
    rays = CAMERA.rays() @ T_world_camera[:3, :3].T
    scale = (WALL_Z - T_world_camera[2, 3]) / rays[..., 2]
    points = rays * scale[..., None] + T_world_camera[:3, 3]
    pattern = 0.5 + 0.4 * np.sin(9 * points[..., :1]) * np.cos(7 * points[..., 1:2])
    color = np.concatenate([pattern, 1 - pattern, pattern**2], axis=-1)
    return RgbdFrame(stamp_ns, (255 * color).astype(np.uint8), scale.astype(np.float32), CAMERA)


def box_in_front(frame: RgbdFrame) -> tuple[RgbdFrame, np.ndarray]:
    """The same with something grey at 1.2 m in the middle, and where it is."""
    where = np.zeros(CAMERA.shape, bool)
    where[20:50, 35:60] = True
    color = np.where(where[..., None], np.uint8(90), frame.color)
    depth = np.where(where, np.float32(1.2), frame.depth_m)
    return replace(frame, color=color, depth_m=depth), where


def no_prior() -> np.ndarray:
    return np.zeros(CAMERA.shape, np.uint8)


def poses(count: int) -> list[np.ndarray]:
    return [se3.exp(np.array([0.03 * i, 0.01 * i, 0, 0, 0.005 * i, 0])) for i in range(count)]


def test_the_map_explains_views_that_were_no_keyframes() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    for i, T in enumerate(poses(5)):
        mapper.process(Keyframe(wall(i * SECOND, T), T, no_prior()))
    T = poses(5)[2] @ se3.exp(np.array([0.01, 0.005, 0, 0, 0, 0]))
    truth = wall(0, T)
    rendered = mapper.render(T, CAMERA)
    inner = (slice(8, -8), slice(8, -8))
    error = (rendered.color - truth.color / 255)[inner]
    assert -10 * np.log10(np.mean(error**2)) > 25
    depth_error = np.abs(surface_depth(rendered) - truth.depth_m)[inner]
    assert np.median(depth_error) < 0.01


def test_the_view_for_tracking_has_the_pose_and_stamp_of_its_keyframe() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    T = poses(2)[1]
    view = mapper.process(Keyframe(wall(7, T), T, no_prior()))
    assert view is not None
    assert view.stamp_ns == 7
    np.testing.assert_array_equal(view.T_world_camera, T)
    assert view.color.dtype == np.uint8
    assert abs(float(np.median(view.depth_m[view.depth_m > 0])) - WALL_Z) < 0.05


def test_an_early_view_comes_before_optimisation() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    early = []
    for i, T in enumerate(poses(2)):
        final = mapper.process(Keyframe(wall(i * SECOND, T), T, no_prior()), early=early.append)
    assert final is not None
    assert [view.stamp_ns for view in early] == [0, SECOND]
    np.testing.assert_array_equal(early[1].T_world_camera, poses(2)[1])
    assert (final.color != early[1].color).any()


def test_an_early_view_has_to_do_where_the_next_keyframe_waits() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief, hurried=lambda: True)
    early = []
    assert mapper.process(Keyframe(wall(0, poses(1)[0]), poses(1)[0], no_prior())) is not None
    T = poses(2)[1]
    assert mapper.process(Keyframe(wall(SECOND, T), T, no_prior()), early=early.append) is None
    assert len(early) == 1
    assert len(mapper.map)


def test_spare_time_makes_the_map_better_and_moves_no_keyframe() -> None:
    config = replace(CONFIG.mapping, iterations=4)
    mapper = Mapper(config, CONFIG.belief)
    T = poses(1)[0]
    frame = wall(0, T)
    mapper.process(Keyframe(frame, T, no_prior()))
    assert not mapper.polish(0)

    def error() -> float:
        view = mapper.view(0, T, CAMERA)
        return float(np.abs(view.color.astype(float) - frame.color).mean())

    before, steps = error(), 1
    while mapper.polish(30):
        steps += 1
    assert steps == 30
    assert error() < 0.9 * before
    np.testing.assert_array_equal(mapper.keyframes[0].T_world_camera, T)
    mapper.process(Keyframe(wall(SECOND, T), T, no_prior()))
    assert mapper.polish(30)
    mapper.frozen = True
    assert not mapper.polish(30)


def test_labelled_people_leave_no_gaussians() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    frame, where = box_in_front(wall(0, np.eye(4)))
    mapper.process(Keyframe(frame, np.eye(4), np.where(where, 230, 0).astype(np.uint8)))
    assert len(mapper.map) > 1000
    assert mapper.map.means[:, 2].min() > 1.8


def test_an_unnamed_thing_is_hidden_first_then_shown_if_it_rests() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    T = np.eye(4)
    mapper.process(Keyframe(wall(0, T), T, no_prior()))
    frame, _ = box_in_front(wall(SECOND, T))
    mapper.process(Keyframe(frame, T, no_prior()))
    in_front = mapper.map.means[:, 2] < 1.5
    assert in_front.sum() > 100
    assert not mapper.map.visible_mask()[in_front].any()
    for i in range(2, 9):
        mapper.process(Keyframe(replace(frame, stamp_ns=i * SECOND), T, no_prior()))
    shown = surface_depth(mapper.render(T, CAMERA))[25:45, 40:55]
    assert abs(float(np.median(shown)) - 1.2) < 0.05


def test_a_thing_that_leaves_is_deleted_and_the_wall_stays() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    T = np.eye(4)
    frame, where = box_in_front(wall(0, T))
    for i in range(3):
        mapper.process(Keyframe(replace(frame, stamp_ns=i * SECOND), T, no_prior()))
    for i in range(3, 10):
        mapper.process(Keyframe(wall(i * SECOND, T), T, no_prior()))
    assert (mapper.map.means[:, 2] < 1.5).sum() == 0
    rendered = mapper.render(T, CAMERA)
    assert rendered.silhouette.mean() > 0.97
    assert abs(float(np.median(surface_depth(rendered)[where])) - WALL_Z) < 0.05


def test_static_gaussians_become_static() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    for i, T in enumerate(poses(6)):
        mapper.process(Keyframe(wall(i * SECOND, T), T, no_prior()))
    seen = mapper.map.belief.views[-1].visible
    assert (mapper.map.states[seen] == State.STATIC).mean() > 0.95


def test_frozen_map_answers_but_does_not_change() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    mapper.process(Keyframe(wall(0, np.eye(4)), np.eye(4), no_prior()))
    before = mapper.map.means.copy()
    mapper.frozen = True
    view = mapper.process(Keyframe(wall(SECOND, np.eye(4)), np.eye(4), no_prior()))
    assert view is not None
    np.testing.assert_array_equal(mapper.map.means, before)


def test_corrected_poses_take_the_map_along() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    for i, T in enumerate(poses(3)):
        mapper.process(Keyframe(wall(i * SECOND, T), T, no_prior()))
    before = [kf.T_world_camera.copy() for kf in mapper.keyframes]
    seen = mapper.render(before[1], CAMERA).color
    T_new_old = se3.exp(np.array([0.1, 0, 0, 0, 0.2, 0]))
    mapper.correct_poses(dict.fromkeys([i * SECOND for i in range(3)], T_new_old))
    for kf, T in zip(mapper.keyframes, before, strict=True):
        np.testing.assert_allclose(kf.T_world_camera, T_new_old @ T)
    again = mapper.render(T_new_old @ before[1], CAMERA).color
    np.testing.assert_allclose(again, seen, atol=5e-3)


def test_a_correction_that_cannot_be_moves_no_map() -> None:
    mapper = Mapper(CONFIG.mapping, CONFIG.belief)
    T = poses(1)[0]
    mapper.process(Keyframe(wall(0, T), T, no_prior()))
    means = mapper.map.means.copy()
    for bad in (np.full((4, 4), np.nan), 2 * np.eye(4), se3.exp(np.array([1e7, 0, 0, 0, 0, 0]))):
        mapper.correct_poses({0: bad})
    assert mapper.refused == 3
    np.testing.assert_array_equal(mapper.map.means, means)
    np.testing.assert_array_equal(mapper.keyframe_poses()[0], T)


def test_the_map_keeps_to_its_budget() -> None:
    config = with_values(CONFIG, {'mapping.prune.max_gaussians': 1500})
    mapper = Mapper(config.mapping, config.belief)
    for i, T in enumerate(poses(5)):
        mapper.process(Keyframe(wall(i * SECOND, T), T, no_prior()))
        assert len(mapper.map) <= 1500
    assert mapper.render(poses(5)[2], CAMERA).silhouette[8:-8, 8:-8].min() > 0.5


def test_without_mapping_there_is_no_view() -> None:
    mapper = Mapper(replace(MappingConfig(), enabled=False), BeliefConfig())
    assert mapper.process(Keyframe(wall(0, np.eye(4)), np.eye(4), no_prior())) is None


def test_same_input_same_seed_same_map() -> None:
    maps = []
    for _ in range(2):
        mapper = Mapper(CONFIG.mapping, CONFIG.belief)
        for i, T in enumerate(poses(4)):
            mapper.process(Keyframe(wall(i * SECOND, T), T, no_prior()))
        maps.append(mapper.map)
    np.testing.assert_array_equal(maps[0].means, maps[1].means)
    np.testing.assert_array_equal(maps[0].colors, maps[1].colors)


@pytest.mark.parametrize('switch', ['belief.enabled', 'belief.multi_view'])
def test_switches_of_table_6_run(switch: str) -> None:
    config = with_values(CONFIG, {switch: False})
    mapper = Mapper(config.mapping, config.belief)
    for i, T in enumerate(poses(3)):
        mapper.process(Keyframe(wall(i * SECOND, T), T, no_prior()))
    assert mapper.render(poses(3)[2], CAMERA).silhouette.mean() > 0.9


def test_memory_for_keyframes_is_bounded() -> None:
    config = with_values(
        CONFIG, {'mapping.keyframes': 5, 'mapping.window': 3, 'mapping.iterations': 2}
    )
    mapper = Mapper(config.mapping, config.belief)
    for i, T in enumerate(poses(9)):
        mapper.process(Keyframe(wall(i * SECOND, T), T, no_prior()))
    assert len(mapper.keyframes) == 5
    assert [kf.index for kf in mapper.keyframes[-3:]] == [6, 7, 8]
