"""The map moves with the keyframes that brought it."""

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.groups import Groups
from bdgs_ros.mapping.parameters import PARAMETERS
from bdgs_ros.mapping.rasterize import render

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)


def random_map(count: int = 200) -> GaussianMap:
    rng = np.random.default_rng(0)
    means = rng.uniform([-1, -1, 2], [1, 1, 4], (count, 3)).astype(np.float32)
    scales = rng.uniform(0.02, 0.2, (count, 3)).astype(np.float32)
    quats = rng.normal(size=(count, 4)).astype(np.float32)
    colors = rng.uniform(0, 1, (count, 3)).astype(np.float32)
    gaussians = GaussianMap(BeliefConfig())
    belief = np.full(count, 0.1, np.float32)
    gaussians.append(NewGaussians(means, scales, colors, belief, quats), 0.6, 0)
    return gaussians


def test_a_map_moved_as_one_looks_the_same_from_a_camera_moved_with_it() -> None:
    gaussians = random_map()
    before = render(gaussians.as_gaussians(), np.eye(4), CAMERA)
    T_new_old = se3.exp(np.array([0.5, -0.2, 0.3, 0.4, -0.7, 0.9]))
    gaussians.deform({0: T_new_old})
    after = render(gaussians.as_gaussians(), se3.inverse(T_new_old), CAMERA)
    np.testing.assert_allclose(after.color, before.color, atol=2e-3)
    np.testing.assert_allclose(after.depth, before.depth, atol=5e-3)


def test_each_gaussian_follows_its_own_keyframe() -> None:
    gaussians = random_map(4)
    gaussians.keyframe_index[:] = [5, 2, 9, 5]
    before = gaussians.means.copy()
    move = {i: se3.exp(np.array([i, 0, 0, 0, 0, 0.0])) for i in (2, 5)}
    gaussians.deform(move)
    moved = gaussians.means - before
    np.testing.assert_allclose(moved[:, 0], [5, 2, 0, 5], atol=1e-5)
    np.testing.assert_allclose(moved[:, 1:], 0, atol=1e-6)


def test_an_empty_map_deforms_too() -> None:
    gaussians = GaussianMap(BeliefConfig())
    gaussians.deform({0: np.eye(4)})
    assert len(gaussians) == 0


def test_serial_numbers_are_never_given_twice() -> None:
    gaussians = random_map(5)
    gaussians.keep(np.array([True, False, True, True, False]))
    gaussians.copy(np.array([0, 2]))
    assert gaussians.serial.tolist() == [0, 2, 3, 5, 6]
    gaussians.pool(
        Groups(np.array([0, 1, 0, 1, 1]), np.array([2, 1]), np.ones(5, np.float32)),
        {name: gaussians.parameters[name][:2] for name in PARAMETERS},
    )
    assert gaussians.serial.tolist() == [3, 2]  # those of the heaviest members
    assert gaussians.serial.dtype == np.int64
