"""
Objects followed from detection to detection, so that masks exist at camera rate.

One Kalman filter per object at constant velocity (section 3.1 of the paper), in the odometry
frame: a camera that turns does not move the objects. Detections are given to predicted objects by
the Hungarian assignment. Whether an object exists is a belief too: seen once it is a rumour, seen
often it is held for a while when the network misses it, and a box out of nowhere fades at once.

The filters stand at the stamp of the last answer of the detector and are predicted from there to
any frame, so an answer that comes late is taken in at its own time.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import kalman
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.detection import TracksConfig
from bdgs_ros.core.types import Detection, Pose
from bdgs_ros.detection.association import assign
from bdgs_ros.detection.classes import dynamic_prior
from bdgs_ros.detection.sighting import Sighting, first_state, measurement, shown_as

Vector = NDArray[np.float64]
Matrix = NDArray[np.float64]

_VISIBLE = 0.15  # less of a box inside the image, and the object has left
_SECONDS = 1e-9


@dataclass(frozen=True)
class Track:
    """
    One object at the stamp of the detector's last answer.

    The state is (x y z, w h, vx vy vz): the centre of the box at the object's depth in the
    odometry frame, metres; width and height of the box, metres; velocity, metres per second.
    """

    track_id: int
    stamp_ns: int
    seen_ns: int
    state: Vector
    """Shape (8,)."""
    covariance: Matrix
    """Shape (8, 8)."""
    odds: float
    """That the object exists."""
    detection: Detection
    """The last one of it."""

    @property
    def p_exists(self) -> float:
        """Belief that there is such an object, in [0, 1]."""
        return self.odds / (1.0 + self.odds)

    @property
    def velocity(self) -> Vector:
        """In the odometry frame, m/s, shape (3,)."""
        return self.state[5:]

    @property
    def velocity_covariance(self) -> Matrix:
        """Of `velocity`, (m/s)^2, shape (3, 3)."""
        return self.covariance[5:, 5:]


def transition(dt: float, config: TracksConfig) -> tuple[Matrix, Matrix]:
    """
    Return F and Q over a time.

    Velocities are an Ornstein-Uhlenbeck process (Singer's model one derivative lower): those of
    people are bounded and forgotten within a second. Sizes drift like Brownian motion.

    Parameters
    ----------
    dt : float
        Seconds, not negative.
    config : TracksConfig
        `speed` is the standard deviation of the velocity, `speed_s` its correlation time.

    Returns
    -------
    F, Q : ndarray, shape (8, 8)
        Of the state of `Track`. Two steps in a row are one step of the sum.

    """
    F, Q = np.eye(8), np.zeros((8, 8))
    position, size, velocity = np.arange(3), np.arange(3, 5), np.arange(5, 8)
    tau, variance = config.speed_s, config.speed**2
    kept = np.exp(-dt / tau)
    F[position, velocity] = tau * (1 - kept)
    F[velocity, velocity] = kept
    # The integrals over the time that is left of the noise that enters meanwhile.
    spread = 2 * tau * dt - tau**2 * (3 - 4 * kept + kept**2)
    Q[position, position] = variance * max(spread, 0.0)
    Q[position, velocity] = Q[velocity, position] = variance * tau * (1 - kept) ** 2
    Q[velocity, velocity] = variance * (1 - kept**2)
    Q[size, size] = config.size_change**2 * dt
    return F, Q


class ObjectTracks:
    """
    The objects that may move.

    Parameters
    ----------
    config : TracksConfig
        What objects do and how far detections are believed.

    """

    def __init__(self, config: TracksConfig) -> None:
        self._config = config
        self.reset()

    def reset(self) -> None:
        """Forget all objects."""
        self.tracks: tuple[Track, ...] = ()
        self._count = 0
        self._stamp_ns: int | None = None

    def move(self, T_new_old: Pose) -> None:
        """Express everything in another odometry frame; (4, 4), maps old coordinates to new."""
        turn = np.eye(8)
        turn[:3, :3] = turn[5:, 5:] = T_new_old[:3, :3]
        shift = np.concatenate([T_new_old[:3, 3], np.zeros(5)])
        self.tracks = tuple(
            replace(t, state=turn @ t.state + shift, covariance=turn @ t.covariance @ turn.T)
            for t in self.tracks
        )

    def update(
        self,
        stamp_ns: int,
        sightings: Sequence[Sighting],
        camera: PinholeCamera,
        T_odom_camera: Pose,
    ) -> None:
        """
        Take in what the detector found in one image.

        Parameters
        ----------
        stamp_ns : int
            Of the image; answers come in the order of their images.
        sightings : sequence of Sighting
            The detections with their depth.
        camera : PinholeCamera
            Of the image.
        T_odom_camera : ndarray, shape (4, 4)
            Where the camera was.

        """
        tracks = self._predicted(stamp_ns)
        expected = [shown_as(t.state, camera, T_odom_camera) for t in tracks]
        pairs = assign(tracks, expected, sightings, T_odom_camera, self._config)
        followed = [self._corrected(tracks[k], sightings[i], T_odom_camera) for i, k in pairs]
        seen, taken = {i for i, _ in pairs}, {k for _, k in pairs}
        born = [
            self._born(stamp_ns, s, T_odom_camera)
            for i, s in enumerate(sightings)
            if i not in seen
        ]
        missed = [self._missed(t) for k, t in enumerate(tracks) if k not in taken]
        held = [t for t in missed if self._worth_keeping(t, camera, T_odom_camera)]
        self.tracks = tuple(followed + born + held)
        self._stamp_ns = stamp_ns

    def at(self, stamp_ns: int, camera: PinholeCamera, T_odom_camera: Pose) -> list[Detection]:
        """
        Return the objects as a camera sees them, at a stamp not before the last answer.

        An object that was seen at this very stamp has the box of its detection; others have the
        predicted one, wider by its uncertainty, and the depths between which they must be.
        """
        found = []
        for track in self._predicted(stamp_ns):
            if track.seen_ns == stamp_ns:
                found.append(self._as_seen(track))
            elif (stamp_ns - track.seen_ns) * _SECONDS <= self._config.longest_s:
                found += self._as_predicted(track, camera, T_odom_camera)
        return sorted(found, key=lambda d: -d.score)

    def _as_seen(self, track: Track) -> Detection:
        prior = dynamic_prior(track.detection.class_name)
        return replace(track.detection, p_dynamic=prior * track.p_exists)

    def _as_predicted(
        self, now: Track, camera: PinholeCamera, T_odom_camera: Pose
    ) -> list[Detection]:
        shown = shown_as(now.state, camera, T_odom_camera)
        if shown is None or shown.visible < _VISIBLE:
            return []
        axes = T_odom_camera[:3, :3]
        sigma_m = np.sqrt(np.diag(axes.T @ now.covariance[:3, :3] @ axes))
        wide = now.state.copy()
        wide[3:5] += 2 * np.minimum(self._config.widen * sigma_m[:2], 0.5 * now.state[3:5])
        shown = shown_as(wide, camera, T_odom_camera) or shown
        reach = float(self._config.gate_sigma * np.hypot(sigma_m[2], self._config.depth_sigma))
        seen = replace(
            self._as_seen(now),
            box_xyxy=shown.clipped,
            score=now.detection.score * now.p_exists,
            depth_m=(shown.depth_m - reach, shown.depth_m + reach),
        )
        return [seen]

    def _predicted(self, stamp_ns: int) -> list[Track]:
        """Return the objects at a stamp; they all stand at that of the last answer."""
        dt = 0.0 if self._stamp_ns is None else (stamp_ns - self._stamp_ns) * _SECONDS
        if dt <= 0:
            return list(self.tracks)
        F, Q = transition(dt, self._config)
        moved = (kalman.predict(t.state, t.covariance, F, Q) for t in self.tracks)
        return [
            replace(t, state=state, covariance=covariance, stamp_ns=stamp_ns)
            for t, (state, covariance) in zip(self.tracks, moved, strict=True)
        ]

    def _corrected(self, track: Track, sighting: Sighting, T_odom_camera: Pose) -> Track:
        m = measurement(sighting, T_odom_camera, self._config)
        state, covariance = kalman.update(track.state, track.covariance, m.z, m.R, m.H)
        odds = min(track.odds * self._evidence(sighting.detection.score), self._config.most_odds)
        return replace(
            track,
            seen_ns=track.stamp_ns,
            state=state,
            covariance=covariance,
            odds=odds,
            detection=sighting.detection,
        )

    def _born(self, stamp_ns: int, sighting: Sighting, T_odom_camera: Pose) -> Track:
        place, uncertainty = first_state(measurement(sighting, T_odom_camera, self._config))
        covariance = np.diag([0.0] * 5 + [self._config.speed**2] * 3)
        covariance[:5, :5] = uncertainty
        state = np.concatenate([place, np.zeros(3)])
        odds = self._odds_of_birth(sighting) * self._evidence(sighting.detection.score)
        self._count += 1
        return Track(self._count, stamp_ns, stamp_ns, state, covariance, odds, sighting.detection)

    def _odds_of_birth(self, sighting: Sighting) -> float:
        """Objects come in at the border, or were there at the start."""
        if self._stamp_ns is None:
            return self._config.start_odds
        return self._config.border_odds if any(sighting.cut_off) else self._config.birth_odds

    def _missed(self, track: Track) -> Track:
        """The network errs for frames on end, so it is time and not frames that counts."""
        dt = 0.0 if self._stamp_ns is None else (track.stamp_ns - self._stamp_ns) * _SECONDS
        factor = max(np.exp(-dt / self._config.miss_s), self._config.miss_odds)
        return replace(track, odds=track.odds * factor)

    def _worth_keeping(self, track: Track, camera: PinholeCamera, T_odom_camera: Pose) -> bool:
        unseen_s = (track.stamp_ns - track.seen_ns) * _SECONDS
        shown = shown_as(track.state, camera, T_odom_camera)
        inside = shown is not None and shown.visible >= _VISIBLE
        return inside and unseen_s <= self._config.longest_s and track.odds > 0.02

    def _evidence(self, score: float) -> float:
        """Return the factor by which a detection of a score raises the odds; never lowers them."""
        even = self._config.even_score
        return max(score / max(1.0 - score, 1e-3) * (1.0 - even) / even, 1.0)
