"""Small recordings on disk for the tests of bdgs_ros.data."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import cv2
import numpy as np
from rosbags.rosbag1 import Writer as Writer1
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from bdgs_ros.core import se3
from bdgs_ros.core.types import Pose

WIDTH, HEIGHT = 32, 24
CAMERA_YAML = f"""camera:
  width: {WIDTH}
  height: {HEIGHT}
  fx: 30.0
  fy: 31.0
  cx: 15.5
  cy: 11.5
  distortion: [0.1, -0.05, 0.001, 0.002, 0.0]
  depth_scale: 5000
"""
START = 1_500_000_000
PERIOD_NS = 33_333_333


def color_image(index: int) -> np.ndarray:
    rng = np.random.default_rng(index)
    return rng.integers(0, 256, (HEIGHT, WIDTH, 3), dtype=np.uint8)


def depth_units(index: int) -> np.ndarray:
    rng = np.random.default_rng(1000 + index)
    depth = rng.integers(2500, 20000, (HEIGHT, WIDTH), dtype=np.uint16)
    depth[:3] = 0
    return depth


def stamp_text(nanoseconds: int) -> str:
    return f'{START + nanoseconds // 10**9}.{nanoseconds % 10**9:09d}'[:-3]


def color_ns(index: int) -> int:
    return index * PERIOD_NS // 1000 * 1000


def pose(index: int) -> Pose:
    return se3.exp(np.array([0.1 * index, 0.02, -0.03, 0.01 * index, 0.2, -0.1]))


def write_images(folder: Path, list_name: str, kind: str, rows: list[tuple[int, Any]]) -> None:
    (folder / kind).mkdir(parents=True)
    lines = [f'# {kind}']
    for at_ns, image in rows:
        name = f'{kind}/{stamp_text(at_ns)}.png'
        cv2.imwrite(str(folder / name), image)
        lines.append(f'{stamp_text(at_ns)} {name}')
    (folder / list_name).write_text('\n'.join(lines) + '\n')


def write_truth(folder: Path, count: int) -> None:
    lines = ['# ground truth']
    for index in range(count):
        position, quat = se3.to_position_quat_xyzw(pose(index))
        numbers = ' '.join(f'{value:.12f}' for value in (*position, *quat))
        lines.append(f'{stamp_text(color_ns(index))} {numbers}')
    (folder / 'groundtruth.txt').write_text('\n'.join(lines) + '\n')


def write_tum(
    folder: Path, count: int = 6, without_depth: tuple[int, ...] = (), camera: bool = True
) -> Path:
    """Write a folder in TUM layout; depth comes 8 ms after colour."""
    colors = [(color_ns(i), color_image(i)[..., ::-1]) for i in range(count)]
    depths = [
        (color_ns(i) + 8_000_000, depth_units(i)) for i in range(count) if i not in without_depth
    ]
    write_images(folder, 'rgb.txt', 'rgb', colors)
    write_images(folder, 'depth.txt', 'depth', depths)
    write_truth(folder, count)
    if camera:
        (folder / 'camera.yaml').write_text(CAMERA_YAML)
    return folder


SENSORS_YAML = f"""%YAML:1.0
---
d400_color_optical_frame:
   sensor_type: camera
   fps: 30
   width: {WIDTH}
   height: {HEIGHT}
   model: pinhole
   intrinsics: !!opencv-matrix
      rows: 1
      cols: 4
      dt: d
      data: [ 30., 15.5, 31., 11.5 ]
   distortion_model: radial-tangential
   distortion_coefficients: !!opencv-matrix
      rows: 1
      cols: 5
      dt: d
      data: [ 0., 0., 0., 0., 0. ]
"""


def matrix_yaml(matrix: np.ndarray) -> str:
    numbers = ', '.join(f'{value:.12f}' for value in matrix.reshape(-1))
    pad = '\n         '
    return f'!!opencv-matrix{pad}rows: 4{pad}cols: 4{pad}dt: d{pad}data: [ {numbers} ]'


def write_openloris(folder: Path, T_base_depth: Pose, T_depth_color: Pose, count: int = 4) -> Path:
    colors = [(color_ns(i), color_image(i)[..., ::-1]) for i in range(count)]
    depths = [(color_ns(i), depth_units(i)) for i in range(count)]
    write_images(folder, 'color.txt', 'color', colors)
    write_images(folder, 'aligned_depth.txt', 'aligned_depth', depths)
    write_truth(folder, count)
    (folder / 'sensors.yaml').write_text(SENSORS_YAML)
    rows = (
        ('base_link', 'd400_depth_optical_frame', T_base_depth),
        ('d400_depth_optical_frame', 'd400_color_optical_frame', T_depth_color),
    )
    text = '%YAML:1.0\n---\ntrans_matrix:\n' + ''.join(
        f'   -\n      parent_frame: {parent}\n      child_frame: {child}\n'
        f'      matrix: {matrix_yaml(matrix)}\n'
        for parent, child, matrix in rows
    )
    (folder / 'trans_matrix.yaml').write_text(text)
    return folder


class Ros1Bag:
    """Write a ROS 1 bag, one message at a time."""

    def __init__(self, path: Path) -> None:
        self.types = get_typestore(Stores.ROS1_NOETIC)
        for name in ('tf2_msgs/msg/TFMessage', 'tf/msg/tfMessage'):
            self.types.register(
                get_types_from_msg('geometry_msgs/TransformStamped[] transforms', name)
            )
        self.writer = Writer1(path)
        self.connections: dict[str, Any] = {}

    def __enter__(self) -> Ros1Bag:
        self.writer.open()
        return self

    def __exit__(self, *_: object) -> None:
        self.writer.close()

    def make(self, name: str, *values: Any) -> Any:
        return self.types.types[name](*values)

    def write(self, topic: str, msgtype: str, log_ns: int, message: Any) -> None:
        if topic not in self.connections:
            self.connections[topic] = self.writer.add_connection(
                topic, msgtype, typestore=self.types
            )
        data = self.types.serialize_ros1(message, msgtype)
        self.writer.write(self.connections[topic], START * 10**9 + log_ns, data)

    def header(self, at_ns: int, frame: str) -> Any:
        at_ns += START * 10**9
        stamp = self.make('builtin_interfaces/msg/Time', at_ns // 10**9, at_ns % 10**9)
        # a sequence number of 2**16 looks like the head of a big-endian CDR message
        return self.make('std_msgs/msg/Header', 65536, stamp, frame)

    def image(
        self, topic: str, at_ns: int, frame: str, image: np.ndarray, encoding: str, delay_ns: int
    ) -> None:
        data = np.ascontiguousarray(image).view(np.uint8).reshape(-1)
        height, width = image.shape[:2]
        message = self.make(
            'sensor_msgs/msg/Image', self.header(at_ns, frame), height, width, encoding, 0,
            data.size // height, data,
        )  # fmt: skip
        self.write(topic, 'sensor_msgs/msg/Image', at_ns + delay_ns, message)

    def info(self, topic: str, frame: str) -> None:
        matrix = np.array([30.0, 0, 15.5, 0, 31.0, 11.5, 0, 0, 1])
        region = self.make('sensor_msgs/msg/RegionOfInterest', 0, 0, 0, 0, False)
        message = self.make(
            'sensor_msgs/msg/CameraInfo', self.header(0, frame), HEIGHT, WIDTH, 'plumb_bob',
            np.array([0.1, -0.05, 0.001, 0.002, 0.0]), matrix, np.eye(3).reshape(-1),
            np.zeros(12), 0, 0, region,
        )  # fmt: skip
        self.write(topic, 'sensor_msgs/msg/CameraInfo', 0, message)

    def transforms(
        self, topic: str, msgtype: str, at_ns: int, edges: list[tuple[str, str, Pose]]
    ) -> None:
        rows = []
        for parent, child, matrix in edges:
            position, quat = se3.to_position_quat_xyzw(matrix)
            transform = self.make(
                'geometry_msgs/msg/Transform',
                self.make('geometry_msgs/msg/Vector3', *map(float, position)),
                self.make('geometry_msgs/msg/Quaternion', *map(float, quat)),
            )
            header = self.header(at_ns, parent)
            rows.append(self.make('geometry_msgs/msg/TransformStamped', header, child, transform))
        self.write(topic, msgtype, at_ns, self.make(msgtype, rows))
