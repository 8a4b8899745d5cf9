"""Trajectories as TUM text files: `stamp x y z qx qy qz qw`."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from bdgs_ros.core import se3
from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.types import StampedPose, Trajectory
from bdgs_ros.eval.files import write_text

_COLUMNS = 8


def write_tum(path: Path, trajectory: Trajectory, comment: str = '') -> None:
    """
    Write a trajectory, stamps with nine decimals; the old file stays until the new one is whole.

    Raises
    ------
    OSError
        If the file cannot be written.

    """
    lines = [f'# {comment}'] if comment else []
    lines.append('# timestamp tx ty tz qx qy qz qw')
    lines.extend(_format(pose) for pose in trajectory.poses)
    write_text(path, '\n'.join(lines) + '\n')


def _format(pose: StampedPose) -> str:
    position, quat_xyzw = se3.to_position_quat_xyzw(pose.T_world_camera)
    seconds, rest = divmod(pose.stamp_ns, 10**9)
    numbers = ' '.join(f'{v:.9f}' for v in (*position, *quat_xyzw))
    return f'{seconds}.{rest:09d} {numbers}'


def read_tum(path: Path) -> Trajectory:
    """
    Read a trajectory and sort it by stamp.

    Raises
    ------
    EvaluationError
        If the file is missing, has no poses, or a line is not eight numbers with a quaternion
        that is not zero.

    """
    if not path.is_file():
        raise EvaluationError(f"'{path}' is not a file; a trajectory in TUM format was expected")
    text = path.read_text(encoding='utf-8', errors='replace')
    poses = [
        _parse(path, number, line)
        for number, line in enumerate(text.splitlines(), start=1)
        if line.strip() and not line.lstrip().startswith('#')
    ]
    if not poses:
        raise EvaluationError(f"'{path}' has no poses")
    return Trajectory(tuple(sorted(poses, key=lambda pose: pose.stamp_ns)))


def _parse(path: Path, number: int, line: str) -> StampedPose:
    words = line.replace(',', ' ').split()
    try:
        values = np.array([float(word) for word in words])
        if len(values) != _COLUMNS or not np.isfinite(values).all() or not values[4:].any():
            raise ValueError
    except ValueError:
        raise EvaluationError(
            f"'{path}' line {number}: expected 'stamp x y z qx qy qz qw', found '{line.strip()}'"
        ) from None
    T = se3.from_position_quat_xyzw(values[1:4], values[4:])
    return StampedPose(_nanoseconds(words[0]), T)


def _nanoseconds(text: str) -> int:
    """Parse seconds without the rounding of a float, which is 240 ns for today's stamps."""
    seconds, dot, fraction = text.partition('.')
    if not dot or 'e' in text.lower() or not seconds.isdigit():
        return round(float(text) * 1e9)
    return int(seconds) * 10**9 + int(fraction.ljust(9, '0')[:9] or 0)
