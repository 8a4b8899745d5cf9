"""Quaternions and axes of many Gaussians."""

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.mapping.rotations import axes_from_quats, multiply, quats_from_axes


def turns(count: int, seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    twists = np.concatenate([np.zeros((count, 3)), rng.uniform(-3, 3, (count, 3))], axis=1)
    return np.array([se3.exp(xi)[:3, :3] for xi in twists]).astype(np.float32)


def test_axes_to_quaternions_and_back_for_any_angle() -> None:
    axes = turns(200, 0)
    np.testing.assert_allclose(axes_from_quats(quats_from_axes(axes)), axes, atol=1e-5)


def test_half_turns_have_quaternions() -> None:
    for diagonal in ([1, -1, -1], [-1, 1, -1], [-1, -1, 1]):
        axes = np.diag(diagonal).astype(np.float32)[None]
        np.testing.assert_allclose(axes_from_quats(quats_from_axes(axes)), axes, atol=1e-6)


def test_the_length_of_a_quaternion_does_not_matter() -> None:
    quats = quats_from_axes(turns(5, 0))
    np.testing.assert_allclose(axes_from_quats(3 * quats), axes_from_quats(quats), atol=1e-6)


def test_products_turn_one_after_the_other() -> None:
    a, b = turns(50, 0), turns(50, 1)
    product = axes_from_quats(multiply(quats_from_axes(a), quats_from_axes(b)))
    np.testing.assert_allclose(product, a @ b, atol=1e-5)
