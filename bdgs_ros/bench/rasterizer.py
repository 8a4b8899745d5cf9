"""Bench `rasterizer`: milliseconds per view by number of Gaussians, size, threads and backend."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.bench.harness import Cell, Options
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.mapping import rasterize
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.keyframes import MapKeyframe, build_levels
from bdgs_ros.mapping.rasterize import Gaussians, LossWeights, Rendered
from bdgs_ros.mapping.steps import open_steps

NAME = 'rasterizer'
PROTOCOL = """
A camera in a room of 6 x 4 x 2.6 m with boxes; Gaussians lie on the surfaces in view, sigma 0.8
of their spacing, flat, opacity 0.5 to 0.98. Times are medians of at least five calls after one
to warm up: forward (colour, depth, silhouette, posterior), backward (given image gradients),
fused (forward, L1, SSIM and depth loss, backward), and step (one of Eq. 7 as the mapper takes it,
with Adam, exposure and pose; on a card all of it stays there). gradient_error: largest relative
difference (2-norm, over means, quats, scales, opacities, colours, pose) to the float64 torch twin,
1500 Gaussians at 64x48.
"""

_COUNTS = (20_000, 50_000, 200_000, 500_000)
_SIZES = ((320, 240), (640, 480), (1280, 720))
_THREADS = (1, 2)
_TWIN_LIMIT = 20_000 * 320 * 240  # the twin takes seconds beyond this
_BUDGET_S = 0.5
_MIN_CALLS = 5
_STEPS = 5  # between two readings of the clock, as between two of the losses
_ROOM = np.array([[-3.0, -1.3, -1.0], [3.0, 1.3, 3.0]])  # corners; the camera is at the origin
_FIELDS = ('means', 'quats', 'log_scales', 'logit_opacities', 'colors', 'pose')
_WEIGHTS = LossWeights(color=0.85, ssim=0.2, depth=0.2)


def cells(options: Options) -> list[Cell]:
    """List every size for the card and the fastest native backend, small ones for the twin."""
    counts = (2_000,) if options.quick else _COUNTS
    sizes = ((160, 120),) if options.quick else _SIZES
    available = rasterize.available_backends()
    native = [name for name in available if name not in ('cuda', 'torch')][:1]
    card = [name for name in available if name == 'cuda']
    found = []
    for width, height in sizes:
        for count in counts:
            scene = {'gaussians': count, 'width': width, 'height': height}
            name = f'{count}_{width}x{height}'
            for backend in (*card, *native, 'torch'):
                if backend == 'torch' and count * width * height > _TWIN_LIMIT:
                    continue
                for threads in _THREADS if backend in native else (1,):
                    settings = {**scene, 'backend': backend, 'threads': threads}
                    found.append(Cell(name, f'{backend}_{threads}', 0, settings))
    return found


def run_cell(cell: Cell, options: Options) -> dict[str, Any]:
    """Time one backend on one scene."""
    how = {'backend': cell.settings['backend'], 'threads': cell.settings['threads']}
    camera = make_camera(cell.settings['width'], cell.settings['height'])
    scene = make_scene(cell.settings['gaussians'], camera, np.random.default_rng(cell.seed))
    pose = np.eye(4)
    target = rasterize.render(scene, pose, camera, **how)
    ones = np.ones(camera.shape, np.float32)
    color = np.clip(target.color + 0.05, 0, 1)
    gradients = np.sign(target.color - color), 0.1 * ones, 0.0 * ones

    return {
        **{k: v for k, v in cell.settings.items() if k != 'backend'},
        'backend': how['backend'],
        'forward_ms': _time(lambda: rasterize.render(scene, pose, camera, **how)),
        'backward_ms': _time(
            lambda: rasterize.backward(scene, pose, camera, *gradients, **how),
        ),
        'fused_ms': _time(
            lambda: rasterize.fused_step(
                scene, pose, camera, color, target.depth * 1.01, ones, _WEIGHTS, **how
            )
        ),
        'step_ms': _time(_steps(scene, target, camera, how)) / _STEPS,
        'gradient_error': gradient_error(how['backend'], how['threads']),
    }


def _steps(
    scene: Gaussians, target: Rendered, camera: PinholeCamera, how: dict[str, Any]
) -> Callable[[], None]:
    """Return some steps of the map's optimisation, with rates that leave the scene as it is."""
    new = NewGaussians(
        scene.means, np.exp(scene.log_scales), scene.colors, scene.p_dynamic, scene.quats
    )
    gaussians = GaussianMap(BeliefConfig())
    gaussians.append(new, 0.5, 0)
    gaussians.parameters['logit_opacities'] = scene.logit_opacities
    gaussians.belief.hidden[:] = False
    image = np.clip(255 * target.color + 12, 0, 255).astype(np.uint8)
    nothing = np.zeros(camera.shape, np.uint8)
    levels = build_levels(image, target.depth * np.float32(1.01), nothing > 0, camera, 1)
    keyframe = MapKeyframe(1, 0, np.eye(4), nothing, levels)
    config = replace(MappingConfig(), backend=how['backend'], threads=how['threads'])
    steps = open_steps(config)
    steps.begin(gaussians, [keyframe])

    def run() -> None:
        for _ in range(_STEPS):
            steps.take(keyframe, 0, None, rate_scale=0.0, pose_scale=0.0)
        steps.losses()

    return run


def summarise(rows: Sequence[Mapping[str, Any]]) -> dict[str, Any]:
    """Return the figures of the goal (50k Gaussians, 320x240) and the largest gradient error."""
    summary: dict[str, Any] = {}
    for row in rows:
        size = row['gaussians'], row['width'], row['height']
        if size == (50_000, 320, 240) and row['backend'] != 'torch':
            for what in ('fused', 'step'):
                name = f'{what}_ms_50k_320x240_{row["threads"]}_threads'
                suffix = '_cuda' if row['backend'] == 'cuda' else ''
                summary[name + suffix] = row.get(f'{what}_ms')
    errors = [row['gradient_error'] for row in rows if row['gradient_error'] is not None]
    if errors:
        summary['gradient_error_max'] = max(errors)
    return summary


def make_camera(width: int, height: int) -> PinholeCamera:
    """Return a camera with the field of view of a Kinect."""
    focal = 525.0 * width / 640.0
    return PinholeCamera(width, height, focal, focal, (width - 1) / 2, (height - 1) / 2)


def make_scene(count: int, camera: PinholeCamera, rng: np.random.Generator) -> Gaussians:
    """
    Put Gaussians on what a camera at the origin sees of a furnished room.

    Parameters
    ----------
    count : int
        N.
    camera : PinholeCamera
        Looks along z.
    rng : Generator
        Chooses pixels, boxes, sizes and colours.

    """
    u = rng.uniform(0, camera.width - 1, count)
    v = rng.uniform(0, camera.height - 1, count)
    rays = np.stack(
        [(u - camera.cx) / camera.fx, (v - camera.cy) / camera.fy, np.ones(count)], axis=1
    )
    z = _first_hit(rays, rng)
    spacing = z / camera.fx * np.sqrt(camera.width * camera.height / count)
    scales = 0.8 * spacing[:, None] * rng.uniform(0.7, 1.3, (count, 3))
    scales[:, 2] *= 0.2
    opacity = rng.uniform(0.5, 0.98, count)
    single = np.float32
    return Gaussians(
        means=(rays * z[:, None]).astype(single),
        quats=rng.normal(size=(count, 4)).astype(single),
        log_scales=np.log(scales).astype(single),
        logit_opacities=np.log(opacity / (1 - opacity)).astype(single),
        colors=rng.uniform(0, 1, (count, 3)).astype(single),
        p_dynamic=rng.uniform(0, 1, count).astype(single),
    )


def _first_hit(rays: NDArray[np.float64], rng: np.random.Generator) -> NDArray[np.float64]:
    """Return the depth at which rays from the origin leave the room or meet a box."""
    with np.errstate(divide='ignore'):
        z = np.max(_ROOM[:, None] / rays, axis=0).min(axis=1)
        for _ in range(6):
            corner = rng.uniform([-1.5, 0.0, 1.2], [1.2, 0.8, 2.4])
            box = np.stack([corner, corner + rng.uniform(0.2, 0.7, 3)])
            slabs = box[:, None] / rays
            near, far = slabs.min(axis=0).max(axis=1), slabs.max(axis=0).min(axis=1)
            z = np.where((near < far) & (near > 0), np.minimum(z, near), z)
    return np.asarray(z)


def _time(call: Callable[[], Any]) -> float:
    """Return the median milliseconds of a call."""
    start = time.perf_counter()
    call()
    slow = time.perf_counter() - start > _BUDGET_S
    times: list[float] = []
    while len(times) < (1 if slow else _MIN_CALLS) or (sum(times) < _BUDGET_S and not slow):
        start = time.perf_counter()
        call()
        times.append(time.perf_counter() - start)
    return 1e3 * float(np.median(times))


def gradient_error(backend: str, threads: int = 1) -> float | None:
    """Return the largest relative difference of any gradient to the torch twin's; None for it."""
    if backend == 'torch':
        return None
    camera = make_camera(64, 48)
    rng = np.random.default_rng(1)
    scene = make_scene(1500, camera, rng)
    images = [rng.normal(size=(*camera.shape, 3)), *rng.normal(size=(2, *camera.shape))]
    pose = np.eye(4)
    ours, twin = (
        rasterize.backward(scene, pose, camera, *images, backend=name, threads=threads)
        for name in (backend, 'torch')
    )
    return max(_difference(getattr(ours, name), getattr(twin, name)) for name in _FIELDS)


def _difference(ours: NDArray[Any], twin: NDArray[Any]) -> float:
    apart = float(np.linalg.norm(ours.astype(np.float64) - twin.astype(np.float64)))
    return apart / max(float(np.linalg.norm(twin)), 1e-30)
