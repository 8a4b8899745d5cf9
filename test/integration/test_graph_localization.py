"""Localisation mode: the map stays as it is, and is shown wherever the camera is."""

from __future__ import annotations

import json
import os
import signal
import threading
import time
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = [pytest.mark.ros, pytest.mark.slow]

from diagnostic_msgs.msg import DiagnosticArray  # noqa: E402
from geometry_msgs.msg import PoseStamped  # noqa: E402
from graph_processes import Graph, Running  # noqa: E402
from rcl_interfaces.srv import SetParameters  # noqa: E402
from rclpy.node import Node  # noqa: E402
from rclpy.parameter import Parameter  # noqa: E402
from rclpy.subscription import Subscription  # noqa: E402
from sensor_msgs.msg import CameraInfo, Image  # noqa: E402
from std_srvs.srv import SetBool, Trigger  # noqa: E402

from bdgs_ros.bridge import conversions, topics  # noqa: E402
from bdgs_ros.core import se3  # noqa: E402
from bdgs_ros.core.config import BdgsConfig, with_values  # noqa: E402
from bdgs_ros.core.types import StampedPose, TrackingStatus, Trajectory  # noqa: E402
from bdgs_ros.data.bag_recording import BagSequence  # noqa: E402
from bdgs_ros.data.trajectory_io import POSE_COLUMNS, read_trajectory  # noqa: E402
from bdgs_ros.pipeline import BdgsSlam  # noqa: E402

HALF = 10  # frames that the map is made of
TURNED_AWAY = '0 0 0 0 0.7071 0 0.7071'  # by 90 degrees: nothing of the map is seen there
LATE = 15  # the camera is 1.6 cm from the origin then
DEATH = 16  # frames until tracking is killed: the camera is 2 cm from the origin then


@pytest.fixture(scope='module')
def made(bag: Path, settings: dict[str, object], tmp_path_factory) -> tuple[Path, StampedPose]:
    """Map the first half of the recording; return the map and where the camera was at the end."""
    folder = tmp_path_factory.mktemp('map')
    slam = BdgsSlam(config_of(settings))
    sequence = BagSequence(bag)
    last = [slam.process(sequence[i]).tracking for i in range(HALF)][-1]
    slam.mapper.save(folder / 'map.ply')
    return folder / 'map.ply', StampedPose(last.stamp_ns, last.T_world_camera)


def config_of(settings: dict[str, object]) -> BdgsConfig:
    return with_values(BdgsConfig(), {n.replace('__', '.'): v for n, v in settings.items()})


def files_of(map_file: Path) -> dict[str, bytes]:
    return {
        str(path.relative_to(map_file.parent)): path.read_bytes()
        for path in map_file.parent.rglob('*')
        if path.is_file()
    }


def as_text(pose: StampedPose, folder: Path) -> str:
    from bdgs_ros.data.trajectory_io import write_trajectory

    write_trajectory(folder / 'start.txt', Trajectory((pose,)))
    return (folder / 'start.txt').read_text().splitlines()[1].split(' ', 1)[1]


def localised(
    bag: Path, made: tuple[Path, StampedPose], settings: dict[str, object]
) -> Trajectory:
    """Localise without ROS, starting where the first half ended."""
    sequence = BagSequence(bag)
    slam = BdgsSlam(config_of(settings))
    slam.start_from(made[0], sequence.camera, made[1].T_world_camera, localise=True)
    copies = [made[0].parent.parent / f'{name}.ply' for name in ('loaded', 'afterwards')]
    slam.mapper.save(copies[0])
    results = [slam.process(sequence[i]).tracking for i in range(HALF, len(sequence))]
    slam.mapper.save(copies[1])
    loaded, afterwards = (copy.read_bytes() for copy in copies)
    assert afterwards == loaded  # in memory too the map is as it was
    return Trajectory(
        tuple(
            StampedPose(r.stamp_ns, r.T_world_camera)
            for r in results
            if r.status is TrackingStatus.OK
        )
    )


def wait_until_connected(readers: list[Subscription]) -> None:
    """What is published before its reader is known is lost, and ten frames are over at once."""
    deadline = time.monotonic() + 30
    while not all(reader.get_publisher_count() for reader in readers):
        assert time.monotonic() < deadline, 'nobody publishes what is rendered'
        time.sleep(0.1)
    time.sleep(1.0)  # for the other direction


def test_localising_in_a_saved_map(
    graph: Graph,
    ros: Callable,
    bag: Path,
    made: tuple[Path, StampedPose],
    settings: dict[str, object],
    tmp_path: Path,
) -> None:
    map_file, start = made
    before = files_of(map_file)
    expected = localised(bag, made, settings)
    assert files_of(map_file) == before
    assert len(expected) == len(BagSequence(bag)) - HALF - 1  # the second confirms the first
    shown: dict[str, dict[int, Image]] = {}
    readers = []
    with ros() as me:
        for topic in (topics.RENDERED_IMAGE, topics.RENDERED_DEPTH, topics.DYNAMIC_PROBABILITY):
            found = shown.setdefault(topic, {})
            reader = me.create_subscription(
                Image,
                topic,
                lambda message, found=found: found.update(
                    {conversions.stamp_ns(message): message}
                ),
                topics.RELIABLE,
            )
            readers.append(reader)
        out = tmp_path / 'out'
        slam = graph.node(
            'slam_node', bag=bag, output=out, exit_at_end=True, mode='lockstep',
            map_file=map_file, localization=True, start=seconds_in(bag, HALF),
            start_pose=f'"{as_text(start, tmp_path)}"', paused=True, **settings,
        )  # fmt: skip
        wait_until_connected(readers)
        play = me.create_client(SetBool, 'bdgs/replay/pause')
        assert play.wait_for_service(20.0)
        play.call_async(SetBool.Request(data=False))
        assert slam.wait(120.0) == 0, slam.text()
    live = read_trajectory(out / 'trajectory.txt')
    assert live.stamps_ns.tolist() == expected.stamps_ns.tolist()
    assert live.positions == pytest.approx(expected.positions, abs=1e-4)
    assert len(read_trajectory(out / 'trajectory_final.txt')) == len(live)
    for topic, images in shown.items():
        assert set(images) <= set(live.stamps_ns.tolist())
        assert len(images) >= 0.8 * len(live), topic
    (image, *_) = shown[topics.RENDERED_IMAGE].values()
    assert (image.width, image.height, image.encoding) == (160, 120, 'rgb8')
    assert np.frombuffer(image.data, np.uint8).mean() > 20
    # the map of the user is as it was, and no other was written
    assert files_of(map_file) == before
    assert not (out / 'map.ply').exists()
    metrics = json.loads((out / 'metrics.json').read_text())['metrics']
    assert metrics['frames_lost']['value'] == 1
    assert metrics['ate_final_rmse']['value'] < 2.0


def test_a_camera_that_is_elsewhere_in_the_map_is_found(
    graph: Graph, bag: Path, settings: dict[str, object], tmp_path: Path
) -> None:
    wide = {**settings, 'mapping__width': 320}
    slam = BdgsSlam(config_of(wide))
    sequence = BagSequence(bag)
    expected = [slam.process(sequence[i]).tracking.T_world_camera for i in range(HALF)]
    slam.mapper.save(tmp_path / 'map.ply')
    out = tmp_path / 'out'
    node = graph.node(
        'slam_node', bag=bag, output=out, exit_at_end=True, mode='lockstep',
        map_file=tmp_path / 'map.ply', localization=True,
        start_pose=f'"{TURNED_AWAY}"', **wide,
    )  # fmt: skip
    assert node.wait(120.0) == 0, node.text()
    assert 'places to recognise' in node.text()
    live = read_trajectory(out / 'trajectory.txt')
    assert len(live) > len(sequence) / 2, node.text()
    stamps = [frame.stamp_ns for frame in sequence]
    for stamp_ns, position in zip(live.stamps_ns, live.positions, strict=True):
        index = stamps.index(int(stamp_ns))
        if index < HALF:
            assert position == pytest.approx(expected[index][:3, 3], abs=0.02)


def test_a_map_that_is_loaded_at_run_time_is_where_tracking_looks_for_the_camera(
    graph: Graph, ros: Callable, bag: Path, settings: dict[str, object], tmp_path: Path
) -> None:
    """The places are those of the file: the view from start_pose shows nothing of the map."""
    wide = {**settings, 'mapping__width': 320}
    slam, sequence = BdgsSlam(config_of(wide)), BagSequence(bag)
    for i in range(HALF):
        slam.process(sequence[i])
    slam.mapper.save(tmp_path / 'map.ply')
    true = [pose.T_world_camera for pose in sequence.ground_truth.poses]
    expected = [(se3.inverse(true[0]) @ pose)[:3, 3] for pose in true]
    stamps = [frame.stamp_ns for frame in sequence]
    found: dict[int, np.ndarray] = {}
    states: list[str] = []
    node = graph.node(
        'slam_node', bag=bag, mode='lockstep', paused=True, lockstep_timeout_s=5.0,
        start=seconds_in(bag, LATE), output=tmp_path / 'out', **wide,
    )  # fmt: skip
    node.wait_for('playing', 90.0)
    with ros() as me:

        def keep(message: PoseStamped) -> None:
            pose = conversions.pose_from_message(message.pose)
            found[conversions.stamp_ns(message)] = pose[:3, 3]

        def note(message: DiagnosticArray) -> None:
            states.append(message.status[0].message)

        readers = [
            me.create_subscription(PoseStamped, topics.POSE, keep, topics.RELIABLE),
            me.create_subscription(DiagnosticArray, topics.STATUS, note, topics.RELIABLE),
        ]
        wait_until_connected(readers)
        step = stepper(me, states)
        step(1)
        assert np.linalg.norm(found[stamps[LATE]]) < 1e-6  # a world of its own
        before = set(found)
        set_parameters(
            me, '/mapping_node', map_file=str(tmp_path / 'map.ply'), start_pose=TURNED_AWAY
        )
        answer = call(me, Trigger, topics.LOAD_MAP, Trigger.Request())
        assert answer.success, answer.message
        step(3)
        after = [k for k in range(LATE, len(stamps)) if stamps[k] in set(found) - before]
        assert len(after) >= 2, (states, node.text())
        assert np.linalg.norm(expected[LATE]) > 0.015  # by so much the two worlds differ
        for k in after:
            assert np.linalg.norm(found[stamps[k]] - expected[k]) < 0.006
        missing = str(tmp_path / 'none.ply')
        set_parameters(me, '/mapping_node', map_file=missing)
        answer = call(me, Trigger, topics.LOAD_MAP, Trigger.Request())
        assert not answer.success and 'none.ply' in answer.message
        step(1)
        assert states[-1] == 'ok'  # the map that it has is still the one it had
    assert 'places to recognise' in node.text()


def call(me: Node, kind: type, name: str, request: object) -> object:
    client = me.create_client(kind, name)
    assert client.wait_for_service(20.0)
    done = threading.Event()
    future = client.call_async(request)
    future.add_done_callback(lambda _: done.set())
    assert done.wait(30.0), name
    return future.result()


def set_parameters(me: Node, node: str, **values: str) -> None:
    parameters = [Parameter(n, value=v).to_parameter_msg() for n, v in values.items()]
    request = SetParameters.Request(parameters=parameters)
    answer = call(me, SetParameters, f'{node}/set_parameters', request)
    assert all(result.successful for result in answer.results)


def stepper(me: Node, states: list[str]) -> Callable[[int], None]:
    """Return what plays so many frames; each has its status at the end."""
    client = me.create_client(Trigger, topics.REPLAY_STEP)
    assert client.wait_for_service(20.0)

    def step(count: int) -> None:
        for _ in range(count):
            before, deadline = len(states), time.monotonic() + 30
            client.call_async(Trigger.Request())
            while len(states) == before:
                assert time.monotonic() < deadline, states
                time.sleep(0.01)
        time.sleep(0.2)  # the pose is on another topic

    return step


def seconds_in(bag: Path, index: int) -> float:
    """Return how far into the recording a frame is, a little early."""
    stamps = [frame.stamp_ns for frame in BagSequence(bag)]
    return (stamps[index] - stamps[0]) * 1e-9 - 0.005


def test_tracking_that_died_comes_back_into_its_world(
    graph: Graph, ros: Callable, bag: Path, offline: Trajectory, settings: dict[str, object]
) -> None:
    found: dict[int, np.ndarray] = {}
    slam = graph.node(
        'slam_node', bag=bag, mode='lockstep', paused=True, lockstep_timeout_s=5.0,
        **settings,
    )  # fmt: skip
    slam.wait_for('playing', 90.0)

    def keep(message: PoseStamped) -> None:
        pose = conversions.pose_from_message(message.pose)
        found[conversions.stamp_ns(message)] = pose[:3, 3]

    def play(steps: int, node: Node) -> None:
        client = node.create_client(Trigger, topics.REPLAY_STEP)
        assert client.wait_for_service(20.0)
        for _ in range(steps):
            before, deadline = len(found), time.monotonic() + 7
            client.call_async(Trigger.Request())
            # a frame sent before its reader is discovered is lost, and replay goes on after 5 s
            while len(found) == before and time.monotonic() < deadline:
                time.sleep(0.01)

    with ros() as me:
        me.create_subscription(PoseStamped, topics.POSE, keep, topics.RELIABLE)
        info: list[CameraInfo] = []
        me.create_subscription(CameraInfo, topics.COLOR_INFO, info.append, topics.RELIABLE)
        camera = me.create_publisher(CameraInfo, topics.COLOR_INFO, topics.RELIABLE)
        play(DEATH, me)
        os.kill(pid_of(slam, 'tracking_node'), signal.SIGKILL)
        deadline = time.monotonic() + 30
        while slam.text().count('tracking is ready') < 2:
            assert time.monotonic() < deadline, slam.text()
            time.sleep(0.1)
        while camera.get_subscription_count() < 4:  # detection, tracking, mapping, this test
            assert time.monotonic() < deadline
            time.sleep(0.1)
        camera.publish(info[0])  # the recording's last one came to the dead process
        play(len(offline) - DEATH, me)
    stamps = offline.stamps_ns.tolist()
    assert set(stamps[:DEATH]) <= set(found)
    after = [k for k in range(DEATH, len(stamps)) if stamps[k] in found]
    assert len(after) >= 2, slam.text()
    expected = offline.positions[after]
    assert np.linalg.norm(expected, axis=1).min() > 0.015  # a new world would show
    live = np.array([found[stamps[k]] for k in after])
    assert live == pytest.approx(expected, abs=0.005)


def pid_of(slam: Running, name: str) -> int:
    pid = slam.process.pid
    children = Path(f'/proc/{pid}/task/{pid}/children').read_text().split()
    (found,) = (c for c in children if name in Path(f'/proc/{c}/cmdline').read_text())
    return int(found)


def test_there_must_be_a_map_to_localise_in(graph: Graph, tmp_path: Path) -> None:
    slam = graph.node('slam_node', localization=True)
    assert slam.wait(30.0) == 2
    assert "need 'map_file'" in slam.text()
    mapping = graph.node('mapping_node', localization=True, map_file=tmp_path / 'none.ply')
    assert mapping.wait(30.0) == 2
    assert 'none.ply' in mapping.text()


def test_a_start_pose_is_a_pose(graph: Graph) -> None:
    mapping = graph.node('mapping_node', start_pose='"1 2 3"')
    assert mapping.wait(30.0) == 2
    assert f"3 numbers for the pose '{POSE_COLUMNS}'" in mapping.text()
