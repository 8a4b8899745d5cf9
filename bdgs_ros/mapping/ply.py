"""
Maps as files: the standard 3DGS .ply, with the filter's state as further properties.

Layout of the reference implementation (Kerbl et al. 2023):
`x y z nx ny nz f_dc_0..2 f_rest_* opacity scale_0..2 rot_0..3`, all float32, opacity as logit,
scale as natural logarithm, rot wxyz; `f_rest_*`, the view-dependent colour, as far as the map has
it. What follows them is ours; docs/files.md says which programs pass
over it, and which need a file without (`state=False`).
"""

from __future__ import annotations

import logging
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.errors import MapError
from bdgs_ros.core.files import write_bytes
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.harmonics import degree_of

Array = NDArray[np.float32]
Block = tuple[tuple[str, ...], Array]

_LOGGER = logging.getLogger(__name__)

SH_C0 = 0.28209479177387814
STANDARD = (
    *('x', 'y', 'z', 'nx', 'ny', 'nz', 'f_dc_0', 'f_dc_1', 'f_dc_2', 'opacity'),
    *('scale_0', 'scale_1', 'scale_2', 'rot_0', 'rot_1', 'rot_2', 'rot_3'),
)
STATE = (
    'p_dynamic',
    'p_dynamic_smoothed',
    'keyframe_index',
    'observations',
    'hidden',
    'void',
)
_OPTIONAL = ('nx', 'ny', 'nz')
_TYPES = {
    **{'float': '<f4', 'float32': '<f4', 'double': '<f8', 'float64': '<f8'},
    **{'char': 'i1', 'int8': 'i1', 'uchar': 'u1', 'uint8': 'u1'},
    **{'short': '<i2', 'int16': '<i2', 'ushort': '<u2', 'uint16': '<u2'},
    **{'int': '<i4', 'int32': '<i4', 'uint': '<u4', 'uint32': '<u4'},
}


def save_ply(path: Path, gaussians: GaussianMap, *, state: bool = True) -> None:
    """
    Write the map; aside first, then renamed, so an old file stays whole if this fails.

    Parameters
    ----------
    path : Path
        Of the file.
    gaussians : GaussianMap
        The map.
    state : bool
        False leaves the standard properties alone, for programs that stumble over more.

    Raises
    ------
    MapError
        If the file cannot be written.

    """
    try:
        write_bytes(path, *ply_content(gaussians, state=state))
    except OSError as error:
        raise MapError(f"map not saved to '{path}': {error.strerror or error}") from error


def ply_content(gaussians: GaussianMap, *, state: bool = True) -> tuple[bytes, bytes]:
    """Return header and rows of the file, see `save_ply`."""
    blocks = _standard_blocks(gaussians) + (_state_blocks(gaussians) if state else [])
    names = [name for block_names, _ in blocks for name in block_names]
    columns = [array.reshape(len(gaussians), len(names_of)) for names_of, array in blocks]
    table = np.concatenate(columns, axis=1, dtype=np.float32)
    header = _header(len(gaussians), [f'float {name}' for name in names])
    return header, table.astype('<f4').tobytes()


def _header(count: int, properties: list[str]) -> bytes:
    lines = [f'property {text}\n' for text in properties]
    # The comment tells viewers that know it (brush) which way is up: -y, as in all 3DGS maps.
    start = 'ply\nformat binary_little_endian 1.0\ncomment Vertical axis: y\n'
    count_line = f'element vertex {count}\n'
    return (start + count_line + ''.join(lines) + 'end_header\n').encode('ascii')


def _standard_blocks(gaussians: GaussianMap) -> list[Block]:
    """Return the standard properties in their order."""
    rest = tuple(f'f_rest_{i}' for i in range(gaussians.harmonics.shape[1]))
    quats = gaussians.quats / np.linalg.norm(gaussians.quats, axis=1, keepdims=True)
    return [
        (('x', 'y', 'z'), gaussians.means),
        (('nx', 'ny', 'nz'), np.zeros_like(gaussians.means)),
        (('f_dc_0', 'f_dc_1', 'f_dc_2'), (gaussians.colors - 0.5) / SH_C0),
        (rest, gaussians.harmonics),
        (('opacity',), gaussians.logit_opacities),
        (('scale_0', 'scale_1', 'scale_2'), gaussians.log_scales),
        (('rot_0', 'rot_1', 'rot_2', 'rot_3'), quats),
    ]


def _state_blocks(gaussians: GaussianMap) -> list[Block]:
    """Return what the filter and the mapper know beyond the standard, one name each."""
    arrays = (
        gaussians.belief.belief,
        gaussians.belief.smoothed,
        gaussians.keyframe_index.astype(np.float32),
        gaussians.observations.astype(np.float32),
        gaussians.belief.hidden.astype(np.float32),
        gaussians.belief.void.astype(np.float32),
    )
    return [((name,), array) for name, array in zip(STATE, arrays, strict=True)]


def write_points(path: Path, gaussians: GaussianMap) -> None:
    """Write the centres of the static map as a plain coloured point cloud; `OSError` if not."""
    shown = gaussians.visible_mask()
    layout = [(name, '<f4') for name in ('x', 'y', 'z')]
    layout += [(name, 'u1') for name in ('red', 'green', 'blue')]
    points = np.zeros(int(shown.sum()), layout)
    colors = np.clip(gaussians.colors[shown] * 255 + 0.5, 0, 255)
    for i, name in enumerate(('x', 'y', 'z')):
        points[name] = gaussians.means[shown, i]
    for i, name in enumerate(('red', 'green', 'blue')):
        points[name] = colors[:, i]
    kinds = ['float x', 'float y', 'float z', 'uchar red', 'uchar green', 'uchar blue']
    write_bytes(path, _header(len(points), kinds), points.tobytes())


def load_ply(path: Path, config: BeliefConfig, degree: int | None = None) -> GaussianMap:
    """
    Read a map, ours or any 3DGS .ply; without filter state every Gaussian starts as static.

    Parameters
    ----------
    path : Path
        Of the file.
    config : BeliefConfig
        Of the filter.
    degree : int, optional
        Of the map's view-dependent colour, to which that of the file is extended or cut; None:
        as in the file.

    Raises
    ------
    MapError
        If the file is missing, not a binary little-endian .ply of vertices, lacks one of the
        standard properties, or is shorter than its header says.

    """
    column = _read_columns(path)
    missing = [n for n in STANDARD if n not in column and n not in _OPTIONAL]
    if missing:
        raise MapError(f"'{path}' is no 3DGS map: it lacks the properties {', '.join(missing)}")
    rest = _rest_names(path, column, degree)
    return _from_columns(_without_broken(path, column, rest), config, rest, degree)


def _rest_names(path: Path, column: dict[str, Array], degree: int | None) -> tuple[str, ...]:
    """Return the names of the view-dependent colour; none if it is not wanted or not whole."""
    count = sum(name.startswith('f_rest_') for name in column)
    names = tuple(f'f_rest_{i}' for i in range(count))
    found = degree_of(count)
    if found is None or not all(name in column for name in names):
        _LOGGER.warning("'%s': %d f_rest properties make no degree; passed over", path, count)
        return ()
    if degree is not None and found > degree:
        _LOGGER.warning(
            "'%s' has view-dependent colour of degree %d; cut to mapping.color.degree = %d",
            *(path, found, degree),
        )
    return () if degree == 0 else names


def _without_broken(
    path: Path, column: dict[str, Array], rest: tuple[str, ...]
) -> dict[str, Array]:
    """Leave out Gaussians with numbers that are not finite, which some trainers produce."""
    needed = [
        name for name in (*STANDARD, *rest, *STATE) if name in column and name not in _OPTIONAL
    ]
    sound = np.all([np.isfinite(column[name]) for name in needed], axis=0)
    sound &= np.any([column[f'rot_{i}'] != 0 for i in range(4)], axis=0)
    if sound.all():
        return column
    _LOGGER.warning("'%s': %d Gaussians are not finite; left out", path, (~sound).sum())
    return {name: values[sound] for name, values in column.items()}


def _from_columns(
    column: dict[str, Array], config: BeliefConfig, rest: tuple[str, ...], degree: int | None
) -> GaussianMap:
    def block(*names: str) -> Array:
        return np.ascontiguousarray(np.stack([column[n] for n in names], axis=1))

    count = len(column['x'])
    belief = column.get('p_dynamic', np.full(count, 0.1, np.float32))
    gaussians = GaussianMap(config)
    colors = block('f_dc_0', 'f_dc_1', 'f_dc_2') * np.float32(SH_C0) + np.float32(0.5)
    ones = np.ones(count, np.float32)
    gaussians.append(NewGaussians(block('x', 'y', 'z'), ones, colors, belief), 0.5, 0)
    gaussians.parameters['quats'] = block('rot_0', 'rot_1', 'rot_2', 'rot_3')
    gaussians.parameters['log_scales'] = block('scale_0', 'scale_1', 'scale_2')
    gaussians.parameters['logit_opacities'] = np.ascontiguousarray(column['opacity'])
    if rest:
        gaussians.parameters['harmonics'] = block(*rest)
    gaussians.resize_colors((degree_of(len(rest)) or 0) if degree is None else degree)
    smoothed = column.get('p_dynamic_smoothed', belief).copy()
    flags = (column[name] > 0.5 if name in column else None for name in ('hidden', 'void'))
    gaussians.belief.restart_smoothing(smoothed, *flags)
    zero = np.zeros(count, np.float32)
    gaussians.keyframe_index = column.get('keyframe_index', zero).astype(np.int32)
    gaussians.observations = column.get('observations', zero).astype(np.int32)
    return gaussians


def _read_columns(path: Path) -> dict[str, Array]:
    """Return every property of the vertices as float32, [N] each."""
    try:
        content = path.read_bytes()
    except OSError as error:
        raise MapError(f"map '{path}' cannot be read: {error.strerror}") from error
    head, mark, body = content.partition(b'end_header')
    end = b'\r\n' if body.startswith(b'\r\n') else b'\n'  # some programs write lines so
    body = body.removeprefix(end)
    lines = head.decode('ascii', errors='replace').splitlines()
    if (
        not mark
        or not lines
        or lines[0] != 'ply'
        or 'format binary_little_endian 1.0' not in lines
    ):
        raise MapError(f"'{path}' is not a binary little-endian .ply file")
    count, layout = _layout(path, [line.split() for line in lines])
    expected = count * layout.itemsize
    if len(body) < expected:
        raise MapError(
            f"'{path}' is truncated: {count} Gaussians need {expected} bytes, "
            f'{len(body)} are there'
        )
    table = np.frombuffer(body, layout, count)
    return {name: table[name].astype(np.float32) for name in layout.names or ()}


def _layout(path: Path, lines: list[list[str]]) -> tuple[int, np.dtype[np.void]]:
    """Return number and layout of the vertices, of which alone a 3DGS map consists."""
    elements = [words[1:] for words in lines if words[:1] == ['element']]
    if len(elements) != 1 or elements[0][0] != 'vertex' or not elements[0][-1].isdecimal():
        found = ', '.join(' '.join(words) for words in elements) or 'none'
        raise MapError(
            f"'{path}': a 3DGS map has the one element 'vertex COUNT', this has: {found}; if it "
            'is compressed, export it uncompressed'
        )
    properties = [words[1:] for words in lines if words[:1] == ['property']]
    strange = [' '.join(p) for p in properties if len(p) != 2 or p[0] not in _TYPES]
    strange += [' '.join(p) for p in properties if properties.count(p) > 1]
    if strange:
        raise MapError(
            f"'{path}': a 3DGS map has numbers alone, each once; this has: {', '.join(strange)}"
        )
    return int(elements[0][1]), np.dtype([(name, _TYPES[kind]) for kind, name in properties])
