"""
What the stages hand to each other.

Each type carries exactly what its topic carries (8-bit colour, 8-bit probabilities, float32
depth), so the offline pipeline and the live graph compute on the same numbers.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera

ColorImage = NDArray[np.uint8]  # [H, W, 3] RGB
DepthImage = NDArray[np.float32]  # [H, W] metres along z, 0 = invalid
ProbabilityImage = NDArray[np.uint8]  # [H, W] P(dynamic) x 255
Pose = NDArray[np.float64]  # [4, 4]

NO_KEYFRAME_NS = 0
"""Stamp of a `ModelView` that answers no keyframe: the view of a map that tracking begins in."""
DYNAMIC_THRESHOLD = 128  # a ProbabilityImage pixel at or above this is called dynamic


@dataclass(frozen=True)
class RgbdFrame:
    """One rectified colour image with its registered depth."""

    stamp_ns: int
    color: ColorImage
    depth_m: DepthImage
    camera: PinholeCamera
    depth_delay_ns: int = 0
    """From the stamp, which is that of colour, to that of the depth image."""

    def __post_init__(self) -> None:
        """Refuse images that do not fit the camera."""
        if self.color.shape != (*self.camera.shape, 3) or self.color.dtype != np.uint8:
            raise ValueError(
                f'color: expected uint8 {(*self.camera.shape, 3)}, '
                f'received {self.color.dtype} {self.color.shape}'
            )
        if self.depth_m.shape != self.camera.shape or self.depth_m.dtype != np.float32:
            raise ValueError(
                f'depth_m: expected float32 {self.camera.shape}, '
                f'received {self.depth_m.dtype} {self.depth_m.shape}'
            )


@dataclass(frozen=True)
class Detection:
    """One object found by the detector, in pixels of the full image."""

    box_xyxy: tuple[float, float, float, float]
    score: float
    class_id: int
    class_name: str
    p_dynamic: float
    """Prior that an object of this class moves, in [0, 1]."""
    depth_m: tuple[float, float] | None = None
    """Between which depths it must be, for a box that was predicted and not seen."""


@dataclass(frozen=True)
class Labels:
    """The dynamic prior of one frame: what `bdgs/labels` carries."""

    stamp_ns: int
    p_dynamic: ProbabilityImage
    detections: tuple[Detection, ...] = ()


@dataclass(frozen=True)
class ModelView:
    """
    The static map rendered at a keyframe: the feedback from mapping to tracking.

    `depth_m` is 0 where the map is empty; `p_dynamic` is the posterior of what is seen there.
    `readout_s` is what has been learnt of the camera's rolling shutter, None while it is unknown.
    """

    stamp_ns: int
    T_world_camera: Pose
    camera: PinholeCamera
    color: ColorImage
    depth_m: DepthImage
    p_dynamic: ProbabilityImage
    readout_s: float | None = None


class TrackingStatus(Enum):
    """Whether the pose of a frame can be used."""

    OK = 'ok'
    LOST = 'lost'


@dataclass(frozen=True)
class TrackingResult:
    """The camera pose of one frame; when LOST the pose is the prediction and not to be used."""

    stamp_ns: int
    status: TrackingStatus
    T_world_camera: Pose
    covariance: NDArray[np.float64]
    """Shape (6, 6), of the camera's tangent (x y z, rotation) in m^2 and rad^2."""
    is_keyframe: bool
    p_dynamic: ProbabilityImage
    """Full image: the prior joined with what tracking saw move."""
    inlier_ratio: float = 0.0
    overlap: float = 0.0
    p_moving: ProbabilityImage | None = None
    """Full image: what is large and moves on its own though the prior does not say so, if any."""


@dataclass(frozen=True)
class Keyframe:
    """A frame that mapping keeps, with its pose and dynamic prior."""

    frame: RgbdFrame
    T_world_camera: Pose
    p_dynamic: ProbabilityImage


@dataclass(frozen=True)
class StampedPose:
    """One row of a trajectory."""

    stamp_ns: int
    T_world_camera: Pose


@dataclass(frozen=True)
class Trajectory:
    """Poses in order of time."""

    poses: tuple[StampedPose, ...] = field(default_factory=tuple)

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """The stamps, shape (N,)."""
        return np.array([p.stamp_ns for p in self.poses], dtype=np.int64)

    @property
    def positions(self) -> NDArray[np.float64]:
        """The positions in metres, shape (N, 3)."""
        return np.array([p.T_world_camera[:3, 3] for p in self.poses]).reshape(-1, 3)

    @property
    def matrices(self) -> NDArray[np.float64]:
        """The poses, shape (N, 4, 4)."""
        return np.array([p.T_world_camera for p in self.poses]).reshape(-1, 4, 4)

    def __len__(self) -> int:
        """Return the number of poses."""
        return len(self.poses)
