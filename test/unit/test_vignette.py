"""The lens's falloff is found from overlapping images, whatever else changes between them."""

from collections.abc import Callable

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.types import Pose
from bdgs_ros.mapping.keyframes import Level
from bdgs_ros.mapping.vignette import Photo, Vignette

CAMERA = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
TRUE = (-0.5, 0.2)
WALL_Z = 2.0

Change = Callable[[Level], Level]


def views(count: int) -> list[Pose]:
    rng = np.random.default_rng(3)
    reach = np.array([0.6, 0.4, 0.2, 0.1, 0.15, 0.5])
    return [se3.exp(rng.uniform(-1, 1, 6) * reach) for _ in range(count)]


def picture(T_world_camera: Pose, true: tuple[float, float], gain: float = 1.0) -> Level:
    """A patterned wall at z = 2 m in world, darkened towards the corners."""
    rays = CAMERA.rays() @ T_world_camera[:3, :3].T
    depth = (WALL_Z - T_world_camera[2, 3]) / rays[..., 2]
    points = rays * depth[..., None] + T_world_camera[:3, 3]
    pattern = 0.45 + 0.15 * np.sin(4 * points[..., 0]) * np.cos(5 * points[..., 1])
    rho2 = (CAMERA.rays()[..., :2] ** 2).sum(axis=2)
    shown = gain * pattern * np.exp(true[0] * rho2 + true[1] * rho2**2)
    color = np.repeat((255 * shown + 0.5).clip(0, 255).astype(np.uint8)[..., None], 3, axis=2)
    return Level(CAMERA, color, depth.astype(np.float32), np.ones(CAMERA.shape, bool))


def learned(levels: list[Level], at: list[Pose]) -> Vignette:
    vignette = Vignette()
    photos = [Photo.of(level, T) for level, T in zip(levels, at, strict=True)]
    for i, photo in enumerate(photos):
        for earlier in photos[:i]:
            vignette.learn(photo, earlier)
    return vignette


def worst(found: Vignette, true: tuple[float, float]) -> float:
    """The largest difference over the image, as a share."""
    return float(np.abs(found.falloff(CAMERA) / Vignette(*true).falloff(CAMERA) - 1).max())


def test_a_falloff_is_recovered_whatever_the_exposure() -> None:
    gains = [1.0, 0.8, 1.2, 0.9, 1.1, 1.0]
    at = views(6)
    found = learned([picture(T, TRUE, gain) for T, gain in zip(at, gains, strict=True)], at)
    assert Vignette(*TRUE).falloff(CAMERA).min() < 0.85
    assert worst(found, TRUE) < 0.02


def test_a_lens_without_falloff_gets_none() -> None:
    at = views(6)
    found = learned([picture(T, (0.0, 0.0)) for T in at], at)
    assert worst(found, (0.0, 0.0)) < 0.01


def test_a_camera_that_stands_still_teaches_nothing() -> None:
    at = [np.eye(4)] * 5
    found = learned([picture(T, TRUE) for T in at], at)
    assert worst(found, (0.0, 0.0)) < 0.01


def mark(level: Level, named: bool) -> Level:
    """Put something bright in front that moves with the camera's image."""
    image, depth, static = level.image.copy(), level.depth_m.copy(), level.static.copy()
    image[30:90, 10:50] = 230
    if named:
        static[30:90, 10:50] = False
    else:
        depth[30:90, 10:50] = 1.0
    return Level(level.camera, image, depth, static)


@pytest.mark.parametrize('named', [True, False])
def test_movers_do_not_matter(named: bool) -> None:
    at = views(6)
    levels = [picture(T, TRUE) for T in at]
    found = learned([mark(level, named) if i % 2 else level for i, level in enumerate(levels)], at)
    assert worst(found, TRUE) < 0.03


def test_saturated_and_dark_pixels_are_not_used() -> None:
    level = picture(np.eye(4), TRUE)
    level.image[:40], level.image[40:60] = 255, 3
    usable = Photo.of(level, np.eye(4)).usable
    assert not usable[:60].any()
    assert usable[60:].all()


@pytest.mark.parametrize('invalid', [0.0, np.nan])
def test_holes_in_the_depth_do_not_matter(invalid: float) -> None:
    at = views(6)
    levels = [picture(T, TRUE) for T in at]
    rng = np.random.default_rng(0)
    for level in levels:
        level.depth_m[rng.random(CAMERA.shape) < 0.2] = invalid
    found = learned(levels, at)
    assert np.isfinite(found.coefficients).all()
    assert worst(found, TRUE) < 0.03


def test_views_without_overlap_change_nothing() -> None:
    at = [np.eye(4), se3.exp(np.array([50.0, 0, 0, 0, 0, 0]))]
    assert learned([picture(T, TRUE) for T in at], at).coefficients == (0.0, 0.0)


def test_a_known_falloff_is_kept_until_images_say_otherwise() -> None:
    at = views(2)
    vignette = Vignette(*TRUE)
    vignette.learn(*(Photo.of(picture(T, TRUE), T) for T in at))
    assert worst(vignette, TRUE) < 0.02


def test_falloff_is_one_on_the_axis_and_never_absurd() -> None:
    camera = PinholeCamera(161, 121, 130.0, 130.0, 80.0, 60.0)
    assert Vignette(*TRUE).falloff(camera)[60, 80] == pytest.approx(1.0)
    absurd = Vignette(-50.0, 80.0).falloff(camera)
    assert absurd.min() > 0.2
    assert absurd.max() < 1.2


def test_levels_follow_what_is_learned_later() -> None:
    level = picture(np.eye(4), TRUE)
    vignette = Vignette()
    follower = Level(level.camera, level.image, level.depth_m, level.static, vignette)
    before = follower.color
    vignette.coefficients = TRUE
    assert follower.color[0, 0, 0] > 1.1 * before[0, 0, 0]
