"""Bad input, section 6 of the specification: one clear message, and nothing crashes."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = [pytest.mark.ros, pytest.mark.slow]

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from graph_processes import Graph  # noqa: E402
from rclpy.qos import QoSProfile, ReliabilityPolicy  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image  # noqa: E402

REFUSED = 2
MS = 1_000_000


def test_misspelt_parameters_are_refused(graph: Graph) -> None:
    node = graph.node('tracking_node', tracking__motion__gate_sigm=3.0)
    assert node.wait(30.0) == REFUSED
    assert "unknown parameter 'tracking.motion.gate_sigm'; did you mean" in node.text()
    assert 'Traceback' not in node.text()


def test_values_out_of_range_are_refused_before_anything_starts(graph: Graph) -> None:
    slam = graph.node('slam_node', mapping__iterations=-3)
    assert slam.wait(30.0) == REFUSED
    assert "'mapping.iterations' = -3 is refused: allowed is 0 to 1000" in slam.text()
    assert 'is ready' not in slam.text()


def test_a_truncated_bag_is_named(graph: Graph, bag: Path, tmp_path: Path) -> None:
    broken = tmp_path / 'broken'
    shutil.copytree(bag, broken)
    (file,) = broken.glob('*.mcap')
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])
    slam = graph.node('slam_node', bag=broken, output=tmp_path / 'out', exit_at_end=True)
    assert slam.wait(60.0) == REFUSED
    assert f"'{broken}' cannot be read as a bag" in slam.text()
    assert 'Traceback' not in slam.text()


def test_no_bag_is_named(graph: Graph, tmp_path: Path) -> None:
    replay = graph.node('replay_node', bag=tmp_path / 'absent')
    assert replay.wait(30.0) == REFUSED
    assert f"there is no bag at '{tmp_path / 'absent'}'" in replay.text()


def test_silence_is_named_within_five_seconds(graph: Graph) -> None:
    node = graph.node('tracking_node')
    node.wait_for('tracking is ready', 40.0)
    text = node.wait_for('never received anything', 5.0)
    assert "'/camera/color/image_raw', '/camera/depth/image_raw'" in text
    assert 'no publisher' in text


class Camera:
    """A camera that can do everything wrong."""

    def __init__(self, node: object, qos: object = 10) -> None:
        self._color = node.create_publisher(Image, 'camera/color/image_raw', qos)
        self._depth = node.create_publisher(Image, 'camera/depth/image_raw', qos)
        self._info = node.create_publisher(CameraInfo, 'camera/color/camera_info', qos)
        self._stamp_ns = 1_000_000_000

    def wait(self) -> None:
        deadline = time.monotonic() + 20
        while not self._depth.get_subscription_count() or not self._info.get_subscription_count():
            assert time.monotonic() < deadline, 'nobody listens'
            time.sleep(0.05)
        time.sleep(0.5)

    def send(self, depth: np.ndarray | None, encoding: str = '32FC1') -> None:
        self._stamp_ns += 33 * MS
        info = CameraInfo(width=64, height=48, distortion_model='plumb_bob')
        info.k = [60.0, 0.0, 31.5, 0.0, 60.0, 23.5, 0.0, 0.0, 1.0]
        self._stamp(info)
        self._info.publish(info)
        self._color.publish(self._image(np.full((48, 64, 3), 99, np.uint8), 'rgb8'))
        if depth is not None:
            self._depth.publish(self._image(depth, encoding))

    def _image(self, array: np.ndarray, encoding: str) -> Image:
        image = Image(
            height=array.shape[0],
            width=array.shape[1],
            encoding=encoding,
            step=array.nbytes // array.shape[0],
        )
        image.data = array.tobytes()
        self._stamp(image)
        return image

    def _stamp(self, message: object) -> None:
        seconds, nanoseconds = divmod(self._stamp_ns, 10**9)
        message.header.stamp.sec, message.header.stamp.nanosec = seconds, nanoseconds
        message.header.frame_id = 'camera'


def test_depth_of_another_size_or_encoding(graph: Graph, ros: Callable) -> None:
    node = graph.node('tracking_node')
    node.wait_for('tracking is ready', 40.0)
    states: list[str] = []
    with ros() as me:
        me.create_subscription(
            DiagnosticArray, 'bdgs/status', lambda m: states.append(m.status[0].message), 10
        )
        camera = Camera(me)
        camera.wait()

        def send_until(words: str, depth: np.ndarray, encoding: str) -> None:
            deadline = time.monotonic() + 10
            while words not in node.text():
                assert time.monotonic() < deadline, node.text()
                camera.send(depth, encoding)
                time.sleep(0.03)

        send_until(
            "'/camera/depth/image_raw': expected a depth image of 64x48",
            np.ones((24, 32), np.float32),
            '32FC1',
        )
        send_until("received 'rgb8'", np.ones((48, 64, 3), np.uint8), 'rgb8')
        send_until('more than 30 m in the median', np.full((48, 64), 1500, np.float32), '32FC1')
        send_until('zeros or NaN', np.full((48, 64), np.nan, np.float32), '32FC1')
        deadline = time.monotonic() + 5
        while 'lost' not in states and time.monotonic() < deadline:
            time.sleep(0.05)
    assert set(states) == {'skipped', 'lost'}  # without depth a lens may be covered
    assert node.stop() == 0  # nothing crashed
    assert node.text().count('expected a depth image of 64x48') == 1  # one message, not one each


def test_depth_without_partner_is_named(graph: Graph, ros: Callable) -> None:
    node = graph.node('tracking_node', silence_s=1.0)
    node.wait_for('tracking is ready', 40.0)
    with ros() as me:
        camera = Camera(me)
        camera.wait()
        deadline = time.monotonic() + 5
        while "'/camera/color/image_raw', '/camera/color/camera_info' did" not in node.text():
            assert time.monotonic() < deadline, node.text()
            camera.send(None)
            time.sleep(0.05)
    assert "'/camera/depth/image_raw': never received anything" in node.text()


def test_incompatible_quality_of_service_is_named(graph: Graph, ros: Callable) -> None:
    node = graph.node('tracking_node')
    node.wait_for('tracking is ready', 40.0)
    with ros() as me:
        Camera(me, QoSProfile(depth=5, reliability=ReliabilityPolicy.BEST_EFFORT))
        text = node.wait_for('offers a quality of service', 5.0)
    assert "'/camera/color/image_raw'" in text
    assert 'qos.reliability:=best_effort' in text
