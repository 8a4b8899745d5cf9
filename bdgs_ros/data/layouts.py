"""Recognise what kind of recording a path is, and open it."""

from __future__ import annotations

from pathlib import Path

from bdgs_ros.core.errors import DatasetError
from bdgs_ros.data.associate import MAX_DIFFERENCE_S
from bdgs_ros.data.bag import is_bag, open_bag
from bdgs_ros.data.bag_recording import BagRecording, CameraTopics
from bdgs_ros.data.bonn import CAMERA as BONN_CAMERA
from bdgs_ros.data.bonn import open_bonn
from bdgs_ros.data.camera_file import CAMERA_FILE, RecordedCamera, read_camera_file
from bdgs_ros.data.openloris import SENSORS_FILE, open_openloris
from bdgs_ros.data.sequence import RecordedSequence, Recording
from bdgs_ros.data.tum import freiburg_camera, open_tum

_LOOKED_FOR = (
    "a folder with 'rgb.txt' and 'depth.txt' (TUM, BONN, bdgs synth)",
    f"a folder with 'color.txt', 'aligned_depth.txt' and '{SENSORS_FILE}' (OpenLORIS)",
    "a rosbag2 folder with 'metadata.yaml', or a .mcap or .db3 file",
    'a ROS 1 .bag file',
)


def open_recording(
    path: Path | str,
    camera_file: Path | str | None = None,
    allow_truncated: bool = False,
    topics: CameraTopics | None = None,
) -> Recording:
    """
    Open a recording of any known layout, images as recorded.

    Parameters
    ----------
    path : Path or str
        A folder or a bag.
    camera_file : Path or str, optional
        A `camera.yaml` that overrules what is known about the camera.
    allow_truncated : bool
        Use what is readable of a bag that was cut off.
    topics : CameraTopics, optional
        What the camera's topics are called in a bag.

    Raises
    ------
    DatasetError
        If there is nothing, the layout is unknown, or the camera is.

    """
    path = Path(path)
    camera = None if camera_file is None else read_camera_file(Path(camera_file))
    if not path.exists():
        raise DatasetError(f"there is no recording at '{path}'")
    if path.is_dir() and (path / 'rgb.txt').is_file():
        return _open_tum_like(path, camera)
    if path.is_dir() and (path / 'color.txt').is_file() and (path / SENSORS_FILE).is_file():
        return open_openloris(path, camera)
    if is_bag(path):
        bag = open_bag(path, allow_truncated)
        if camera is None:
            return BagRecording(bag, topics=topics)
        return BagRecording(bag, camera.camera, camera.depth_scale, topics)
    raise DatasetError(_unknown_layout(path))


def open_sequence(
    path: Path | str,
    camera_file: Path | str | None = None,
    max_difference_s: float = MAX_DIFFERENCE_S,
    allow_truncated: bool = False,
    depth_offset_s: float = 0.0,
    topics: CameraTopics | None = None,
) -> RecordedSequence:
    """
    Open a recording of any known layout as rectified RGB-D frames.

    See `open_recording` and `RecordedSequence`.
    """
    recording = open_recording(path, camera_file, allow_truncated, topics)
    return RecordedSequence(recording, max_difference_s, depth_offset_s)


def _open_tum_like(folder: Path, given: RecordedCamera | None) -> Recording:
    """Open `rgb.txt` folders; a camera given outweighs `camera.yaml`, that outweighs the name."""
    own = folder / CAMERA_FILE
    camera = given or (read_camera_file(own) if own.is_file() else None)
    name = folder.resolve().name
    if 'rgbd_bonn' in name.lower():
        return open_bonn(folder, camera or BONN_CAMERA)
    camera = camera or freiburg_camera(name)
    if camera is None:
        raise DatasetError(
            f"'{folder}' is in TUM layout, but its camera is not known: its name has none "
            f"of 'freiburg1', 'freiburg2', 'freiburg3', 'rgbd_bonn', and it has no '{CAMERA_FILE}'"
            '; put one there, or give it with --camera'
        )
    return open_tum(folder, camera)


def _unknown_layout(path: Path) -> str:
    names = sorted(item.name for item in path.iterdir())[:8] if path.is_dir() else [path.name]
    looked = '\n'.join(f'  {line}' for line in _LOOKED_FOR)
    return (
        f"'{path}' is no known recording. Looked for\n{looked}\n"
        f'found {", ".join(names) or "an empty folder"}'
    )
