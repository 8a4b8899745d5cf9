"""
Folders as the TUM RGB-D benchmark lays them out: `rgb.txt`, `depth.txt`, `groundtruth.txt`.

Sturm et al., "A Benchmark for the Evaluation of RGB-D SLAM Systems", IROS 2012.
"""

from __future__ import annotations

import re
from dataclasses import dataclass
from pathlib import Path

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.images import metres
from bdgs_ros.core.types import ColorImage, DepthImage, Trajectory
from bdgs_ros.data.camera_file import RecordedCamera
from bdgs_ros.data.trajectory_io import parse_stamp_ns, read_trajectory

DEPTH_SCALE = 5000.0
_CAMERAS = {
    '1': PinholeCamera(
        640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    ),
    '2': PinholeCamera(
        640, 480, 520.9, 521.0, 325.1, 249.7, (0.2312, -0.7849, -0.0033, -0.0001, 0.9172)
    ),
    '3': PinholeCamera(640, 480, 535.4, 539.2, 320.1, 247.6),
}


def freiburg_camera(name: str) -> RecordedCamera | None:
    """Return the published calibration of a TUM sequence, if its name has `freiburg1` to 3."""
    match = re.search(r'freiburg([123])', name.lower())
    return RecordedCamera(_CAMERAS[match[1]], DEPTH_SCALE) if match else None


@dataclass(frozen=True)
class ImageFile:
    """One row of `rgb.txt` or `depth.txt`."""

    stamp_ns: int
    path: Path


def read_image_list(path: Path) -> list[ImageFile]:
    """
    Read `stamp filename` rows, sorted by stamp; paths are relative to the list.

    Raises
    ------
    DatasetError
        If the list is missing, empty, malformed, or names a file that does not exist.

    """
    try:
        lines = path.read_text(encoding='utf-8-sig').splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise DatasetError(f"cannot read the image list '{path}': {error}") from error
    files = [
        _parse_row(path, number, line)
        for number, line in enumerate(lines, start=1)
        if line.strip() and not line.lstrip().startswith('#')
    ]
    if not files:
        raise DatasetError(f"'{path}' lists no images")
    missing = [file.path for file in files if not file.path.is_file()]
    if missing:
        raise DatasetError(
            f"'{path}' lists {len(files)} images but {len(missing)} are missing, "
            f"the first is '{missing[0]}'; is the download complete?"
        )
    return sorted(files, key=lambda file: file.stamp_ns)


def _parse_row(path: Path, number: int, line: str) -> ImageFile:
    words = line.replace(',', ' ', 1).split(maxsplit=1)
    try:
        if len(words) != 2:
            raise ValueError(f'{line!r}')
        return ImageFile(parse_stamp_ns(words[0]), path.parent / words[1].strip())
    except ValueError as error:
        raise DatasetError(
            f"'{path}', line {number}: expected 'stamp filename', found {error}"
        ) from error


def read_color_file(path: Path) -> ColorImage:
    """Decode an image file to RGB; `DatasetError` if it cannot be decoded."""
    image = cv2.imread(str(path), cv2.IMREAD_COLOR | cv2.IMREAD_IGNORE_ORIENTATION)
    if image is None:
        raise DatasetError(f"'{path}' is not a readable colour image; is the download complete?")
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), dtype=np.uint8)


def read_depth_file(path: Path, depth_scale: float) -> DepthImage:
    """Decode a 16-bit PNG to metres; `DatasetError` if it is anything else."""
    image = cv2.imread(str(path), cv2.IMREAD_UNCHANGED)
    if image is None:
        raise DatasetError(f"'{path}' is not a readable depth image; is the download complete?")
    if image.dtype != np.uint16 or image.ndim != 2:
        raise DatasetError(
            f"'{path}': expected a 16-bit single-channel depth image, "
            f'received {image.dtype} {image.shape}'
        )
    return metres(np.asarray(image, np.uint16), depth_scale)


class FolderRecording:
    """
    Images listed in two text files of a folder.

    Parameters
    ----------
    folder : Path
        Where the lists are.
    camera : RecordedCamera
        The camera and the scale of its depth images.
    color_list, depth_list : str
        Names of the two lists.
    ground_truth : Trajectory, optional
        Poses of the camera.

    """

    def __init__(
        self,
        folder: Path,
        camera: RecordedCamera,
        color_list: str = 'rgb.txt',
        depth_list: str = 'depth.txt',
        ground_truth: Trajectory | None = None,
    ) -> None:
        self.name = folder.resolve().name
        self.camera = camera.camera
        self.ground_truth = ground_truth
        self._folder = folder
        self._depth_scale = camera.depth_scale or DEPTH_SCALE
        self._color = read_image_list(folder / color_list)
        self._depth = read_image_list(folder / depth_list)
        self.color_stamps_ns = _stamps(self._color)
        self.depth_stamps_ns = _stamps(self._depth)

    def color_name(self, index: int) -> str:
        """Return the path of a colour image inside the folder, or where else it lies."""
        path = self._color[index].path
        return str(path.relative_to(self._folder) if path.is_relative_to(self._folder) else path)

    def read_color(self, index: int) -> ColorImage:
        """Read one colour image, distorted."""
        image = read_color_file(self._color[index].path)
        self._check_size(self._color[index].path, image.shape[:2])
        return image

    def read_depth(self, index: int) -> DepthImage:
        """Read one depth image in metres, distorted."""
        image = read_depth_file(self._depth[index].path, self._depth_scale)
        self._check_size(self._depth[index].path, image.shape)
        return image

    def _check_size(self, path: Path, shape: tuple[int, ...]) -> None:
        if shape != self.camera.shape:
            raise DatasetError(
                f"'{path}' has shape {shape}, but the camera of '{self.name}' has "
                f'{self.camera.shape}; give the right camera with --camera'
            )


def _stamps(files: list[ImageFile]) -> NDArray[np.int64]:
    return np.array([file.stamp_ns for file in files], dtype=np.int64)


def read_ground_truth(folder: Path) -> Trajectory | None:
    """Read `groundtruth.txt` if there is one."""
    path = folder / 'groundtruth.txt'
    return read_trajectory(path) if path.is_file() else None


def open_tum(folder: Path, camera: RecordedCamera) -> FolderRecording:
    """Open a folder in TUM layout whose ground truth is that of the colour camera."""
    return FolderRecording(folder, camera, ground_truth=read_ground_truth(folder))
