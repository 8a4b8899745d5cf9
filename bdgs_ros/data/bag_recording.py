"""The colour, depth, camera and ground truth topics of a bag as a recording."""

from __future__ import annotations

from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.types import ColorImage, DepthImage, StampedPose, Trajectory
from bdgs_ros.data.associate import MAX_DIFFERENCE_S
from bdgs_ros.data.bag import BagReader, MessageRef, open_bag
from bdgs_ros.data.messages import (
    COMPRESSED_IMAGE,
    MM_PER_M,
    camera_from_message,
    color_from_compressed,
    color_from_message,
    depth_from_compressed,
    depth_from_message,
    pose_from_message,
    stamp_ns,
)
from bdgs_ros.data.ros1 import openloris_ground_truth, tum_ground_truth
from bdgs_ros.data.sequence import RecordedSequence
from bdgs_ros.data.trajectory_io import format_stamp_ns
from bdgs_ros.data.tum import freiburg_camera

COLOR_TOPIC = '/camera/color/image_raw'
DEPTH_TOPIC = '/camera/depth/image_raw'
INFO_TOPIC = '/camera/color/camera_info'
GROUND_TRUTH_TOPIC = '/ground_truth/pose'

_FIRST_FEW = 5
_COMPRESSED = ('/compressed',)
_COMPRESSED_DEPTH = ('/compressedDepth', '/compressed')

GroundTruthReader = Callable[[BagReader, str], Trajectory | None]


def pose_ground_truth(reader: BagReader, camera_frame: str) -> Trajectory | None:
    """Read the camera's poses from PoseStamped messages."""
    if GROUND_TRUTH_TOPIC not in reader.topics:
        return None
    poses = (
        StampedPose(stamp_ns(message), pose_from_message(message.pose))
        for _, message in reader.messages([GROUND_TRUTH_TOPIC])
    )
    return Trajectory(tuple(sorted(poses, key=lambda pose: pose.stamp_ns)))


@dataclass(frozen=True)
class TopicLayout:
    """How somebody names the topics of a registered RGB-D camera."""

    name: str
    color: str
    depth: str
    info: str
    ground_truth: GroundTruthReader = pose_ground_truth


# Depth that is registered to colour comes first: a RealSense also publishes depth that is not.
LAYOUTS = (
    TopicLayout(
        'RealSense',
        '/camera/camera/color/image_raw',
        '/camera/camera/aligned_depth_to_color/image_raw',
        '/camera/camera/color/camera_info',
    ),
    TopicLayout(
        'RealSense, older',
        COLOR_TOPIC,
        '/camera/aligned_depth_to_color/image_raw',
        INFO_TOPIC,
    ),
    TopicLayout('bdgs', COLOR_TOPIC, DEPTH_TOPIC, INFO_TOPIC),
    TopicLayout(
        'OpenLORIS',
        '/d400/color/image_raw',
        '/d400/aligned_depth_to_color/image_raw',
        '/d400/color/camera_info',
        openloris_ground_truth,
    ),
    TopicLayout(
        'TUM',
        '/camera/rgb/image_color',
        '/camera/depth/image',
        '/camera/rgb/camera_info',
        tum_ground_truth,
    ),
    TopicLayout(
        'OpenNI',
        '/camera/rgb/image_raw',
        '/camera/depth_registered/image_raw',
        '/camera/rgb/camera_info',
    ),
)


class BagRecording:
    """
    A recording in a bag.

    Parameters
    ----------
    reader : BagReader
        The open bag; the recording keeps it open.
    camera : PinholeCamera, optional
        Use this camera instead of the one in the bag.
    depth_scale : float, optional
        Units of 16-bit depth in a metre; by default millimetres.
    topics : CameraTopics, optional
        The names of the topics; recognised by default.

    Raises
    ------
    DatasetError
        If the bag has no known pair of colour and depth topics, or no usable camera.

    """

    def __init__(
        self,
        reader: BagReader,
        camera: PinholeCamera | None = None,
        depth_scale: float | None = None,
        topics: CameraTopics | None = None,
    ) -> None:
        self.reader = reader
        self._depth_scale = depth_scale or MM_PER_M
        self.name = (
            reader.path.resolve().stem if reader.path.suffix else reader.path.resolve().name
        )
        self.layout = find_layout(reader, topics)
        self.camera = camera or self._find_camera()
        index = reader.index([self.layout.color, self.layout.depth])
        self._color, self._depth = index[self.layout.color], index[self.layout.depth]
        self.color_stamps_ns = _stamps(self._color)
        self.depth_stamps_ns = _stamps(self._depth)
        self._ground_truth: list[Trajectory | None] = []

    @property
    def ground_truth(self) -> Trajectory | None:
        """The poses of the camera; read when first asked for."""
        if not self._ground_truth:
            self._ground_truth.append(self._read_ground_truth())
        return self._ground_truth[0]

    def _read_ground_truth(self) -> Trajectory | None:
        if not self._color:
            return None
        frame = str(self._message(self.layout.color, self._color[0]).header.frame_id)
        return self.layout.ground_truth(self.reader, frame)

    def _find_camera(self) -> PinholeCamera:
        """Prefer the published calibration of TUM: their folder and bag must agree."""
        published = freiburg_camera(self.name) if self.reader.storage == 'ros1' else None
        if published is not None:
            return published.camera
        if self.layout.info in self.reader.topics:
            return self._first_usable_camera()
        raise DatasetError(
            f"'{self.reader.path}' has no message on '{self.layout.info}'; "
            'give the camera with --camera'
        )

    def _first_usable_camera(self) -> PinholeCamera:
        """Return the first camera that is calibrated and, if any is, of the size of the images."""
        shape = self._shape_of_color()
        found: PinholeCamera | None = None
        first_error: DatasetError | None = None
        for _, message in self.reader.messages([self.layout.info]):
            try:
                camera = camera_from_message(message, self.layout.info)
            except DatasetError as error:  # drivers send some before they know
                first_error = first_error or error
                continue
            if shape in (None, camera.shape):
                return camera
            found = found or camera
        if found is None:
            raise first_error or DatasetError(
                f"'{self.reader.path}' has no message on '{self.layout.info}'; "
                'give the camera with --camera'
            )
        return found

    def _shape_of_color(self) -> tuple[int, int] | None:
        for _, (_, message) in zip(
            range(_FIRST_FEW), self.reader.messages([self.layout.color]), strict=False
        ):
            with suppress(DatasetError):  # a damaged one costs itself alone
                return self._decode_color(message).shape[:2]
        return None

    def color_name(self, index: int) -> str:
        """Return topic and stamp of a colour image."""
        return f'{self.layout.color}@{format_stamp_ns(self._color[index].stamp_ns)}'

    def read_color(self, index: int) -> ColorImage:
        """Read one colour image, distorted."""
        return self._to_color(self.reader.read(self.layout.color, self._color[index]))

    def read_depth(self, index: int) -> DepthImage:
        """Read one depth image in metres, distorted."""
        return self._to_depth(self.reader.read(self.layout.depth, self._depth[index]))

    def _message(self, topic: str, ref: MessageRef) -> Any:
        return self.reader.deserialize(
            self.reader.read(topic, ref), self.reader.topics[topic].msgtype
        )

    def _to_color(self, data: bytes) -> ColorImage:
        topic = self.layout.color
        image = self._decode_color(
            self.reader.deserialize(data, self.reader.topics[topic].msgtype)
        )
        self._check_size(topic, image.shape[:2])
        return image

    def _decode_color(self, message: Any) -> ColorImage:
        packed = self.reader.topics[self.layout.color].msgtype == COMPRESSED_IMAGE
        return (color_from_compressed if packed else color_from_message)(
            message, self.layout.color
        )

    def _to_depth(self, data: bytes) -> DepthImage:
        topic = self.layout.depth
        kind = self.reader.topics[topic].msgtype
        decode = depth_from_compressed if kind == COMPRESSED_IMAGE else depth_from_message
        image = decode(self.reader.deserialize(data, kind), topic, self._depth_scale)
        self._check_size(topic, image.shape)
        return image

    def _check_size(self, topic: str, shape: tuple[int, ...]) -> None:
        if shape != self.camera.shape:
            raise DatasetError(
                f"topic '{topic}': expected images of shape {self.camera.shape} as in "
                f"'{self.layout.info}', received {shape}; depth must be registered to colour"
            )


def _stamps(refs: list[MessageRef]) -> NDArray[np.int64]:
    return np.array([ref.stamp_ns for ref in refs], dtype=np.int64)


@dataclass(frozen=True)
class CameraTopics:
    """What the topics of a camera are called in a bag; empty: found by their names."""

    color: str = ''
    depth: str = ''
    info: str = ''


def find_layout(reader: BagReader, given: CameraTopics | None = None) -> TopicLayout:
    """
    Find the camera's topics.

    Parameters
    ----------
    reader : BagReader
        The open bag.
    given : CameraTopics, optional
        Their names, as far as somebody has said them.

    Raises
    ------
    DatasetError
        If there are no colour and depth topics of these names, or of any that is known.

    """
    if given is None or not (given.color or given.depth):
        found = recognise(reader)
        return replace(found, info=given.info) if given is not None and given.info else found
    missing = [repr(t) for t in (given.color, given.depth) if t not in reader.topics]
    if missing:
        raise DatasetError(
            f"'{reader.path}' has no topic {', '.join(missing)}; give both the colour and the "
            f'depth topic; it has {", ".join(sorted(reader.topics))}'
        )
    return TopicLayout('given', given.color, given.depth, given.info or INFO_TOPIC)


def recognise(reader: BagReader) -> TopicLayout:
    """Find the layout whose colour and depth topics are in the bag; `DatasetError` if none."""
    for layout in LAYOUTS:
        color = _present(reader, layout.color, _COMPRESSED)
        depth = _present(reader, layout.depth, _COMPRESSED_DEPTH)
        if color and depth:
            return replace(layout, color=color, depth=depth)
    wanted = '\n'.join(f'  {x.name}: {x.color} and {x.depth}' for x in LAYOUTS)
    found = ', '.join(f'{t} ({i.msgtype})' for t, i in sorted(reader.topics.items()))
    raise DatasetError(
        f"'{reader.path}' has no known pair of colour and depth topics. Looked for\n{wanted}\n"
        f'found {found or "no topics"}; name them with --color-topic and --depth-topic (bdgs) or '
        'color_topic and depth_topic (slam_node)'
    )


def _present(reader: BagReader, topic: str, suffixes: tuple[str, ...]) -> str:
    """Return the name under which a topic is in a bag, raw or as image_transport packs it."""
    return next((topic + s for s in ('', *suffixes) if topic + s in reader.topics), '')


class BagSequence(RecordedSequence):
    """Rectified frames of a bag."""

    def __init__(
        self,
        path: Path | str,
        camera: PinholeCamera | None = None,
        max_difference_s: float = MAX_DIFFERENCE_S,
        allow_truncated: bool = False,
    ) -> None:
        recording = BagRecording(open_bag(path, allow_truncated), camera)
        super().__init__(recording, max_difference_s)
