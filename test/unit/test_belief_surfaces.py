"""Surfaces end at steps of depth and at creases, and keep their rims."""

import numpy as np

from bdgs_ros.belief.surfaces import KINECT_NOISE, find_surfaces, mean_by_group
from bdgs_ros.core.camera import PinholeCamera

CAMERA = PinholeCamera(160, 120, 140.0, 140.0, 79.5, 59.5)


def room() -> np.ndarray:
    """A wall at 3 m and a floor 1 m below the camera."""
    rows = np.arange(120)[:, None]
    slope = np.maximum((rows - CAMERA.cy) / CAMERA.fy, 1e-6)
    depth = np.minimum(3.0, 1.0 / slope)
    return np.broadcast_to(depth, (120, 160)).astype(np.float32).copy()


def test_wall_and_floor_meet_at_a_crease() -> None:
    label = find_surfaces(room())
    wall, floor = label[30, 80], label[115, 80]
    assert wall > 0
    assert floor > 0
    assert wall != floor


def test_noise_of_the_sensor_does_not_break_a_plane() -> None:
    rng = np.random.default_rng(0)
    inverse = 1 / 3.0 + 0.5 * KINECT_NOISE * rng.standard_normal((120, 160))
    label = find_surfaces((1 / inverse).astype(np.float32))
    assert np.bincount(label.ravel()).max() > 0.97 * label.size


def test_a_person_before_the_wall_is_a_surface_of_its_own_with_its_rims() -> None:
    depth = room()
    depth[20:80, 60:90] = 1.5
    label = find_surfaces(depth)
    person = label[50, 75]
    assert person not in (0, label[30, 20])
    assert (label[22:78, 62:88] == person).mean() > 0.95
    assert not (label[:, :55] == person).any()


def test_holes_and_specks_belong_to_nothing() -> None:
    depth = np.zeros((120, 160), np.float32)
    depth[50:54, 50:54] = 2.0
    assert not find_surfaces(depth).any()


def test_mean_by_group() -> None:
    mean = mean_by_group(np.array([1, 2, 6], np.float32), np.array([4, 9, 4], np.int32))
    np.testing.assert_allclose(mean, [3.5, 2.0, 3.5])
