"""The bend of a depth sensor is found from overlapping views, and only where it can be seen."""

from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.bend import BENDS, inverse_depth_bend
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.core.types import Keyframe, Pose, RgbdFrame
from bdgs_ros.mapping.depth_bend import DepthBend, RangeImage, shift
from bdgs_ros.mapping.growth import surface_depth
from bdgs_ros.mapping.keyframes import MapKeyframe, build_levels
from bdgs_ros.mapping.mapper import Mapper

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 79.5, 59.5)
BENT = (-0.008, 0.004, -0.012, -0.01, 0.006)
LOW, HIGH = np.array([-2.2, -1.4, -1.5]), np.array([2.0, 1.2, 3.2])  # of a room, m
NOISE = 0.002  # of inverse depth, 1/m


def room_depth(T_world_camera: Pose) -> np.ndarray:
    """The inside of a box with a step in its far wall."""
    rays = CAMERA.rays() @ T_world_camera[:3, :3].T
    start = T_world_camera[:3, 3]
    walls = np.where(rays > 0, HIGH, LOW)
    with np.errstate(divide='ignore'):
        depth = ((walls - start) / rays).min(axis=2)
    nearer = (2.6 - start[2]) / np.where(rays[..., 2] > 0, rays[..., 2], np.inf)
    step = (start + nearer[..., None] * rays)[..., 0] < -0.3
    depth = np.where(step & (nearer > 0), np.minimum(depth, nearer), depth)
    return np.asarray(depth, np.float32)


def measured(depth_m: np.ndarray, bend: tuple[float, ...], rng: np.random.Generator) -> np.ndarray:
    noise = rng.normal(0, NOISE, depth_m.shape)
    return shift(depth_m, (noise - inverse_depth_bend(CAMERA, bend)).astype(np.float32))


def poses(count: int) -> list[Pose]:
    """All kinds of motion."""
    rng = np.random.default_rng(1)
    reach = np.array([0.3, 0.2, 0.3, 0.15, 0.35, 0.2])
    return [se3.exp(rng.uniform(-1, 1, 6) * reach) for _ in range(count)]


def image(depth_m: np.ndarray, T: Pose, p_dynamic: np.ndarray | None = None) -> RangeImage:
    color = np.zeros((*CAMERA.shape, 3), np.uint8)
    prior = np.zeros(CAMERA.shape, np.uint8) if p_dynamic is None else p_dynamic
    return RangeImage.of(Keyframe(RgbdFrame(0, color, depth_m, CAMERA), T, prior))


def learned(images: list[RangeImage]) -> DepthBend:
    bend = DepthBend()
    for i, one in enumerate(images):
        for other in images[max(0, i - 4) : i]:
            bend.learn(one, other)
    return bend


def worst_cm(found: tuple[float, ...], true: tuple[float, ...]) -> float:
    """The largest difference over the image of a wall at 2 m."""
    difference = inverse_depth_bend(CAMERA, found) - inverse_depth_bend(CAMERA, true)
    return float(np.abs(difference).max() * 2.0**2 * 100)


def none() -> tuple[float, ...]:
    return (0.0,) * BENDS


def test_a_bend_is_recovered_with_wrong_poses() -> None:
    rng = np.random.default_rng(0)
    off = [T @ se3.exp(rng.normal(0, 0.01, 6)) for T in poses(9)]
    found = learned(
        [
            image(measured(room_depth(T), BENT, rng), wrong)
            for T, wrong in zip(poses(9), off, strict=True)
        ]
    )
    assert worst_cm(none(), BENT) > 8
    assert worst_cm(found.coefficients, BENT) < 1.5


def test_where_there_is_no_bend_none_is_found() -> None:
    rng = np.random.default_rng(0)
    found = learned([image(measured(room_depth(T), none(), rng), T) for T in poses(9)])
    assert worst_cm(found.coefficients, none()) < 0.3


def test_a_camera_that_stands_still_teaches_nothing() -> None:
    rng = np.random.default_rng(0)
    T = np.eye(4)
    found = learned([image(measured(room_depth(T), BENT, rng), T) for _ in range(9)])
    assert worst_cm(found.coefficients, none()) < 0.5


def test_a_wrong_scale_of_the_depth_is_no_bend() -> None:
    rng = np.random.default_rng(0)
    views = []
    for T in poses(9):
        scaled = T.copy()
        scaled[:3, 3] *= 1.05
        views.append(image(np.float32(1.05) * measured(room_depth(T), none(), rng), scaled))
    assert worst_cm(learned(views).coefficients, none()) < 1.0


@pytest.mark.parametrize(('named', 'limit_cm'), [(True, 2.5), (False, 3.5)])
def test_something_that_moves_hardly_matters(named: bool, limit_cm: float) -> None:
    rng = np.random.default_rng(0)
    views = []
    for i, T in enumerate(poses(9)):
        depth = measured(room_depth(T), BENT, rng)
        mover = np.zeros(CAMERA.shape, bool)
        mover[20:, 15 * i : 15 * i + 35] = True
        depth[mover] = 1.0
        views.append(image(depth, T, np.where(mover & named, 250, 0).astype(np.uint8)))
    assert worst_cm(learned(views).coefficients, BENT) < limit_cm


@pytest.mark.parametrize('invalid', [0.0, np.nan])
def test_holes_do_not_matter(invalid: float) -> None:
    rng = np.random.default_rng(0)
    views = []
    for T in poses(9):
        depth = measured(room_depth(T), BENT, rng)
        depth[rng.random(CAMERA.shape) < 0.02] = invalid
        views.append(image(depth, T))
    found = learned(views).coefficients
    assert np.isfinite(found).all()
    assert worst_cm(found, BENT) < 2.5


def test_views_without_overlap_or_depth_change_nothing() -> None:
    away = se3.exp(np.array([0, 0, 0, 0, np.pi, 0]))
    empty = image(np.zeros(CAMERA.shape, np.float32), np.eye(4))
    found = learned([image(room_depth(T), T) for T in (np.eye(4), away)] + [empty])
    assert found.coefficients == none()


def test_what_is_bent_and_corrected_is_as_it_was_and_holes_stay() -> None:
    bend = DepthBend(BENT)
    depth = room_depth(np.eye(4))
    depth[3, 4] = 0
    there = bend.bend(depth, CAMERA)
    assert np.abs(there - depth).max() > 0.02
    np.testing.assert_allclose(bend.correct(there, CAMERA), depth, atol=1e-5)
    assert there[3, 4] == 0


def test_the_correction_is_the_same_at_every_image_size() -> None:
    full = inverse_depth_bend(CAMERA, BENT)
    half = inverse_depth_bend(CAMERA.scaled(0.5), BENT)
    np.testing.assert_allclose(full.reshape(60, 2, 80, 2).mean(axis=(1, 3)), half, atol=1e-5)


def test_a_known_bend_is_kept_until_images_say_otherwise() -> None:
    rng = np.random.default_rng(0)
    bend = DepthBend(BENT)
    views = [image(measured(room_depth(T), BENT, rng), T) for T in poses(2)]
    bend.learn(views[1], views[0])
    assert worst_cm(bend.coefficients, BENT) < 1.0


def test_a_keyframe_corrected_early_is_brought_up_to_date() -> None:
    depth = room_depth(np.eye(4))
    raw = DepthBend(BENT).bend(depth, CAMERA)
    color = np.zeros((*CAMERA.shape, 3), np.uint8)
    still = np.zeros(CAMERA.shape, bool)
    levels = build_levels(color, raw, still, CAMERA, 3)
    keyframe = MapKeyframe(0, 0, np.eye(4), np.zeros(CAMERA.shape, np.uint8), levels)
    DepthBend().renew(keyframe)
    assert keyframe.levels is levels
    half = tuple(0.5 * c for c in BENT)
    for coefficients in (half, BENT):
        DepthBend(coefficients).renew(keyframe)
    assert keyframe.depth_bend == BENT
    np.testing.assert_allclose(keyframe.levels[0].depth_m, depth, atol=1e-4)
    assert len(keyframe.levels) == len(levels)
    coarse = keyframe.levels[2]
    expected = DepthBend(BENT).correct(levels[2].depth_m, levels[2].camera)
    np.testing.assert_allclose(coarse.depth_m, expected, atol=1e-4)


def test_numbers_that_are_no_bend_are_refused() -> None:
    for wrong in ([1.0, 2.0], [np.nan] * BENDS):
        with pytest.raises(ValueError, match='coefficients'):
            DepthBend(wrong)


def test_the_map_is_straight_the_view_for_tracking_bent_and_a_saved_map_knows(
    tmp_path: Path,
) -> None:
    config = with_values(BdgsConfig(), {'mapping.iterations': 5, 'mapping.threads': 1})
    mapper = Mapper(config.mapping, config.belief)
    rng = np.random.default_rng(0)
    for i, T in enumerate(poses(6)):
        color = np.full((*CAMERA.shape, 3), 120, np.uint8)
        frame = RgbdFrame(i, color, measured(room_depth(T), BENT, rng), CAMERA)
        view = mapper.process(Keyframe(frame, T, np.zeros(CAMERA.shape, np.uint8)))
    assert worst_cm(mapper.depth_bend.coefficients, BENT) < 3
    assert view is not None
    straight = surface_depth(mapper.render(view.T_world_camera, CAMERA))
    known = view.depth_m > 0
    expected = mapper.depth_bend.bend(straight, CAMERA)
    np.testing.assert_allclose(view.depth_m[known], expected[known], atol=0.01)
    mapper.save(tmp_path / 'map.ply')
    again = Mapper(config.mapping, config.belief)
    again.load(tmp_path / 'map.ply')
    assert again.depth_bend.coefficients == pytest.approx(mapper.depth_bend.coefficients)
    assert again.keyframes[0].depth_bend == again.depth_bend.coefficients
    np.testing.assert_allclose(
        again.keyframes[0].levels[0].depth_m, mapper.keyframes[0].levels[0].depth_m, atol=0.001
    )
