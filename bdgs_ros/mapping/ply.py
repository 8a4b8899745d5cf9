"""
Maps as files: the standard 3DGS .ply, with the filter's state as further properties.

Layout of the reference implementation (Kerbl et al. 2023) with spherical harmonics of degree 0:
`x y z nx ny nz f_dc_0..2 opacity scale_0..2 rot_0..3`, all float32, opacity as logit, scale as
natural logarithm, rot wxyz. Viewers that read by name ignore what follows them.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.errors import MapError
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians

SH_C0 = 0.28209479177387814
STANDARD = (
    *('x', 'y', 'z', 'nx', 'ny', 'nz', 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity'),
    *('scale_0', 'scale_1', 'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3'),
)
STATE = ('p_dynamic', 'p_dynamic_smoothed', 'keyframe_index', 'observations')


def save_ply(path: Path, gaussians: GaussianMap) -> None:
    """
    Write the map; aside first, then renamed, so an old file stays whole if this fails.

    Raises
    ------
    MapError
        If the file cannot be written.

    """
    data = _to_table(gaussians).astype('<f4').tobytes()
    properties = ''.join(f'property float {name}\n' for name in STANDARD + STATE)
    header = (
        'ply\nformat binary_little_endian 1.0\n'
        f'element vertex {len(gaussians)}\n{properties}end_header\n'
    )
    aside = path.with_name(path.name + '.part')
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        aside.write_bytes(header.encode('ascii') + data)
        os.replace(aside, path)  # noqa: PTH105 - atomic on one file system
    except OSError as error:
        aside.unlink(missing_ok=True)
        raise MapError(f"map not saved to '{path}': {error.strerror}") from error


def _to_table(gaussians: GaussianMap) -> NDArray[np.float32]:
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    columns = [
        gaussians.means,
        np.zeros_like(gaussians.means),
        (gaussians.colors - 0.5) / SH_C0,
        gaussians.logit_opacities[:, None],
        gaussians.log_scales,
        quats,
        gaussians.belief.belief[:, None],
        gaussians.belief.smoothed[:, None],
        gaussians.keyframe_index[:, None],
        gaussians.observations[:, None],
    ]
    return np.concatenate(columns, axis=1, dtype=np.float32)


def load_ply(path: Path, config: BeliefConfig) -> GaussianMap:
    """
    Read a map, ours or any 3DGS .ply; without filter state every Gaussian starts as static.

    Raises
    ------
    MapError
        If the file is missing, not a binary little-endian .ply of float properties, lacks one of
        the standard properties, or is shorter than its header says.

    """
    names, table = _read_table(path)
    missing = [n for n in STANDARD if n not in names and n not in ('nx', 'ny', 'nz')]
    if missing:
        raise MapError(f"'{path}' is no 3DGS map: it lacks the properties {', '.join(missing)}")
    column = {name: table[:, i] for i, name in enumerate(names)}
    return _from_columns(column, len(table), config)


def _from_columns(
    column: dict[str, NDArray[np.float32]], count: int, config: BeliefConfig
) -> GaussianMap:
    def block(*names: str) -> NDArray[np.float32]:
        return np.ascontiguousarray(np.stack([column[n] for n in names], axis=1))

    static = np.full(count, 0.1, np.float32)
    belief = column.get('p_dynamic', static)
    gaussians = GaussianMap(config)
    colors = block('f_dc_0', 'f_dc_1', 'f_dc_2') * np.float32(SH_C0) + np.float32(0.5)
    ones = np.ones(count, np.float32)
    gaussians.append(NewGaussians(block('x', 'y', 'z'), ones, colors, belief), 0.5, 0)
    gaussians.parameters['quats'] = block('rot_0', 'rot_1', 'rot_2', 'rot_3')
    gaussians.parameters['log_scales'] = block('scale_0', 'scale_1', 'scale_2')
    gaussians.parameters['logit_opacities'] = np.ascontiguousarray(column['opacity'])
    gaussians.belief.smoothed = column.get('p_dynamic_smoothed', belief).copy()
    zero = np.zeros(count, np.float32)
    gaussians.keyframe_index = column.get('keyframe_index', zero).astype(np.int32)
    gaussians.observations = column.get('observations', zero).astype(np.int32)
    return gaussians


def _read_table(path: Path) -> tuple[list[str], NDArray[np.float32]]:
    try:
        content = path.read_bytes()
    except OSError as error:
        raise MapError(f"map '{path}' cannot be read: {error.strerror}") from error
    head, mark, body = content.partition(b'end_header\n')
    lines = head.decode('ascii', errors='replace').split('\n')
    if not mark or lines[0] != 'ply' or 'format binary_little_endian 1.0' not in lines:
        raise MapError(f"'{path}' is not a binary little-endian .ply file")
    count = next((int(w[2]) for w in map(str.split, lines) if w[:2] == ['element', 'vertex']), 0)
    properties = [line.split() for line in lines if line.startswith('property')]
    if any(len(p) != 3 or p[1] not in ('float', 'float32') for p in properties):
        raise MapError(f"'{path}': every property of a 3DGS map is a float; these are not")
    expected = 4 * count * len(properties)
    if len(body) < expected:
        raise MapError(
            f"'{path}' is truncated: {count} Gaussians need {expected} bytes, "
            f'{len(body)} are there'
        )
    table = np.frombuffer(body[:expected], '<f4').reshape(count, len(properties))
    return [p[2] for p in properties], table.astype(np.float32)
