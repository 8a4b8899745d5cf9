"""
What is true about a synthetic recording, and how it is laid down in files.

A recording is a folder in TUM layout (`rgb/`, `depth/`, `rgb.txt`, `depth.txt`,
`groundtruth.txt`, `camera.yaml`) with a folder `truth/`. Everything in it is exact at the stamp of
the frame, which is the middle of its exposure; STAMP is the stamp as it stands in `rgb.txt`.

`truth/object_id/STAMP.png`
    uint8: which object of `objects.json` each pixel sees.
`truth/dynamic/STAMP.png`
    uint8: 255 where the pixel sees something that is moving at that time. Walkers and the ball
    count as moving throughout, also when they pause. A thing that people move (the box, the
    chair) is dynamic from the moment it starts to move until it rests; before and after, it is
    part of the static world, each time where it then is.
`truth/static_color/STAMP.png`, `truth/static_depth/STAMP.png`
    The static world of that time as the camera would see it with everything dynamic taken out:
    RGB without noise and motion blur at exposure gain 1, and depth as uint16 in 1/5000 m. So a
    box at rest is in it and a box in someone's hands is not.
`truth/exposure.txt`
    `stamp gain`: the recorded image is the light times this gain; it is 1 at the first frame.
    Multiply `static_color` by it to compare with an image in the exposure of the frame; a map
    that compensates exposure relative to its first frame is compared with it as it is.
`truth/groundtruth.txt`
    The same as `groundtruth.txt`: T_world_camera of every frame. World is the room: z up.
`truth/objects.json`
    Scenario, seed and size; for each object its id, name, kind, whether it moves at any time,
    `moving_s` (intervals of stamps) and `poses`: T_world_object as
    `stamp x y z qx qy qz qw`, one row for each frame for what moves, none for what never does.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import StampedPose, Trajectory
from bdgs_ros.data.camera_file import CAMERA_FILE, read_camera_file
from bdgs_ros.data.synth.sensor import DEPTH_SCALE

_TOLERANCE_NS = 500_000  # stamps that went through a float come back this near


def stamp_text(stamp_ns: int) -> str:
    """Return a stamp as it stands in the files: seconds with six decimals."""
    return f'{stamp_ns // 10**9}.{stamp_ns % 10**9 // 1000:06d}'


def parse_stamp(text: str) -> int:
    """Return nanoseconds of a stamp in decimal seconds, without going through a float."""
    seconds, _, fraction = text.partition('.')
    return int(seconds) * 10**9 + int(fraction[:9].ljust(9, '0'))


@dataclass(frozen=True)
class TrueObject:
    """One object of a recording; `poses` T_world_object [N, 4, 4] by frame, empty if it rests."""

    object_id: int
    name: str
    kind: str
    is_mover: bool
    moving_s: tuple[tuple[float, float], ...]
    poses: NDArray[np.float64]


class SynthTruth:
    """
    Read what is true about a synthetic recording.

    Parameters
    ----------
    folder : Path
        The folder of the recording.

    Raises
    ------
    DatasetError
        If the folder has no truth, or a file of it cannot be read.

    """

    def __init__(self, folder: Path) -> None:
        self._folder = Path(folder) / 'truth'
        if not self.available(folder):
            raise DatasetError(
                f"'{folder}' has no 'truth/objects.json'; only recordings made by "
                '`bdgs synth` carry the truth'
            )
        scale = read_camera_file(Path(folder) / CAMERA_FILE).depth_scale
        self._depth_scale = scale or DEPTH_SCALE
        self._exposure = self._read_exposure()
        self._stamps = np.array(sorted(self._exposure), dtype=np.int64)

    @staticmethod
    def available(folder: Path) -> bool:
        """Tell whether a folder holds a synthetic recording with its truth."""
        truth = Path(folder) / 'truth'
        return (truth / 'objects.json').is_file() and (truth / 'exposure.txt').is_file()

    @property
    def stamps_ns(self) -> NDArray[np.int64]:
        """The stamps of all frames, shape (N,)."""
        return self._stamps

    def dynamic(self, stamp_ns: int) -> NDArray[np.bool_]:
        """Return which pixels see something that moves, shape (H, W)."""
        return np.asarray(self._image('dynamic', stamp_ns) >= 128)

    def object_id(self, stamp_ns: int) -> NDArray[np.uint8]:
        """Return the id of what each pixel sees, shape (H, W)."""
        return np.asarray(self._image('object_id', stamp_ns), np.uint8)

    def movers(self, stamp_ns: int) -> NDArray[np.bool_]:
        """Return which pixels see something that moves at any time, at rest or not, (H, W)."""
        ids = [o.object_id for o in self.objects if o.is_mover]
        return np.isin(self.object_id(stamp_ns), ids)

    def static_color(self, stamp_ns: int) -> NDArray[np.uint8]:
        """Return the static world, RGB uint8 (H, W, 3), at exposure gain 1."""
        return np.ascontiguousarray(self._image('static_color', stamp_ns)[..., ::-1], np.uint8)

    def static_depth(self, stamp_ns: int) -> NDArray[np.float32]:
        """Return the depth of the static world, metres float32 (H, W)."""
        units = self._image('static_depth', stamp_ns)
        return np.asarray(units.astype(np.float32) / np.float32(self._depth_scale))

    def exposure(self, stamp_ns: int) -> float:
        """Return the exposure gain of a frame relative to the first."""
        return self._exposure[self.nearest(stamp_ns)]

    def trajectory(self) -> Trajectory:
        """Return T_world_camera of every frame; world is the room, z up."""
        poses = []
        for line in self._lines('groundtruth.txt'):
            stamp, *numbers = line.split()
            values = np.array([float(n) for n in numbers])
            T = se3.from_position_quat_xyzw(values[:3], values[3:])
            poses.append(StampedPose(parse_stamp(stamp), T))
        return Trajectory(tuple(poses))

    @cached_property
    def description(self) -> dict[str, Any]:
        """The content of `objects.json`."""
        content: dict[str, Any] = json.loads((self._folder / 'objects.json').read_text())
        return content

    @cached_property
    def objects(self) -> tuple[TrueObject, ...]:
        """The objects of the recording."""
        return tuple(_object(entry) for entry in self.description['objects'])

    def _image(self, kind: str, stamp_ns: int) -> NDArray[Any]:
        path = self._folder / kind / f'{stamp_text(self.nearest(stamp_ns))}.png'
        image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
        if image is None:
            raise DatasetError(f"cannot read '{path}': it is missing or broken")
        return np.asarray(image)

    def nearest(self, stamp_ns: int) -> int:
        """Return the stamp of the frame at a time; `DatasetError` if there is none."""
        index = int(np.argmin(np.abs(self._stamps - stamp_ns)))
        nearest = int(self._stamps[index])
        if abs(nearest - stamp_ns) > _TOLERANCE_NS:
            raise DatasetError(
                f'no truth at {stamp_text(stamp_ns)} s; the nearest frame is at '
                f'{stamp_text(nearest)} s of {len(self._stamps)} frames'
            )
        return nearest

    def _read_exposure(self) -> dict[int, float]:
        rows = (line.split() for line in self._lines('exposure.txt'))
        gains = {parse_stamp(stamp): float(gain) for stamp, gain in rows}
        if not gains:
            raise DatasetError(f"'{self._folder / 'exposure.txt'}' lists no frame")
        return gains

    def _lines(self, name: str) -> list[str]:
        text = (self._folder / name).read_text()
        return [line for line in text.splitlines() if line and not line.startswith('#')]


def _object(entry: dict[str, Any]) -> TrueObject:
    rows = [[float(n) for n in row.split()] for row in entry['poses']]
    poses = [se3.from_position_quat_xyzw(np.array(r[1:4]), np.array(r[4:])) for r in rows]
    return TrueObject(
        object_id=entry['id'],
        name=entry['name'],
        kind=entry['kind'],
        is_mover=entry['is_mover'],
        moving_s=tuple((float(a), float(b)) for a, b in entry['moving_s']),
        poses=np.array(poses).reshape(-1, 4, 4),
    )
