"""What the inference of beliefs costs: in a run, and with a map of 50,000 Gaussians."""

from __future__ import annotations

import time
from typing import Any

import numpy as np

from bdgs_ros.bench.rasterizer import make_camera, make_scene
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.types import Keyframe, Pose, RgbdFrame
from bdgs_ros.mapping.gaussians import NewGaussians
from bdgs_ros.mapping.mapper import Mapper

_GAUSSIANS = 50_000
_TIMED = 12  # keyframes, after those that fill the memory of views
_PERIOD_NS = 400_000_000
_WIDTH, _HEIGHT = 320, 240
_STEP_M, _STEP_DEG = 0.06, 6.0  # between keyframes: more than tau_r, so that each is kept


def watch_inference(mapper: Any) -> list[float]:
    """Return a list that gets the milliseconds of every inference that the mapper does."""
    times_ms: list[float] = []
    infer = mapper._infer

    def timed(keyframe: Keyframe) -> Any:
        start = time.perf_counter()
        try:
            return infer(keyframe)
        finally:
            times_ms.append(1e3 * (time.perf_counter() - start))

    mapper._infer = timed
    return times_ms


def measure(config: BdgsConfig) -> dict[str, Any]:
    """
    Time inference, filter and multi-view update together, with the memory of views full.

    Returns
    -------
    columns : dict
        `inference_50k_ms`: median per keyframe, 320x240.

    """
    camera = make_camera(_WIDTH, _HEIGHT)
    mapper = _furnished(config, camera)
    views = config.belief.views
    times_ms = watch_inference(mapper)
    for i in range(views + _TIMED):
        pose = _pose(i)
        rendered = mapper.render_everything(pose, camera)
        depth_m = rendered.depth / np.maximum(rendered.silhouette, np.float32(1e-6))
        color = np.clip(rendered.color * 255, 0, 255).astype(np.uint8)
        frame = RgbdFrame(i * _PERIOD_NS, color, depth_m.astype(np.float32), camera)
        mapper._infer(Keyframe(frame, pose, np.zeros(camera.shape, np.uint8)))
    return {
        'cost_gaussians': len(mapper.map),
        'cost_views': views,
        'inference_50k_ms': float(np.median(times_ms[views:])),
    }


def _furnished(config: BdgsConfig, camera: PinholeCamera) -> Mapper:
    """Return a mapper that holds what a camera at the origin sees of a furnished room."""
    scene = make_scene(_GAUSSIANS, camera, np.random.default_rng(0))
    mapper = Mapper(config.mapping, config.belief)
    belief = np.full(len(scene), config.belief.initial, np.float32)
    new = NewGaussians(scene.means, np.exp(scene.log_scales), scene.colors, belief, scene.quats)
    mapper.map.append(new, config.mapping.insert.opacity, 0)
    return mapper


def _pose(index: int) -> Pose:
    """Return T_world_camera: a camera that sways by steps beyond the diversity of views."""
    turn = np.deg2rad(_STEP_DEG) * (index % 4 - 1.5)
    return se3.exp(np.array([_STEP_M * (index % 4 - 1.5), 0, 0, 0, turn, 0]))
