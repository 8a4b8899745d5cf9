"""
Rigid motions as 4x4 matrices `T_a_b`, which map b-coordinates to a: `p_a = T_a_b @ p_b`.

Tangent vectors are `xi = (rho, phi)`, shape (6,): translation part first, in metres, then the
rotation vector in radians. The exponential follows Sola et al., "A micro Lie theory", Eq. (172).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import cv2
import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

Matrix = NDArray[np.float64]
Vector = NDArray[np.float64]

_SMALL_ANGLE_RAD = 1e-6
_NEAR_HALF_TURN = -0.99  # cosine
FARTHEST_CORRECTION_M = 20.0
"""
Nothing that is seen again justifies moving a keyframe by more: such a loop closes what drifted
over a kilometre, at two percent, and a depth camera sees no further.
"""
_RIGID = 1e-3  # float32 and many products stay within a tenth of that


def identity() -> Matrix:
    """Return the motion that moves nothing, shape (4, 4)."""
    return np.eye(4)


def from_rotation_translation(rotation: Matrix, translation: Vector) -> Matrix:
    """Assemble `T` from a rotation, shape (3, 3), and a translation, shape (3,)."""
    T = np.eye(4)
    T[:3, :3] = rotation
    T[:3, 3] = translation
    return T


def inverse(T_a_b: Matrix) -> Matrix:
    """Return `T_b_a`."""
    rotation = T_a_b[:3, :3].T
    return from_rotation_translation(rotation, -rotation @ T_a_b[:3, 3])


def hat(vector: Vector) -> Matrix:
    """Return the skew-symmetric matrix, shape (3, 3), with `hat(a) @ b == cross(a, b)`."""
    x, y, z = vector
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def hats(vectors: Matrix) -> Matrix:
    """Return `hat` of each vector, shape (N, 3), as (N, 3, 3)."""
    x, y, z = vectors.T
    result = np.zeros((len(vectors), 3, 3))
    result[:, 0, 1], result[:, 0, 2], result[:, 1, 2] = -z, y, -x
    result[:, 1, 0], result[:, 2, 0], result[:, 2, 1] = z, -y, x
    return result


def exp(xi: Vector) -> Matrix:
    """Map a tangent vector `(rho, phi)`, shape (6,), to a motion, shape (4, 4)."""
    rho, phi = xi[:3], xi[3:]
    return from_rotation_translation(np.asarray(cv2.Rodrigues(phi)[0]), _left_jacobian(phi) @ rho)


def log(T_a_b: Matrix) -> Vector:
    """Map a motion, shape (4, 4), to its tangent vector `(rho, phi)`, shape (6,)."""
    phi = _rotation_vector(T_a_b[:3, :3])
    rho = np.linalg.solve(_left_jacobian(phi), T_a_b[:3, 3])
    return np.concatenate([rho, phi])


def _rotation_vector(rotation: Matrix) -> Vector:
    """Return axis times angle, shape (3,): from the skew part, a tenth of scipy's time."""
    cosine = 0.5 * (rotation[0, 0] + rotation[1, 1] + rotation[2, 2] - 1)
    if cosine < _NEAR_HALF_TURN:  # where the skew part vanishes as well
        return np.asarray(Rotation.from_matrix(rotation).as_rotvec())
    skew = rotation - rotation.T
    axis = 0.5 * np.array([skew[2, 1], skew[0, 2], skew[1, 0]])
    sine = math.sqrt(axis @ axis)
    return axis * (math.atan2(sine, cosine) / sine if sine > 0 else 1.0)


def rotation_vectors(rotations: Matrix) -> Matrix:
    """Return axis times angle of each rotation, shape (N, 3, 3), as (N, 3)."""
    twice_cosine = np.trace(rotations, axis1=1, axis2=2) - 1
    skew = rotations - np.swapaxes(rotations, 1, 2)
    twice_axis = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], axis=1)
    twice_sine = np.sqrt((twice_axis**2).sum(axis=1))
    angle = np.arctan2(twice_sine, twice_cosine)
    share = np.divide(angle, twice_sine, out=np.full_like(angle, 0.5), where=twice_sine > 0)
    vectors = share[:, None] * twice_axis
    unclear = twice_cosine < 2 * _NEAR_HALF_TURN
    if unclear.any():
        vectors[unclear] = Rotation.from_matrix(rotations[unclear]).as_rotvec()
    return np.asarray(vectors)


def _left_jacobian(phi: Vector) -> Matrix:
    angle = float(np.linalg.norm(phi))
    skew = hat(phi)
    if angle < _SMALL_ANGLE_RAD:
        return np.eye(3) + 0.5 * skew
    return np.asarray(
        np.eye(3)
        + (1.0 - np.cos(angle)) / angle**2 * skew
        + (angle - np.sin(angle)) / angle**3 * (skew @ skew)
    )


def from_position_quat_xyzw(position: Vector, quat_xyzw: Vector) -> Matrix:
    """Assemble `T` from a position in metres and a quaternion in the order of ROS and TUM."""
    return from_rotation_translation(Rotation.from_quat(quat_xyzw).as_matrix(), position)


def to_position_quat_xyzw(T_a_b: Matrix) -> tuple[Vector, Vector]:
    """Split `T` into a position, shape (3,), and a quaternion xyzw with w >= 0, shape (4,)."""
    quat = Rotation.from_matrix(T_a_b[:3, :3]).as_quat(canonical=True)
    return T_a_b[:3, 3].copy(), np.asarray(quat)


def adjoint(T_a_b: Matrix) -> Matrix:
    """Return the matrix, shape (6, 6), that takes tangents of b to a: `T exp(x) = exp(Ad x) T`."""
    rotation = T_a_b[:3, :3]
    out = np.zeros((6, 6))
    out[:3, :3] = out[3:, 3:] = rotation
    out[:3, 3:] = hat(T_a_b[:3, 3]) @ rotation
    return out


def rotation_angle_rad(T_a_b: Matrix) -> float:
    """Return the angle of the rotation part, in [0, pi]."""
    return float(np.linalg.norm(_rotation_vector(T_a_b[:3, :3])))


def orthonormalise(T_a_b: Matrix) -> Matrix:
    """Project the rotation part back onto SO(3) after many products."""
    u, _, vt = np.linalg.svd(T_a_b[:3, :3])
    return from_rotation_translation(u @ np.diag([1, 1, np.linalg.det(u @ vt)]) @ vt, T_a_b[:3, 3])


def are_rigid(T_a_b: Matrix) -> bool:
    """Return whether matrices, shape (..., 4, 4), are motions: finite, and no scale or mirror."""
    if not np.isfinite(T_a_b).all():
        return False
    rotation = T_a_b[..., :3, :3]
    square = rotation @ np.swapaxes(rotation, -1, -2)
    is_turn = np.allclose(square, np.eye(3), atol=_RIGID) and (np.linalg.det(rotation) > 0).all()
    return bool(is_turn and (T_a_b[..., 3, :] == [0, 0, 0, 1]).all())


def is_correction(old: Sequence[Matrix], new: Sequence[Matrix]) -> bool:
    """Return whether poses may become others: they are motions, and none goes far."""
    if not len(new):
        return True
    after = np.array(new)
    if not are_rigid(after):
        return False
    way_m = np.linalg.norm(after[:, :3, 3] - np.array(old)[:, :3, 3], axis=1)
    return bool((way_m < FARTHEST_CORRECTION_M).all())


def view_distances(poses: Sequence[Matrix], metres_per_radian: float) -> Matrix:
    """
    Say how differently cameras see: the way between them, and the turn of their optical axes.

    Parameters
    ----------
    poses : sequence of ndarray, shape (4, 4)
        `T_world_camera` of K cameras.
    metres_per_radian : float
        How far a camera has to go for what it sees to change as much as by a turn of a radian.

    Returns
    -------
    distances : ndarray, shape (K, K)
        Metres; infinite on the diagonal, so that no camera is the nearest to itself.

    """
    centres = np.array([pose[:3, 3] for pose in poses])
    axes = np.array([pose[:3, 2] for pose in poses])
    apart = np.linalg.norm(centres[:, None] - centres, axis=2)
    distances = apart + metres_per_radian * np.arccos(np.clip(axes @ axes.T, -1, 1))
    np.fill_diagonal(distances, np.inf)
    return np.asarray(distances)
