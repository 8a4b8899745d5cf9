"""
ROS messages as rosbags decodes them, to and from arrays.

The same file serves ROS 1 and ROS 2: rosbags names their fields alike, except in CameraInfo.
"""

from __future__ import annotations

import struct
import sys
from functools import cache
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray
from rosbags.typesys import Stores, get_typestore
from rosbags.typesys.store import Typestore

from bdgs_ros.core import se3
from bdgs_ros.core.camera import DISTORTIONS, FISHEYE, PLUMB_BOB, RATIONAL, PinholeCamera
from bdgs_ros.core.errors import DatasetError
from bdgs_ros.core.images import metres
from bdgs_ros.core.types import ColorImage, DepthImage, Pose
from bdgs_ros.data.trajectory_io import NS_PER_S

IMAGE = 'sensor_msgs/msg/Image'
COMPRESSED_IMAGE = 'sensor_msgs/msg/CompressedImage'
CAMERA_INFO = 'sensor_msgs/msg/CameraInfo'
POSE_STAMPED = 'geometry_msgs/msg/PoseStamped'

_COLOR_CHANNELS = {'rgb8': 3, 'bgr8': 3, 'rgba8': 4, 'bgra8': 4, 'mono8': 1}
_TO_RGB = {
    'bgr8': cv2.COLOR_BGR2RGB,
    'rgba8': cv2.COLOR_RGBA2RGB,
    'bgra8': cv2.COLOR_BGRA2RGB,
    'mono8': cv2.COLOR_GRAY2RGB,
}
_DEPTH_TYPES = {'16UC1': 'u2', 'mono16': 'u2', '32FC1': 'f4'}
_MODELS = {
    '': PLUMB_BOB,
    'none': PLUMB_BOB,
    'radtan': PLUMB_BOB,
    'fisheye': FISHEYE,
    'kannala_brandt4': FISHEYE,
}
_DEPTH_HEADER = struct.Struct('<iff')
MM_PER_M = 1000.0


@cache
def jazzy() -> Typestore:
    """Return the message types of ROS 2 Jazzy."""
    return get_typestore(Stores.ROS2_JAZZY)


def stamp_ns(message: Any) -> int:
    """Return the header's stamp."""
    stamp = message.header.stamp
    return int(stamp.sec) * NS_PER_S + int(stamp.nanosec)


def color_from_message(message: Any, topic: str) -> ColorImage:
    """
    Decode a colour Image.

    Raises
    ------
    DatasetError
        If the encoding is not 8-bit colour or grey, or the data do not fill the image.

    """
    channels = _COLOR_CHANNELS.get(message.encoding)
    if channels is None:
        raise _unknown_encoding(message, topic, 'a colour image', _COLOR_CHANNELS)
    rows = _pixels(message, topic, np.dtype(np.uint8), channels)
    image = rows if channels == 1 else rows.reshape(message.height, message.width, channels)
    code = _TO_RGB.get(message.encoding)
    converted = np.ascontiguousarray(image) if code is None else cv2.cvtColor(image, code)
    return np.asarray(converted, dtype=np.uint8)


def depth_from_message(message: Any, topic: str, per_metre: float = MM_PER_M) -> DepthImage:
    """
    Decode a depth Image to metres: `16UC1` counts millimetres, `32FC1` metres, REP 118.

    What is not finite or not positive becomes 0, and so does the largest count of `16UC1`.
    Cameras that count otherwise need their `per_metre`: 10000 for 0.1 mm.

    Raises
    ------
    DatasetError
        If the encoding is none of these, or the data do not fill the image.

    """
    kind = _DEPTH_TYPES.get(message.encoding)
    if kind is None:
        raise _unknown_encoding(message, topic, 'a depth image', _DEPTH_TYPES)
    order = '>' if message.is_bigendian else '<'
    image = _pixels(message, topic, np.dtype(order + kind), 1)
    if kind == 'u2':
        return metres(image, per_metre)
    depth_m = image.astype(np.float32)
    depth_m[~(np.isfinite(depth_m) & (depth_m > 0))] = 0
    return depth_m


def color_from_compressed(message: Any, topic: str) -> ColorImage:
    """
    Decode a colour CompressedImage: JPEG, PNG or whatever else OpenCV reads.

    Raises
    ------
    DatasetError
        If it cannot be decoded.

    """
    image = _decoded(bytes(message.data), cv2.IMREAD_COLOR, message, topic)
    return np.asarray(cv2.cvtColor(image, cv2.COLOR_BGR2RGB), np.uint8)


def depth_from_compressed(message: Any, topic: str, per_metre: float = MM_PER_M) -> DepthImage:
    """
    Decode a depth CompressedImage, as `compressed_depth_image_transport` or a PNG of 16 bits.

    The former has a header of 12 bytes; what was float is `a / depth + b` there.

    Raises
    ------
    DatasetError
        If it cannot be decoded.

    """
    data = bytes(message.data)
    if 'compressedDepth' not in message.format:
        counts = _decoded(data, cv2.IMREAD_UNCHANGED, message, topic)
    else:
        counts = _decoded(data[_DEPTH_HEADER.size :], cv2.IMREAD_UNCHANGED, message, topic)
        if message.format.startswith('32FC1'):
            _, a, b = _DEPTH_HEADER.unpack_from(data)
            nearness = (counts.astype(np.float32) - b) / a
            return np.where((counts > 0) & (nearness > 0), 1 / np.maximum(nearness, 1e-6), 0)
    if counts.dtype != np.uint16 or counts.ndim != 2:
        raise DatasetError(
            f"topic '{topic}': expected depth of 16 bits, received '{message.format}' of "
            f'{counts.dtype} {counts.shape}'
        )
    return metres(counts, per_metre)


def unpacked_color(data: bytes, topic: str) -> bytes:
    """Return a CompressedImage in CDR as an Image in CDR; `DatasetError` if it is none."""
    message: Any = jazzy().deserialize_cdr(data, COMPRESSED_IMAGE)
    image = color_from_compressed(message, topic)
    return serialize_image(stamp_ns(message), message.header.frame_id, image, 'rgb8')


def unpacked_depth(data: bytes, topic: str) -> bytes:
    """Return a CompressedImage of depth in CDR as an Image in metres."""
    message: Any = jazzy().deserialize_cdr(data, COMPRESSED_IMAGE)
    depth_m = depth_from_compressed(message, topic)
    return serialize_image(stamp_ns(message), message.header.frame_id, depth_m, '32FC1')


def _decoded(data: bytes, flags: int, message: Any, topic: str) -> NDArray[Any]:
    image = cv2.imdecode(np.frombuffer(data, np.uint8), flags) if data else None
    if image is None:
        raise DatasetError(
            f"topic '{topic}': {len(data)} bytes of '{message.format}' cannot be decoded"
        )
    return np.asarray(image)


def _unknown_encoding(message: Any, topic: str, what: str, known: dict[str, Any]) -> DatasetError:
    return DatasetError(
        f"topic '{topic}': expected {what} encoded as {', '.join(known)}, "
        f"received '{message.encoding}'"
    )


def _pixels(message: Any, topic: str, dtype: np.dtype[Any], channels: int) -> NDArray[Any]:
    """View the data as an array of shape (H, W * channels), without the padding of rows."""
    height, width, step = int(message.height), int(message.width), int(message.step)
    row_bytes = width * channels * dtype.itemsize
    data = np.frombuffer(memoryview(message.data), dtype=np.uint8)
    if step < row_bytes or data.size < height * step or not height * width:
        raise DatasetError(
            f"topic '{topic}': a {width}x{height} '{message.encoding}' image needs rows of at "
            f'least {row_bytes} bytes, received step {step} and {data.size} bytes'
        )
    rows = data[: height * step].reshape(height, step)[:, :row_bytes]
    return np.ascontiguousarray(rows).view(dtype)


def camera_from_message(message: Any, topic: str) -> PinholeCamera:
    """
    Read a CameraInfo of ROS 1 or 2.

    Where K is empty and images are without distortion, the projection P serves as well: some
    drivers fill nothing else.

    Raises
    ------
    DatasetError
        If it is not calibrated, or its distortion is of a model that OpenCV does not know.

    """
    matrix = [float(value) for value in _field(message, 'k')]
    model, coefficients = _distortion(message, topic)
    if not any(matrix) and not any(coefficients):
        matrix = [float(value) for i, value in enumerate(_field(message, 'p')) if i % 4 < 3]
    finite = np.isfinite([*matrix, *coefficients]).all()
    if not (finite and matrix[0] > 0 and matrix[4] > 0 and message.width and message.height):
        raise DatasetError(
            f"topic '{topic}': camera_info is not calibrated "
            f'({message.width}x{message.height}, K = {matrix}, D = {list(coefficients)}); '
            'give the camera with --camera'
        )
    return PinholeCamera(
        int(message.width), int(message.height), matrix[0], matrix[4], matrix[2], matrix[5],
        coefficients, model,
    )  # fmt: skip


def _distortion(message: Any, topic: str) -> tuple[str, tuple[float, ...]]:
    """Return model and coefficients, by the name and by how many there are."""
    given = [float(value) for value in _field(message, 'd')]
    model = _MODELS.get(message.distortion_model, message.distortion_model)
    if not any(given):
        return PLUMB_BOB, (0.0,) * 5
    if model in (PLUMB_BOB, RATIONAL):  # some write plumb_bob and eight numbers, or the reverse
        while len(given) > 5 and not given[-1]:
            given.pop()
        model = PLUMB_BOB if len(given) <= 5 else RATIONAL
        most = max(DISTORTIONS[model])
        wanted = next((n for n in DISTORTIONS[model] if n >= max(len(given), 5)), most)
        given += [0.0] * (wanted - len(given))
    if len(given) not in DISTORTIONS.get(model, ()):
        raise DatasetError(
            f"topic '{topic}': expected one of the distortion models {', '.join(DISTORTIONS)}, "
            f"received '{message.distortion_model}' with {len(given)} coefficients; "
            'rectify the images first'
        )
    return model, tuple(given)


def _field(message: Any, name: str) -> Any:
    """Return a field that ROS 1 writes in capitals."""
    return getattr(message, name) if hasattr(message, name) else getattr(message, name.upper())


def pose_from_message(pose: Any) -> Pose:
    """Turn a geometry_msgs Pose into a matrix."""
    return _pose(pose.position, pose.orientation)


def pose_from_transform(transform: Any) -> Pose:
    """Turn a geometry_msgs Transform into a matrix."""
    return _pose(transform.translation, transform.rotation)


def _pose(position: Any, rotation: Any) -> Pose:
    return se3.from_position_quat_xyzw(
        np.array([position.x, position.y, position.z], dtype=float),
        np.array([rotation.x, rotation.y, rotation.z, rotation.w], dtype=float),
    )


def _header(at_ns: int, frame_id: str) -> Any:
    types = jazzy().types
    seconds, nanoseconds = divmod(at_ns, NS_PER_S)
    stamp = types['builtin_interfaces/msg/Time'](seconds, nanoseconds)
    return types['std_msgs/msg/Header'](stamp, frame_id)


def serialize_image(at_ns: int, frame_id: str, image: NDArray[Any], encoding: str) -> bytes:
    """Serialise an image array to CDR, in this machine's byte order."""
    height, width = image.shape[:2]
    data = np.ascontiguousarray(image).reshape(-1).view(np.uint8)
    message = jazzy().types[IMAGE](
        _header(at_ns, frame_id),
        height,
        width,
        encoding,
        int(sys.byteorder == 'big'),
        data.size // height,
        data,
    )
    return bytes(jazzy().serialize_cdr(message, IMAGE))


def serialize_camera_info(at_ns: int, frame_id: str, camera: PinholeCamera) -> bytes:
    """Serialise a camera with its distortion to CDR; the projection is of the same intrinsics."""
    types = jazzy().types
    projection = np.zeros((3, 4))
    projection[:, :3] = camera.matrix
    message = types[CAMERA_INFO](
        _header(at_ns, frame_id),
        camera.height,
        camera.width,
        camera.distortion_model,
        np.array(camera.distortion),
        camera.matrix.reshape(-1),
        np.eye(3).reshape(-1),
        projection.reshape(-1),
        0,
        0,
        types['sensor_msgs/msg/RegionOfInterest'](0, 0, 0, 0, False),
    )
    return bytes(jazzy().serialize_cdr(message, CAMERA_INFO))


def serialize_pose(at_ns: int, frame_id: str, T_world_camera: Pose) -> bytes:
    """Serialise a PoseStamped to CDR."""
    types = jazzy().types
    position, quat_xyzw = se3.to_position_quat_xyzw(T_world_camera)
    pose = types['geometry_msgs/msg/Pose'](
        types['geometry_msgs/msg/Point'](*(float(value) for value in position)),
        types['geometry_msgs/msg/Quaternion'](*(float(value) for value in quat_xyzw)),
    )
    message = types[POSE_STAMPED](_header(at_ns, frame_id), pose)
    return bytes(jazzy().serialize_cdr(message, POSE_STAMPED))
