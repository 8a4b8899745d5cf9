"""The text files of a synthetic recording: lists, poses, camera, exposure and objects."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.data.synth.plan import FIRST_STAMP_NS, RecordingPlan
from bdgs_ros.data.synth.scenarios import World
from bdgs_ros.data.synth.scene import SceneObject
from bdgs_ros.data.synth.sensor import DEPTH_SCALE
from bdgs_ros.data.synth.truth import stamp_text


def _pose_row(stamp_ns: int, T: NDArray[np.float64], scale: float = 1.0) -> str:
    position, quat = se3.to_position_quat_xyzw(T)
    return ' '.join([stamp_text(stamp_ns), *(f'{v:.9f}' for v in (*(scale * position), *quat))])


def write_lists(plan: RecordingPlan, world: World, folder: Path, gains: Sequence[float]) -> None:
    """Write the lists of images, the poses, the exposure and the camera."""
    stamps = [plan.stamp_ns(k) for k in range(plan.frames)]
    for kind, title in (('rgb', 'color images'), ('depth', 'depth maps')):
        rows = [f'{stamp_text(s)} {kind}/{stamp_text(s)}.png' for s in stamps]
        _write_text(folder / f'{kind}.txt', [f'# {title}', '# timestamp filename', *rows])
    path = world.camera_path
    poses = [_pose_row(s, path.pose(plan.time_s(k)), plan.scale) for k, s in enumerate(stamps)]
    header = ['# ground truth trajectory', '# timestamp tx ty tz qx qy qz qw']
    for name in ('groundtruth.txt', 'truth/groundtruth.txt'):
        _write_text(folder / name, header + poses)
    rows = [f'{stamp_text(s)} {g:.6f}' for s, g in zip(stamps, gains, strict=True)]
    _write_text(folder / 'truth/exposure.txt', ['# timestamp gain', *rows])
    _write_text(folder / 'camera.yaml', _camera_yaml(plan.camera, DEPTH_SCALE / plan.scale))


def _camera_yaml(camera: PinholeCamera, depth_scale: float) -> list[str]:
    rows = [(key, getattr(camera, key)) for key in ('width', 'height', 'fx', 'fy', 'cx', 'cy')]
    return [
        '# made by bdgs synth',
        'camera:',
        *(f'  {key}: {value!r}' for key, value in rows),
        f'  distortion: {list(camera.distortion)}',
        f'  depth_scale: {depth_scale:g}',
    ]


def _write_text(path: Path, lines: Sequence[str]) -> None:
    path.write_text('\n'.join(lines) + '\n')


def write_objects(plan: RecordingPlan, world: World, folder: Path) -> None:
    """Write `objects.json`: what each object is, when it moves and where it is."""
    content = {
        'scenario': plan.scenario,
        'seed': plan.seed,
        'frames': plan.frames,
        'size': [plan.width, plan.height],
        'rate_hz': plan.rate_hz,
        'objects': [_describe(item, plan) for item in world.scene.objects],
    }
    (folder / 'truth/objects.json').write_text(json.dumps(content, indent=1) + '\n')


def _describe(item: SceneObject, plan: RecordingPlan) -> dict[str, Any]:
    ends = (0.0, plan.frames / plan.rate_hz)  # intervals are half open
    start = FIRST_STAMP_NS * 1e-9
    frames = range(plan.frames) if item.is_mover else ()
    return {
        'id': item.object_id,
        'name': item.name,
        'kind': item.kind,
        'is_mover': item.is_mover,
        'moving_s': [
            [start + float(np.clip(t, *ends)) for t in interval] for interval in item.moving
        ],
        'poses': [
            _pose_row(plan.stamp_ns(k), item.T_world_object(plan.time_s(k)), plan.scale)
            for k in frames
        ],
    }
