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

import logging
from collections import deque
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.detection import GeometricConfig
from bdgs_ros.core.types import DepthImage, Pose, ProbabilityImage, RgbdFrame
from bdgs_ros.detection.ego_motion import EgoMotion

_LOG = logging.getLogger(__name__)

Mask = NDArray[np.uint8]  # 0 or 1
_SECOND_NS = 1_000_000_000
_KERNEL = np.ones((3, 3), np.uint8)


@dataclass(frozen=True)
class View:
    """What an earlier frame saw, at the resolution of the comparison."""

    stamp_ns: int
    T_odom_camera: Pose
    free_m: DepthImage
    """Shape (h, w): how far each viewing ray was certainly free; 0 = unknown."""


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
        self._disbelieved = 0

    def reset(self) -> None:
        """Forget all earlier frames."""
        self._views.clear()
        self._ego.reset()
        self._last = None

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
        moving = self._with_last(prior)
        ego = self._ego.update(frame, moving)
        camera = frame.camera.scaled(self._config.width / frame.camera.width)
        depth_m = cv2.resize(
            frame.depth_m, (camera.width, camera.height), interpolation=cv2.INTER_NEAREST
        )
        if ego is None:
            self._views.clear()
            self._last = None
            return np.zeros(frame.depth_m.shape, np.uint8)
        mask = self._movers(frame.stamp_ns, np.asarray(depth_m), ego, camera)
        self._remember(View(frame.stamp_ns, ego, free_depth(np.asarray(depth_m), 2)))
        self._last = mask
        return self._paint(mask, frame.depth_m.shape)

    def _with_last(self, prior: ProbabilityImage) -> ProbabilityImage:
        if self._last is None or not self._last.any():
            return prior
        return np.maximum(prior, self._paint(self._last, prior.shape))

    def _movers(
        self, stamp_ns: int, depth_m: DepthImage, T_odom_camera: Pose, camera: PinholeCamera
    ) -> Mask:
        """Seeds in former free space, without specks, grown to the objects they are part of."""
        points = camera.unproject(depth_m)
        seeds = np.zeros(depth_m.shape, np.uint8)
        static = np.zeros(depth_m.shape, np.uint8)
        for view in self._views_at(stamp_ns):
            T_ref_camera = se3.inverse(view.T_odom_camera) @ T_odom_camera
            gap = free_space_gap(points, T_ref_camera, view.free_m, camera)
            margin = self._margin(depth_m, gap)
            agrees = (np.abs(gap) < margin).astype(np.uint8)
            known = np.count_nonzero(np.isfinite(gap))
            if np.count_nonzero(agrees) < self._config.min_inliers * known:
                self._disbelieved += 1
                continue
            np.maximum(seeds, (gap > margin).astype(np.uint8), out=seeds)
            static = agrees  # the oldest frame comes last and has the last word
        seeds = cv2.morphologyEx(seeds, cv2.MORPH_OPEN, _KERNEL)
        seeds = drop_small(seeds, self._config.min_area * seeds.size)
        if not seeds.any():
            return seeds
        grown = grow(seeds, static, depth_m, self._config.share)
        if np.count_nonzero(grown) > self._config.max_area * grown.size:
            return np.zeros_like(grown)
        return grown

    def _margin(self, depth_m: DepthImage, gap: NDArray[np.float32]) -> NDArray[np.float32]:
        """The gap that noise explains: both depths are noisy, the farther one more."""
        far = depth_m + np.maximum(np.nan_to_num(gap), 0)
        sigma = self._config.depth_noise * far**2
        return np.maximum(self._config.threshold_m, self._config.threshold_sigma * sigma)

    def _views_at(self, stamp_ns: int) -> list[View]:
        """Return the view nearest to each lag, without duplicates and without very recent ones."""
        chosen: dict[int, View] = {}
        for lag in self._lags_ns:
            if not self._views or stamp_ns - self._views[0].stamp_ns < 0.7 * lag:
                continue
            view = min(self._views, key=lambda v: abs(stamp_ns - v.stamp_ns - lag))
            chosen[view.stamp_ns] = view
        return list(chosen.values())

    def _remember(self, view: View) -> None:
        self._views.append(view)
        while view.stamp_ns - self._views[0].stamp_ns > 1.3 * self._lags_ns[-1]:
            self._views.popleft()

    def _paint(self, mask: Mask, shape: tuple[int, ...]) -> ProbabilityImage:
        value = np.uint8(round(255 * self._config.p_dynamic))
        full = cv2.resize(mask * value, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)
        return np.asarray(full, dtype=np.uint8)


def drop_small(mask: Mask, min_pixels: float) -> Mask:
    """Drop the connected regions of fewer pixels."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask, connectivity=8)
    if count <= 1:
        return np.asarray(mask, dtype=np.uint8)
    keep = stats[:, cv2.CC_STAT_AREA] >= min_pixels
    keep[0] = False
    return np.asarray(keep[labels], dtype=np.uint8)


def grow(
    seeds: Mask, static: Mask, depth_m: DepthImage, share: float, step: float = 0.03
) -> Mask:
    """
    Grow seeds to the smooth surfaces of which they are a good share.

    Parameters
    ----------
    seeds : ndarray, shape (h, w), uint8
        1 where something moved in.
    static : ndarray, shape (h, w), uint8
        1 where the surface has been in its place for long.
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
    hit = np.bincount(labels[seeds > 0], minlength=count)
    stays = np.bincount(labels[static > 0], minlength=count)
    moves = (hit >= share * area) & (hit > stays)
    moves[0] = False
    # Surfaces were cut one pixel inside their edges.
    grown = np.asarray(moves[labels], dtype=np.uint8) | seeds
    return np.asarray(cv2.dilate(grown, _KERNEL), dtype=np.uint8)
