"""
Keyframes as a folder, so that a map can be refined or continued after its run.

The layout is a nerfstudio dataset, which other trainers read too: `transforms.json` with pose and
intrinsics of every frame, and below it `images/` (8-bit RGB), `depth/` (16-bit, millimetres),
`masks/` (8-bit, 0 = not to be used: something moved there). Poses are camera to world with the
camera of OpenGL (x right, y up, z backward); (0, 0) is the corner of the top left pixel there, so
`cx` and `cy` are half a pixel more than ours. What only we need has names of its own: `stamp_ns`,
`keyframe_index`, `exposure` (log gain, offset) and `dynamic_file_path` (P(dynamic) x 255).
"""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import MapError
from bdgs_ros.core.types import DepthImage, Pose
from bdgs_ros.mapping.depth_bend import DepthBend
from bdgs_ros.mapping.history import History
from bdgs_ros.mapping.keyframes import MapKeyframe, build_levels
from bdgs_ros.mapping.vignette import Vignette

TRANSFORMS = 'transforms.json'
_FORMAT = 1
_TO_OPENGL = np.diag([1.0, -1.0, -1.0, 1.0])
_PIXEL_CORNER = 0.5
_MM_PER_M = 1000.0
_MAX_MM = 65535
_KINDS = {
    'file_path': 'images',
    'depth_file_path': 'depth',
    'mask_path': 'masks',
    'dynamic_file_path': 'dynamic',
}


@dataclass(frozen=True)
class KeyframeSet:
    """The keyframes that belong to a map."""

    keyframes: Sequence[MapKeyframe] = ()
    """Those whose images are kept."""
    history: History = field(default_factory=History)
    """Of all that ever were."""
    vignette: Vignette = field(default_factory=Vignette)
    """Of the camera, as far as it was found out."""
    depth_bend: DepthBend = field(default_factory=DepthBend)
    """Of the depth sensor; the depth of the keyframes is without it."""
    next_index: int = 0
    readout_s: float | None = None
    """Of the camera's rolling shutter; the images of the keyframes are without it."""
    index_of: Mapping[int, int] = field(default_factory=dict)
    """By stamp, of all keyframes of the run: Gaussians know which one brought them."""


def write_keyframes(folder: Path, kept: KeyframeSet, gaussians: int) -> None:
    """
    Write keyframes into an empty folder.

    Parameters
    ----------
    folder : Path
        Exists and is empty.
    kept : KeyframeSet
        What to write.
    gaussians : int
        Size of the map they belong to, by which a wrong pair is recognised.

    Raises
    ------
    OSError
        If something cannot be written.

    """
    for keyframe in kept.keyframes:
        write_images(folder, images_of(keyframe))
    document = document_of(kept, gaussians)
    (folder / TRANSFORMS).write_text(json.dumps(document, indent=1) + '\n', encoding='utf-8')


def document_of(kept: KeyframeSet, gaussians: int) -> dict[str, Any]:
    """Return what `transforms.json` says; see `write_keyframes`."""
    return {
        'camera_model': 'OPENCV',  # of the names for a pinhole the one that all readers know
        'depth_unit_scale_factor': 1 / _MM_PER_M,
        'ply_file_path': 'points.ply',
        'bdgs': {
            'format': _FORMAT,
            'gaussians': gaussians,
            'next_index': kept.next_index,
            'history': kept.history.to_document(),
            'vignette': list(kept.vignette.coefficients),
            'depth_bend': list(kept.depth_bend.coefficients),
            'readout_s': kept.readout_s,
            'index_of': {str(stamp_ns): index for stamp_ns, index in kept.index_of.items()},
        },
        'frames': [_frame_of(keyframe) for keyframe in kept.keyframes],
    }


def images_of(keyframe: MapKeyframe) -> dict[str, NDArray[Any]]:
    """Return the images of a keyframe as they are stored, by their paths in the folder."""
    finest = keyframe.levels[0]
    images: dict[str, NDArray[Any]] = {
        'file_path': finest.image[..., ::-1],
        'depth_file_path': _to_millimetres(finest.depth_m),
        'mask_path': np.where(finest.static, 255, 0).astype(np.uint8),
        'dynamic_file_path': keyframe.p_dynamic,
    }
    paths = _paths(keyframe)
    return {paths[key]: image for key, image in images.items()}


def write_images(folder: Path, images: Mapping[str, NDArray[Any]]) -> None:
    """Write images by their paths in a folder; `OSError` if one cannot be written."""
    for name, image in images.items():
        path = folder / name
        path.parent.mkdir(exist_ok=True)
        _write_png(path, image)


def _paths(keyframe: MapKeyframe) -> dict[str, str]:
    return {key: f'{kind}/{keyframe.index:06d}.png' for key, kind in _KINDS.items()}


def _frame_of(keyframe: MapKeyframe) -> dict[str, Any]:
    return {
        **_paths(keyframe),
        **_intrinsics(keyframe.levels[0].camera),
        'transform_matrix': (keyframe.T_world_camera @ _TO_OPENGL).tolist(),
        'stamp_ns': int(keyframe.stamp_ns),
        'keyframe_index': int(keyframe.index),
        'exposure': [float(value) for value in keyframe.exposure],
        'depth_bend': list(keyframe.depth_bend),
    }


def _to_millimetres(depth_m: DepthImage) -> NDArray[np.uint16]:
    """Return depth in millimetres; what 16 bits cannot hold is invalid."""
    millimetres = np.rint(np.nan_to_num(depth_m, posinf=0.0) * _MM_PER_M)
    valid = (millimetres > 0) & (millimetres <= _MAX_MM)
    return np.where(valid, millimetres, 0).astype(np.uint16)


def _write_png(path: Path, image: NDArray[Any]) -> None:
    written, data = cv2.imencode('.png', np.ascontiguousarray(image))
    if not written:
        raise OSError(f"'{path.name}': image of shape {image.shape} cannot be encoded")
    path.write_bytes(data.tobytes())


def _intrinsics(camera: PinholeCamera) -> dict[str, float]:
    return {
        'w': camera.width,
        'h': camera.height,
        'fl_x': camera.fx,
        'fl_y': camera.fy,
        'cx': camera.cx + _PIXEL_CORNER,
        'cy': camera.cy + _PIXEL_CORNER,
    }


def gaussians_of(folder: Path) -> int | None:
    """Return the size of the map that a folder of keyframes belongs to; None if any will do."""
    count = _read_document(folder)['bdgs'].get('gaussians')
    if count is not None and not isinstance(count, int):
        raise MapError(
            f"'{folder / TRANSFORMS}' is damaged: expected a count of Gaussians, found {count!r}; "
            f"remove '{folder}' to use the map without its keyframes"
        )
    return count


def read_keyframes(folder: Path, levels: int) -> KeyframeSet:
    """
    Read what `write_keyframes` wrote.

    Parameters
    ----------
    folder : Path
        With `transforms.json`.
    levels : int
        Of the pyramid of Eq. 12 that is built for each keyframe.

    Raises
    ------
    MapError
        If the folder was not written by us, or a file of it is missing or does not fit.

    """
    return keyframes_from(_read_document(folder), folder, levels)


def keyframes_from(document: Mapping[str, Any], folder: Path, levels: int) -> KeyframeSet:
    """Return the keyframes that a document names, with their images; see `read_keyframes`."""
    own = document['bdgs']
    try:
        vignette = Vignette(*map(float, own['vignette']))
        depth_bend = DepthBend(own.get('depth_bend', ()))
        entries = document['frames']
        keyframes = [_read_frame(folder, entry, levels, vignette) for entry in entries]
        history = History.from_document(own['history'])
        for keyframe, entry in zip(keyframes, entries, strict=True):
            held = entry.get('depth_bend', depth_bend.coefficients)
            keyframe.depth_bend = tuple(map(float, held))
        next_index = int(own['next_index'])
        index_of = {int(s): int(index) for s, index in own.get('index_of', {}).items()}
        readout = own.get('readout_s')
        readout_s = None if readout is None else float(readout)
    except (AttributeError, KeyError, TypeError, ValueError) as error:
        raise MapError(
            f"'{folder / TRANSFORMS}' is damaged: {type(error).__name__} {error}; "
            f"remove '{folder}' to use the map without its keyframes"
        ) from error
    newest = max((keyframe.index for keyframe in keyframes), default=-1)
    count = max(next_index, newest + 1)
    return KeyframeSet(keyframes, history, vignette, depth_bend, count, readout_s, index_of)


def _read_document(folder: Path) -> dict[str, Any]:
    path = folder / TRANSFORMS
    advice = f"remove '{folder}' to use the map without its keyframes"
    try:
        document = json.loads(path.read_text(encoding='utf-8'))
    except OSError as error:
        raise MapError(f"'{path}' cannot be read: {error.strerror}; {advice}") from error
    except ValueError as error:
        raise MapError(f"'{path}' is not JSON: {error}; {advice}") from error
    own = document.get('bdgs') if isinstance(document, dict) else None
    if not isinstance(own, dict) or own.get('format') != _FORMAT:
        raise MapError(
            f"'{path}' has no entry 'bdgs' of format {_FORMAT}: it is a dataset of another "
            f'program or version; {advice}'
        )
    return dict(document)


def _read_frame(
    folder: Path, entry: Mapping[str, Any], levels: int, vignette: Vignette
) -> MapKeyframe:
    camera = PinholeCamera(
        int(entry['w']),
        int(entry['h']),
        float(entry['fl_x']),
        float(entry['fl_y']),
        float(entry['cx']) - _PIXEL_CORNER,
        float(entry['cy']) - _PIXEL_CORNER,
    )
    read = _reader(folder, camera.shape)
    color = np.ascontiguousarray(read(entry['file_path'], np.uint8, 3)[..., ::-1])
    depth = read(entry['depth_file_path'], np.uint16, 1)
    usable = read(entry['mask_path'], np.uint8, 1) > 0
    depth_m = depth.astype(np.float32) / np.float32(_MM_PER_M)
    exposure = np.array(entry['exposure'], np.float32).reshape(2)
    return MapKeyframe(
        int(entry['keyframe_index']),
        int(entry['stamp_ns']),
        _pose(entry['transform_matrix']),
        read(entry['dynamic_file_path'], np.uint8, 1),
        build_levels(color, depth_m, ~usable, camera, levels, vignette),
        exposure,
    )


def _pose(rows: Any) -> Pose:
    T_world_camera = np.array(rows, np.float64).reshape(4, 4) @ _TO_OPENGL
    rotation = T_world_camera[:3, :3]
    if not np.allclose(rotation @ rotation.T, np.eye(3), atol=1e-4):
        raise ValueError(f'transform_matrix {rows} is no rigid motion')
    return T_world_camera


def _reader(folder: Path, shape: tuple[int, int]) -> Callable[..., NDArray[Any]]:
    def read(name: str, dtype: type, channels: int) -> NDArray[Any]:
        path = folder / name
        try:
            data = np.frombuffer(path.read_bytes(), np.uint8)
        except OSError as error:
            raise MapError(
                f"keyframe image '{path}' cannot be read: {error.strerror}; "
                f"remove '{folder}' to use the map without its keyframes"
            ) from error
        image = cv2.imdecode(data, cv2.IMREAD_UNCHANGED) if len(data) else None
        expected = (*shape, channels) if channels > 1 else shape
        if image is None or image.shape != expected or image.dtype != dtype:
            found = 'no image' if image is None else f'{image.dtype} {image.shape}'
            raise MapError(
                f"keyframe image '{path}': expected {np.dtype(dtype)} {expected}, found {found}; "
                f"remove '{folder}' to use the map without its keyframes"
            )
        return np.asarray(image)

    return read
