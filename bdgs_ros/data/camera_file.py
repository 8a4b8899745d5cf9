"""The file `camera.yaml` that describes the camera of a recording."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from bdgs_ros.core.camera import DISTORTIONS, PLUMB_BOB, PinholeCamera
from bdgs_ros.core.errors import DatasetError

CAMERA_FILE = 'camera.yaml'
_REQUIRED = ('width', 'height', 'fx', 'fy', 'cx', 'cy')
_OPTIONAL = ('distortion', 'distortion_model', 'depth_scale')
_EXAMPLE = (
    'camera: {width: 640, height: 480, fx: 525.0, fy: 525.0, cx: 319.5, cy: 239.5, '
    'distortion: [0, 0, 0, 0, 0], depth_scale: 5000}'
)


@dataclass(frozen=True)
class RecordedCamera:
    """A camera as recorded, and how its depth images count."""

    camera: PinholeCamera
    depth_scale: float | None = None
    """
    Depth image units in a metre; by default what is usual for the layout: 5000 for TUM and BONN
    folders, 1000 (millimetres) for bags.
    """


def read_camera_file(path: Path) -> RecordedCamera:
    """
    Read a camera file.

    Raises
    ------
    DatasetError
        If it is missing, not yaml, lacks a key, has an unknown one, or makes no sense.

    """
    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, UnicodeDecodeError, yaml.YAMLError) as error:
        raise DatasetError(f"cannot read the camera file '{path}': {error}") from error
    section = content.get('camera') if isinstance(content, dict) else None
    if not isinstance(section, dict):
        raise DatasetError(f"'{path}' has no section 'camera'; expected for example\n  {_EXAMPLE}")
    return _from_section(path, section)


def _from_section(path: Path, section: Mapping[str, Any]) -> RecordedCamera:
    missing = [key for key in _REQUIRED if key not in section]
    unknown = [key for key in section if key not in _REQUIRED + _OPTIONAL]
    if missing or unknown:
        raise DatasetError(
            f"'{path}': missing keys {missing}, unknown keys {unknown}; expected\n  {_EXAMPLE}"
        )
    try:
        distortion = tuple(float(k) for k in section.get('distortion', (0, 0, 0, 0, 0)))
        model = str(section.get('distortion_model', PLUMB_BOB))
        fx, fy, cx, cy = (float(section[key]) for key in ('fx', 'fy', 'cx', 'cy'))
        width, height = int(section['width']), int(section['height'])
        camera = PinholeCamera(width, height, fx, fy, cx, cy, distortion, model)
        scale = section.get('depth_scale')
        recorded = RecordedCamera(camera, None if scale is None else float(scale))
    except (TypeError, ValueError) as error:
        raise DatasetError(f"'{path}': {error}; expected for example\n  {_EXAMPLE}") from error
    _check(path, recorded)
    return recorded


def _check(path: Path, recorded: RecordedCamera) -> None:
    camera = recorded.camera
    allowed = DISTORTIONS.get(camera.distortion_model, ())
    if len(camera.distortion) not in allowed:
        models = ', '.join(f'{name} with {counts}' for name, counts in DISTORTIONS.items())
        raise DatasetError(
            f"'{path}': distortion_model '{camera.distortion_model}' with "
            f'{len(camera.distortion)} coefficients; expected one of {models}'
        )
    scale = 1.0 if recorded.depth_scale is None else recorded.depth_scale
    positive = (camera.width, camera.height, camera.fx, camera.fy, scale)
    finite = (*positive, camera.cx, camera.cy, *camera.distortion)
    if min(positive) <= 0 or not np.isfinite(finite).all():
        raise DatasetError(
            f"'{path}': size, focal lengths and depth_scale must be above 0 and all finite, "
            f'received {camera}, depth_scale {recorded.depth_scale}'
        )
