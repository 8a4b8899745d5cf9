"""Stamps and trajectories as TUM text files: `stamp x y z qx qy qz qw`, one pose a line."""

from __future__ import annotations

import logging
from decimal import Decimal, InvalidOperation
from functools import cache
from pathlib import Path

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.files import write_text
from bdgs_ros.core.types import Pose, StampedPose, Trajectory

_LOGGER = logging.getLogger(__name__)

NS_PER_S = 1_000_000_000
_LATEST_S = Decimal(10**11)  # the year 5138
_UNITS = ('milliseconds', 'microseconds', 'nanoseconds')
POSE_COLUMNS = 'x y z qx qy qz qw'


def parse_stamp_ns(text: str) -> int:
    """
    Turn a stamp in decimal seconds into integer nanoseconds, without rounding through float.

    What is so large that it can only be milli-, micro- or nanoseconds is read as such, and said.

    Raises
    ------
    ValueError
        If the text is not a finite decimal number, or no time that can be.

    """
    try:
        seconds = _in_seconds(Decimal(text))
        return int((seconds * NS_PER_S).to_integral_value())
    except (InvalidOperation, OverflowError, ValueError) as error:
        raise ValueError(f'{text!r} is not a stamp in seconds') from error


def _in_seconds(value: Decimal) -> Decimal:
    """Return a time in seconds, of which unit it may be; ValueError if it is none that can be."""
    if abs(value) < _LATEST_S:
        return value
    for unit in _UNITS:
        value /= 1000
        if abs(value) < _LATEST_S:
            _tell_unit(unit)
            return value
    raise ValueError('too late for a stamp')


@cache
def _tell_unit(unit: str) -> None:
    _LOGGER.warning('stamps are so large that they are read as %s', unit)


def format_stamp_ns(stamp_ns: int) -> str:
    """Write a stamp in seconds with nine decimals."""
    sign = '-' if stamp_ns < 0 else ''
    seconds, nanoseconds = divmod(abs(stamp_ns), NS_PER_S)
    return f'{sign}{seconds}.{nanoseconds:09d}'


def seconds_to_ns(seconds: float) -> int:
    """Convert a duration in seconds to the nearest nanosecond."""
    return round(seconds * NS_PER_S)


def read_trajectory(path: Path) -> Trajectory:
    """
    Read a trajectory in TUM format, sorted by stamp; lines that start with `#` are comments.

    Raises
    ------
    DatasetError
        If the file is missing, or a line is not eight finite numbers with a rotation.

    """
    try:
        lines = path.read_text(encoding='utf-8-sig').splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read the trajectory '{path}': {error}") from error
    poses = [
        _parse_pose(path, number, line)
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith('#')
    ]
    return Trajectory(tuple(sorted(poses, key=lambda pose: pose.stamp_ns)))


def _parse_pose(path: Path, number: int, line: str) -> StampedPose:
    stamp, *words = line.replace(',', ' ').split()
    pose = ' '.join(words)
    try:
        return StampedPose(parse_stamp_ns(stamp), parse_pose(pose))
    except ValueError as error:
        raise DatasetError(
            f"'{path}', line {number}: expected 'stamp {POSE_COLUMNS}', found {error}"
        ) from error


def parse_pose(text: str) -> Pose:
    """
    Read one pose, metres and a quaternion that need not be of length one.

    Returns
    -------
    T_world_camera : ndarray, shape (4, 4)

    Raises
    ------
    ValueError
        If the text is not seven finite numbers with a rotation: the message says what it is.

    """
    values = np.array([float(word) for word in text.replace(',', ' ').split()])
    if len(values) != len(POSE_COLUMNS.split()):
        raise ValueError(f"{len(values)} numbers for the pose '{POSE_COLUMNS}'")
    if not np.isfinite(values).all():
        raise ValueError('a number that is not finite')
    if not 0.5 < np.linalg.norm(values[3:]) < 2.0:
        raise ValueError(f'a quaternion of norm {np.linalg.norm(values[3:]):.3g}')
    return se3.from_position_quat_xyzw(values[:3], values[3:])


def write_trajectory(path: Path, trajectory: Trajectory) -> None:
    """
    Write a trajectory in TUM format; an older file stays intact if anything fails.

    Raises
    ------
    DatasetError
        If the path cannot be written.

    """
    lines = [f'# stamp {POSE_COLUMNS}', *(_format_pose(pose) for pose in trajectory.poses)]
    write_text_atomically(path, '\n'.join(lines) + '\n')


def _format_pose(pose: StampedPose) -> str:
    position, quat_xyzw = se3.to_position_quat_xyzw(pose.T_world_camera)
    numbers = ' '.join(f'{value:.9f}' for value in (*position, *quat_xyzw))
    return f'{format_stamp_ns(pose.stamp_ns)} {numbers}'


def write_text_atomically(path: Path, text: str) -> None:
    """Write a text file aside, then rename it over the old one; `DatasetError` if it fails."""
    try:
        write_text(path, text)
    except OSError as error:
        raise DatasetError(f"cannot write '{path}': {error}") from error
