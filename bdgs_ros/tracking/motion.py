"""
Where the camera will be: a constant-velocity Kalman filter on SE(3), section 3.1 of the paper.

The state is a pose with a body velocity `nu = (v, w)`; between frames the camera follows the
screw motion `T <- T exp(nu dt)`. The filter is an error-state one: its twelve numbers are the
pose error `xi` in the camera's tangent, `T_true = T exp(xi)`, and the velocity. The pose error is
zero after every update, when it is folded into the pose.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import kalman, se3
from bdgs_ros.core.config.tracking import MotionConfig
from bdgs_ros.core.types import Pose

_log = logging.getLogger(__name__)

Matrix = NDArray[np.float64]

_START_SPEED = 0.5  # m/s, standard deviation of the velocity while nothing is known
_START_SPIN = 1.0  # rad/s
_LATELY_S = 0.5
_USUAL_DEPTH_M = 3.0  # of the rooms that people carry cameras through
_POSE_ALONE = np.eye(6, 12)  # is measured, not the velocity
_LEAST_VARIANCE = 1e-10  # of a measurement, so that the innovation can be inverted


@dataclass(frozen=True)
class _State:
    stamp_ns: int
    T_world_camera: Pose
    velocity: Matrix
    """Shape (6,): (v, w) in the camera's frame, m/s and rad/s."""
    covariance: Matrix
    """Shape (12, 12): of (xi, nu)."""


class MotionPredictor:
    """
    Predicts the camera pose from those measured before.

    Parameters
    ----------
    config : MotionConfig
        Which model, and the accelerations that it expects.

    """

    def __init__(self, config: MotionConfig) -> None:
        self._config = config
        self._state: _State | None = None
        self._last: tuple[_State, _State] | None = None  # a state and where it was moved to
        self._depth_m = _USUAL_DEPTH_M

    def look(self, depth_m: float) -> None:
        """
        Take at what depth the camera looks: where all is far it may move faster.

        Whatever carries it through a hall or over a field keeps what it sees in view, and does
        not the more gently for that. Otherwise the prediction outweighs images that show little
        of a move.
        """
        self._depth_m = depth_m

    def reset(self) -> None:
        """Forget pose and velocity."""
        self._state = None

    def predict(self, stamp_ns: int) -> tuple[Pose, Matrix]:
        """
        Say where the camera will be; changes nothing.

        Parameters
        ----------
        stamp_ns : int
            Later than the last update.

        Returns
        -------
        T_world_camera : ndarray, shape (4, 4)
            The prediction; identity before the first update.
        covariance : ndarray, shape (6, 6)
            Of `xi` in `T_world_camera @ exp(xi)`: m^2, then rad^2.

        Raises
        ------
        ValueError
            If the stamp is not later than the last update.

        """
        if self._state is None:
            return se3.identity(), self._start_covariance()[:6, :6]
        moved = self._propagate(self._state, stamp_ns)
        return moved.T_world_camera, moved.covariance[:6, :6]

    @property
    def velocity(self) -> Matrix:
        """Shape (6,): (v, w) in the camera's frame, m/s and rad/s; 0 before the first update."""
        return np.zeros(6) if self._state is None else self._state.velocity

    def velocity_with(self, stamp_ns: int, T_world_camera: Pose, covariance: Matrix) -> Matrix:
        """Return what the velocity would be after an update; changes nothing."""
        return self._after(stamp_ns, T_world_camera, covariance).velocity

    def update(self, stamp_ns: int, T_world_camera: Pose, covariance: Matrix) -> None:
        """
        Take a measured pose; one that is far off the prediction starts the velocity anew.

        Parameters
        ----------
        stamp_ns : int
            Later than the last one.
        T_world_camera : ndarray, shape (4, 4)
            As measured.
        covariance : ndarray, shape (6, 6)
            Of `xi` in `T_world_camera @ exp(xi)`: m^2, then rad^2.

        Raises
        ------
        ValueError
            If the stamp is not later than the last one.

        """
        self._state = self._after(stamp_ns, T_world_camera, covariance)

    def _after(self, stamp_ns: int, T_world_camera: Pose, covariance: Matrix) -> _State:
        measured = se3.orthonormalise(T_world_camera)
        noise = covariance + _LEAST_VARIANCE * np.eye(6)
        if self._state is None:
            return self._start(stamp_ns, measured, noise)
        predicted = self._propagate(self._state, stamp_ns)
        if self._config.model == 'velocity':
            return self._difference(self._state, stamp_ns, measured, noise)
        innovation = se3.log(se3.inverse(predicted.T_world_camera) @ measured)
        if self._is_outside(innovation, predicted.covariance[:6, :6] + noise):
            return self._start(stamp_ns, measured, noise)
        return self._correct(predicted, innovation, noise)

    def expects(self, stamp_ns: int, T_world_camera: Pose, covariance: Matrix) -> bool:
        """Tell whether the camera was seen lately, and a measured pose is where it may be now."""
        if self._state is None or stamp_ns - self._state.stamp_ns > 1e9 * _LATELY_S:
            return False
        pose, spread = self.predict(stamp_ns)
        innovation = se3.log(se3.inverse(pose) @ T_world_camera)
        squared = float(innovation @ np.linalg.solve(spread + covariance, innovation))
        return squared <= self._config.gate_sigma**2

    def move(self, T_new_old: Pose) -> None:
        """Follow a correction of the world, `T_new_camera = T_new_old @ T_old_camera`."""
        if self._state is not None:
            moved = se3.orthonormalise(T_new_old @ self._state.T_world_camera)
            self._state = replace(self._state, T_world_camera=moved)

    def _start(self, stamp_ns: int, T_world_camera: Pose, noise: Matrix) -> _State:
        covariance = self._start_covariance()
        covariance[:6, :6] = noise
        return _State(stamp_ns, T_world_camera, np.zeros(6), covariance)

    def _start_covariance(self) -> Matrix:
        spread = [_START_SPEED**2] * 3 + [_START_SPIN**2] * 3
        return np.diag(np.array(spread * 2))

    def _propagate(self, state: _State, stamp_ns: int) -> _State:
        """Move to a stamp; a frame asks three times: to predict, for its velocity, to update."""
        if self._last is None or self._last[0] is not state or self._last[1].stamp_ns != stamp_ns:
            self._last = state, self._moved(state, stamp_ns)
        return self._last[1]

    def _moved(self, state: _State, stamp_ns: int) -> _State:
        """Move along the screw; the pose error turns with the camera, and noise is added."""
        if stamp_ns <= state.stamp_ns:
            raise ValueError(
                f'stamp_ns: expected later than {state.stamp_ns}, received {stamp_ns}; '
                'call reset() after a jump back in time'
            )
        dt = (stamp_ns - state.stamp_ns) * 1e-9
        if self._config.model == 'none':
            noise = self._start_covariance() * dt**2
            return _State(stamp_ns, state.T_world_camera, np.zeros(6), state.covariance + noise)
        # nobody keeps a velocity for long; unseen, the camera is not carried out of the room
        step = se3.exp(state.velocity * min(dt, self._config.coast_s))
        F = np.eye(12)
        F[:6, :6] = se3.adjoint(se3.inverse(step))
        F[:6, 6:] = dt * np.eye(6)
        covariance = F @ state.covariance @ F.T + self._process_noise(dt)
        pose = se3.orthonormalise(state.T_world_camera @ step)
        return replace(state, stamp_ns=stamp_ns, T_world_camera=pose, covariance=covariance)

    def _process_noise(self, dt: float) -> Matrix:
        """Return the noise of an acceleration that is constant over the step but unknown."""
        linear = self._config.acceleration_sigma * max(1.0, self._depth_m / _USUAL_DEPTH_M)
        angular = self._config.angular_acceleration_sigma
        push = np.vstack([0.5 * dt**2 * np.eye(6), dt * np.eye(6)])
        accelerations = np.diag([linear**2] * 3 + [angular**2] * 3)
        return np.asarray(push @ accelerations @ push.T)

    def _difference(self, last: _State, stamp_ns: int, measured: Pose, noise: Matrix) -> _State:
        """
        Take pose and velocity from the last two measurements alone, without a filter.

        The covariance is that of a two-point difference, with the same noise in both poses [1]_.

        References
        ----------
        .. [1] Y. Bar-Shalom, X. R. Li, T. Kirubarajan, "Estimation with Applications to Tracking
           and Navigation", 2001, section 5.5.3.

        """
        dt = (stamp_ns - last.stamp_ns) * 1e-9
        velocity = se3.log(se3.inverse(last.T_world_camera) @ measured) / dt
        covariance = np.block([[noise, noise / dt], [noise / dt, 2 * noise / dt**2]])
        return _State(stamp_ns, measured, velocity, covariance)

    def _is_outside(self, innovation: Matrix, covariance: Matrix) -> bool:
        squared = float(innovation @ np.linalg.solve(covariance, innovation))
        outside = squared > self._config.gate_sigma**2
        if outside and self._config.model == 'kalman':
            _log.info(
                'pose is %.1f sigma off its prediction (%.3f m, %.1f deg); velocity starts anew',
                np.sqrt(squared),
                np.linalg.norm(innovation[:3]),
                np.rad2deg(np.linalg.norm(innovation[3:])),
            )
        return outside

    def _correct(self, predicted: _State, innovation: Matrix, noise: Matrix) -> _State:
        """Update the error state, then fold the pose error into the pose."""
        state = np.concatenate([np.zeros(6), predicted.velocity])
        state, covariance = kalman.update(
            state, predicted.covariance, innovation, noise, _POSE_ALONE
        )
        pose = se3.orthonormalise(predicted.T_world_camera @ se3.exp(state[:6]))
        velocity = state[6:] if self._config.model == 'kalman' else np.zeros(6)
        covariance = 0.5 * (covariance + covariance.T)
        return replace(predicted, T_world_camera=pose, velocity=velocity, covariance=covariance)
