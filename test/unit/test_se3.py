"""Algebraic properties of rigid motions."""

import math

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from bdgs_ros.core import se3


def random_xi(seed: int, scale: float = 1.0) -> np.ndarray:
    return np.random.default_rng(seed).normal(size=6) * scale


@pytest.mark.parametrize('scale', [1e-9, 1e-4, 0.3, 1.0])
def test_log_inverts_exp(scale: float) -> None:
    for seed in range(20):
        xi = random_xi(seed, scale)
        if np.linalg.norm(xi[3:]) < np.pi:
            np.testing.assert_allclose(se3.log(se3.exp(xi)), xi, atol=1e-9)


def test_exp_is_the_limit_of_small_steps() -> None:
    xi = random_xi(3)
    steps = np.linalg.matrix_power(np.eye(4) + _generator(xi) / 2**20, 2**20)
    np.testing.assert_allclose(se3.exp(xi), steps, atol=1e-5)


def _generator(xi: np.ndarray) -> np.ndarray:
    out = np.zeros((4, 4))
    out[:3, :3] = se3.hat(xi[3:])
    out[:3, 3] = xi[:3]
    return out


def test_inverse_cancels() -> None:
    T = se3.exp(random_xi(1))
    np.testing.assert_allclose(se3.inverse(T) @ T, np.eye(4), atol=1e-12)


def test_quaternion_round_trip_has_positive_w() -> None:
    for seed in range(20):
        T = se3.exp(random_xi(seed, 2.0))
        position, quat = se3.to_position_quat_xyzw(T)
        assert quat[3] >= 0
        np.testing.assert_allclose(se3.from_position_quat_xyzw(position, quat), T, atol=1e-12)


def test_angle_of_a_quarter_turn() -> None:
    assert se3.rotation_angle_rad(se3.exp(np.array([1, 2, 3, 0, np.pi / 2, 0]))) == pytest.approx(
        np.pi / 2
    )


def test_orthonormalise_restores_a_rotation() -> None:
    T = se3.exp(random_xi(2))
    noisy = T.copy()
    noisy[:3, :3] += 1e-4 * np.random.default_rng(0).normal(size=(3, 3))
    R = se3.orthonormalise(noisy)[:3, :3]
    np.testing.assert_allclose(R @ R.T, np.eye(3), atol=1e-12)
    np.testing.assert_allclose(R, T[:3, :3], atol=1e-3)


def test_view_distances_join_way_and_turn() -> None:
    turn = np.array([0.0, 0.0, 0.0, 0.0, 0.5, 0.0])
    poses = [np.eye(4), se3.exp(np.array([3.0, 0, 4.0, 0, 0, 0])), se3.exp(turn)]
    distances = se3.view_distances(poses, metres_per_radian=2.0)
    assert np.all(np.isinf(np.diag(distances)))
    assert np.allclose(distances, distances.T)
    assert np.allclose(distances[0, 1:], [5.0, 1.0])


def test_what_is_stretched_mirrored_or_no_number_is_no_rigid_motion() -> None:
    T = np.array([se3.exp(np.array([1e3, -2.0, 3.0, 0.5, 2.0, -1.0])), np.eye(4)])
    assert se3.are_rigid(T) and se3.are_rigid(T[0])
    for diagonal in ([1.01, 1, 1, 1], [-1, 1, 1, 1], [1, 1, 1, 2], [np.nan, 1, 1, 1]):
        assert not se3.are_rigid(np.array([T[0], np.diag(diagonal)]))


def test_a_pose_may_be_corrected_by_some_metres_and_to_a_motion() -> None:
    old = [np.eye(4), se3.exp(np.array([1.0, 2.0, 3.0, 0.1, 0.2, 0.3]))]
    for x, expected in ((0.0, True), (19.0, True), (21.0, False), (np.nan, False)):
        T = np.eye(4)
        T[0, 3] = x
        assert se3.is_correction(old, [old[0], T @ old[1]]) == expected
    assert se3.is_correction([], [])
    assert not se3.is_correction(old, [old[0], 1.1 * old[1]])


@pytest.mark.parametrize(
    'angle', [0.0, 1e-12, 1e-8, 1e-4, 0.1, 1.5, 2.9, 3.1, 3.14159, math.pi - 1e-9]
)
def test_rotations_are_those_of_scipy(angle: float) -> None:
    rng = np.random.default_rng(0)
    for axis in rng.normal(size=(20, 3)):
        phi = angle * axis / np.linalg.norm(axis)
        expected = Rotation.from_rotvec(phi).as_matrix()
        T = se3.exp(np.concatenate([np.zeros(3), phi]))
        assert np.abs(T[:3, :3] - expected).max() < 1e-14
        found = se3.log(T)[3:]
        assert np.abs(Rotation.from_rotvec(found).as_matrix() - expected).max() < 1e-14
        assert se3.rotation_angle_rad(T) == pytest.approx(angle, abs=1e-8)


def test_hats_are_cross_products() -> None:
    vectors = np.random.default_rng(0).normal(size=(5, 3))
    for hat, vector in zip(se3.hats(vectors), vectors, strict=True):
        assert (hat == se3.hat(vector)).all()
        assert hat @ [1.0, 2.0, 3.0] == pytest.approx(np.cross(vector, [1.0, 2.0, 3.0]))


def test_many_rotation_vectors_are_those_of_each() -> None:
    phi = np.array([[0, 0, 0], [1e-9, 0, 0], [0.3, -0.2, 0.1], [0, 2.9, 0.4], [0, 0, np.pi]])
    rotations = np.array([se3.exp(np.append(np.zeros(3), each))[:3, :3] for each in phi])
    found = se3.rotation_vectors(rotations)
    np.testing.assert_allclose(np.abs(found), np.abs(phi), atol=1e-9)
    np.testing.assert_allclose(found[:4], phi[:4], atol=1e-9)
