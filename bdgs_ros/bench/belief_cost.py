"""What the inference of beliefs costs: in a run, and with a map of 50,000 Gaussians."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from typing import Any

import numpy as np

from bdgs_ros.bench.rasterizer import make_camera, make_scene
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.core.types import Keyframe, Pose, RgbdFrame
from bdgs_ros.mapping.gaussians import NewGaussians
from bdgs_ros.mapping.mapper import Mapper

_GAUSSIANS = 44_000  # those that come make them 50,000
_TIMED = 12  # keyframes, after those that fill the memory of views
_PERIOD_NS = 400_000_000
_WIDTH, _HEIGHT = 320, 240
_STEP_M, _STEP_DEG = 0.06, 6.0  # between keyframes: more than tau_r, so that each is kept


def watch_inference(mapper: Any) -> list[float]:
    """Return a list that gets the milliseconds that each keyframe's inference takes."""
    times_ms: list[float] = []
    inference = mapper.inference
    observe, ask_memory = inference.observe, inference.ask_memory

    def timed_observe(*arguments: Any) -> Any:
        times_ms.append(0.0)  # a keyframe begins
        return _add_time(times_ms, observe, arguments)

    def timed_ask(*arguments: Any) -> Any:
        return _add_time(times_ms, ask_memory, arguments)

    inference.observe, inference.ask_memory = timed_observe, timed_ask
    return times_ms


def _add_time(times_ms: list[float], call: Callable[..., Any], arguments: Sequence[Any]) -> Any:
    start = time.perf_counter()
    try:
        return call(*arguments)
    finally:
        times_ms[-1] += 1e3 * (time.perf_counter() - start)


def measure(config: BdgsConfig) -> dict[str, Any]:
    """
    Time inference, filter and multi-view update together, with the memory of views full.

    Keyframes go through the whole mapper but for its optimisation. The camera goes on seeing the
    same room, a little of it for the first time.

    Returns
    -------
    columns : dict
        `inference_50k_ms`: median per keyframe, 320x240.

    """
    camera = make_camera(_WIDTH, _HEIGHT)
    mapper = _furnished(with_values(config, {'mapping.iterations': 0}), camera)
    views = config.belief.views
    times_ms = watch_inference(mapper)
    counts = []
    for i in range(views + _TIMED):
        counts.append(len(mapper.map))
        mapper.process(_keyframe(mapper, i, camera))
    return {
        'cost_gaussians': round(float(np.median(counts[views:]))),
        'cost_views': views,
        'inference_50k_ms': float(np.median(times_ms[views:])),
    }


def _keyframe(mapper: Mapper, index: int, camera: PinholeCamera) -> Keyframe:
    """Return what the camera would see if the map were the world."""
    pose = _pose(index)
    rendered = mapper.render_everything(pose, camera)
    depth_m = rendered.depth / np.maximum(rendered.silhouette, np.float32(1e-6))
    color = np.clip(rendered.color * 255, 0, 255).astype(np.uint8)
    frame = RgbdFrame(index * _PERIOD_NS, color, depth_m.astype(np.float32), camera)
    return Keyframe(frame, pose, np.zeros(camera.shape, np.uint8))


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
