"""
The class-agnostic prior: what stands where an earlier frame looked through free space.

Each pixel of the current depth image is carried into frames from a fraction of a second ago. Where
such a frame saw a surface well behind the point, the point was free space then and is occupied
now: something moved in. Disoccluded background never looks like that, and a surface in the
same place never does, so static scenes stay empty even at their occlusion edges. (DG-SLAM's depth
warp with positive residuals only, ANCHORS 4.2.) What a mover has just left is not found here; the
map's own residuals are for that.
"""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.detection import GeometricConfig
from bdgs_ros.core.images import Mask, opened, without_specks
from bdgs_ros.core.types import DYNAMIC_THRESHOLD, DepthImage, Pose, ProbabilityImage, RgbdFrame
from bdgs_ros.detection.depth_align import InverseDepth, align_depth
from bdgs_ros.detection.ego_motion import EgoMotion

_SECOND_NS = 1_000_000_000
_KERNEL = np.ones((3, 3), np.uint8)
_FREE_RADIUS = 2  # pixels of the comparison that registration may be off


@dataclass(frozen=True)
class View:
    """What an earlier frame saw, at the resolution of the comparison."""

    stamp_ns: int
    T_odom_camera: Pose
    way: NDArray[np.float64]
    """Metres moved and radians turned since the start, whatever the direction."""
    free_m: DepthImage
    """Shape (h, w): how far each viewing ray was certainly free; 0 = unknown."""
    inverse_depth: InverseDepth


def free_depth(depth_m: DepthImage, radius: int) -> DepthImage:
    """
    Return how far the rays around each pixel were free: the least depth nearby.

    A neighbour without depth makes a pixel unknown (0). The margin absorbs misalignment and the
    flying pixels at depth edges.
    """
    size = 2 * radius + 1
    return np.asarray(cv2.erode(depth_m, np.ones((size, size), np.uint8)), dtype=np.float32)


def free_space_gap(
    points_camera: NDArray[np.float32],
    T_ref_camera: Pose,
    free_m: DepthImage,
    camera: PinholeCamera,
) -> NDArray[np.float32]:
    """
    Return how far in front of an earlier surface each current point lies.

    Parameters
    ----------
    points_camera : ndarray, shape (h, w, 3), float32
        Current points in metres; z = 0 where depth is invalid.
    T_ref_camera : ndarray, shape (4, 4)
        From the current camera's frame to the earlier one's.
    free_m : ndarray, shape (h, w), float32
        `free_depth` of the earlier frame.
    camera : PinholeCamera
        Intrinsics of both.

    Returns
    -------
    gap_m : ndarray, shape (h, w), float32
        Positive: the point stands in what was free space. NaN where nothing can be said.

    """
    rotation = T_ref_camera[:3, :3].astype(np.float32)
    moved = cv2.transform(
        points_camera, np.hstack([rotation, T_ref_camera[:3, 3:].astype(np.float32)])
    )
    z = np.maximum(moved[..., 2], 1e-3)
    u = (camera.fx * moved[..., 0] / z + camera.cx).astype(np.float32)
    v = (camera.fy * moved[..., 1] / z + camera.cy).astype(np.float32)
    seen = cv2.remap(free_m, u, v, cv2.INTER_NEAREST, borderMode=cv2.BORDER_CONSTANT)
    known = (seen > 0) & (points_camera[..., 2] > 0) & (moved[..., 2] > 0.1)
    return np.asarray(np.where(known, seen - moved[..., 2], np.nan), dtype=np.float32)


class GeometricPrior:
    """
    Finds moving things of any kind from depth and ego-motion.

    Parameters
    ----------
    config : GeometricConfig
        Thresholds and lags.
    ego_motion : EgoMotion
        Where the camera is, in a frame that may drift slowly.

    """

    def __init__(self, config: GeometricConfig, ego_motion: EgoMotion) -> None:
        self._config = config
        self._ego = ego_motion
        self._lags_ns = [int(config.lag * 2**k * _SECOND_NS) for k in range(config.lags)]
        self._views: deque[View] = deque()
        self._last: Mask | None = None
        self.T_odom_camera: Pose | None = None
        """Of the last frame; None where the motion was not known, and a new frame begins."""

    def reset(self) -> None:
        """Forget all earlier frames."""
        self._views.clear()
        self._ego.reset()
        self._last = None
        self.T_odom_camera = None

    def process(self, frame: RgbdFrame, prior: ProbabilityImage) -> ProbabilityImage:
        """
        Return the geometric P(dynamic) of a frame, x 255, shape (H, W).

        Parameters
        ----------
        frame : RgbdFrame
            Stamps must increase; call `reset` when they jump back.
        prior : ndarray, shape (H, W), uint8
            What is known to move already: the ego-motion is told to leave it out.

        """
        told = self._with_last(prior)
        self.T_odom_camera = T_odom_camera = self._ego.update(frame, told)
        if T_odom_camera is None:
            self._views.clear()
            self._last = None
            return np.zeros(frame.depth_m.shape, np.uint8)
        now, depth_m, moving = self._look(frame, T_odom_camera, told)
        points = now.inverse_depth.camera.unproject(depth_m)
        self._last = self._movers(now, points, moving)
        self._remember(now)
        return self._paint(self._last, frame.depth_m.shape)

    def _look(
        self, frame: RgbdFrame, T_odom_camera: Pose, told: ProbabilityImage
    ) -> tuple[View, DepthImage, Mask]:
        """Return the frame as later ones will compare with it, its depth and what moves in it."""
        camera = frame.camera.scaled(min(1.0, self._config.width / frame.camera.width))
        depth_m = _shrink(frame.depth_m, camera)
        moving = _shrink(told, camera) >= DYNAMIC_THRESHOLD
        view = View(
            frame.stamp_ns,
            T_odom_camera,
            self._way_to(T_odom_camera),
            free_depth(depth_m, _FREE_RADIUS),
            InverseDepth.of(np.where(moving, np.float32(0), depth_m), camera),
        )
        return view, depth_m, moving

    def _with_last(self, prior: ProbabilityImage) -> ProbabilityImage:
        if self._last is None or not self._last.any():
            return prior
        return np.maximum(prior, self._paint(self._last, prior.shape))

    def _movers(self, now: View, points: NDArray[np.float32], moving: NDArray[np.bool_]) -> Mask:
        """Seeds in former free space, without specks, grown to the objects they are part of."""
        depth_m = points[..., 2]
        still = (depth_m > 0) & ~moving
        sparse = points[2::4, 2::4][still[2::4, 2::4]]
        seeds, static, oldest_static = (np.zeros(depth_m.shape, bool) for _ in range(3))
        for view in self._views_for(now):
            gap = self._gap_to(view, now, points, sparse)
            margin = self._margin(depth_m, gap)
            agrees = np.abs(gap) < margin
            known = np.isfinite(gap) & still
            if (agrees & still).sum() < self._config.min_inliers * known.sum():
                continue
            # What was in its place longer ago did not move in since: that would be misalignment.
            seeds |= (gap > margin) & ~static
            if not static.any():
                oldest_static = agrees
            static |= agrees
        seeds = without_specks(opened(seeds), self._config.min_area)
        if not seeds.any():
            return seeds
        grown = grow(seeds, oldest_static, depth_m, self._config.share)
        if np.count_nonzero(grown) > self._config.max_area * grown.size:
            return np.zeros_like(grown)
        return grown

    def _gap_to(
        self, view: View, now: View, points: NDArray[np.float32], sparse: NDArray[np.float32]
    ) -> NDArray[np.float32]:
        T_ref_camera = align_depth(
            sparse,
            view.inverse_depth,
            se3.inverse(view.T_odom_camera) @ now.T_odom_camera,
            self._config.depth_noise,
        )
        return free_space_gap(points, T_ref_camera, view.free_m, view.inverse_depth.camera)

    def _margin(self, depth_m: DepthImage, gap: NDArray[np.float32]) -> NDArray[np.float32]:
        """The gap that noise explains: both depths are noisy, the farther one more."""
        far = depth_m + np.maximum(np.nan_to_num(gap), 0)
        sigma = self._config.depth_noise * far**2
        return np.asarray(
            np.maximum(self._config.threshold_m, self._config.threshold_sigma * sigma)
        )

    def _way_to(self, T_odom_camera: Pose) -> NDArray[np.float64]:
        if not self._views:
            return np.zeros(2)
        last = self._views[-1]
        step = se3.log(se3.inverse(last.T_odom_camera) @ T_odom_camera)
        step_length = np.array([np.linalg.norm(step[:3]), np.linalg.norm(step[3:])])
        return np.asarray(last.way + step_length)

    def _views_for(self, now: View) -> list[View]:
        """
        Return the view nearest to each lag, oldest first.

        Odometry drifts with the way and not with time, so what was seen before a long way is left
        out; a camera that looks back and forth would else find its old surroundings displaced.
        """
        limit = (self._config.max_move, np.deg2rad(self._config.max_turn_deg))
        near = [v for v in self._views if (now.way - v.way <= limit).all()]
        chosen: dict[int, View] = {}
        for lag in reversed(self._lags_ns):
            if near and now.stamp_ns - near[0].stamp_ns >= 0.7 * lag:
                view = min(near, key=lambda v: abs(now.stamp_ns - v.stamp_ns - lag))
                chosen[view.stamp_ns] = view
        return list(chosen.values())

    def _remember(self, view: View) -> None:
        self._views.append(view)
        while view.stamp_ns - self._views[0].stamp_ns > 1.3 * self._lags_ns[-1]:
            self._views.popleft()

    def _paint(self, mask: Mask, shape: tuple[int, ...]) -> ProbabilityImage:
        value = np.uint8(round(255 * self._config.p_dynamic))
        full = cv2.resize(
            mask.astype(np.uint8) * value, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST
        )
        return np.asarray(full, dtype=np.uint8)


def _shrink(image: NDArray[Any], camera: PinholeCamera) -> NDArray[Any]:
    """Pick pixels; averages would mix depths."""
    size = (camera.width, camera.height)
    return np.asarray(cv2.resize(image, size, interpolation=cv2.INTER_NEAREST_EXACT))


def grow(seeds: Mask, static: Mask, depth_m: DepthImage, share: float, step: float = 0.03) -> Mask:
    """
    Grow seeds to the smooth surfaces of which they are a good share.

    Parameters
    ----------
    seeds : ndarray, shape (h, w), bool
        True where something moved in.
    static : ndarray, shape (h, w), bool
        True where the surface has been in its place for long.
    depth_m : ndarray, shape (h, w), float32
        Metres; 0 where invalid.
    share : float
        Of a surface that must be seed for the whole of it to move; more of it than is static.
    step : float
        Relative change of depth from pixel to pixel that ends a surface.

    """
    high, low = cv2.dilate(depth_m, _KERNEL), cv2.erode(depth_m, _KERNEL)
    smooth = ((low > 0) & (high - low < 2 * step * depth_m)).astype(np.uint8)
    count, labels = cv2.connectedComponents(smooth, connectivity=4)
    area = np.bincount(labels.ravel(), minlength=count)
    hit = np.bincount(labels[seeds], minlength=count)
    stays = np.bincount(labels[static], minlength=count)
    moves = (hit >= share * area) & (hit > stays)
    moves[0] = False
    # Surfaces were cut one pixel inside their edges.
    grown = (moves[labels] | seeds).astype(np.uint8)
    return np.asarray(cv2.dilate(grown, _KERNEL) > 0)
