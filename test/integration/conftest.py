"""A small recording, what the pipeline makes of it without ROS, and a graph to start."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from graph_processes import Graph

from bdgs_ros.core.config import BdgsConfig, with_values
from bdgs_ros.core.types import Trajectory

FRAMES = 20
SETTINGS = {
    'mapping.width': 160,
    'mapping.iterations': 4,
    'mapping.threads': 1,
    'tracking.keyframe.max_interval': 5,
}


@pytest.fixture(scope='session')
def settings() -> dict[str, object]:
    """Return parameters that make a run short, as `Graph.node` takes them."""
    return {name.replace('.', '__'): value for name, value in SETTINGS.items()}


@pytest.fixture(scope='session')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Make a recording with people in it and convert it."""
    from bdgs_ros.data.convert import convert
    from bdgs_ros.data.synth.writer import write_recording

    folder = tmp_path_factory.mktemp('recording')
    write_recording(folder / 'synth', 'walking_xyz', 5, FRAMES, size=(320, 240), jobs=1)
    convert(folder / 'synth', folder / 'bag')
    return folder / 'bag'


@pytest.fixture(scope='session')
def offline(offline_run: tuple[Trajectory, Trajectory]) -> Trajectory:
    """Return the trajectory that `BdgsSlam` finds in the same recording."""
    return offline_run[0]


@pytest.fixture(scope='session')
def offline_final(offline_run: tuple[Trajectory, Trajectory]) -> Trajectory:
    """Return the same trajectory with what mapping found out later."""
    return offline_run[1]


@pytest.fixture(scope='session')
def offline_run(bag: Path) -> tuple[Trajectory, Trajectory]:
    """Run the same recording through `BdgsSlam`."""
    from bdgs_ros.core.types import StampedPose, TrackingStatus
    from bdgs_ros.data.bag_recording import BagSequence
    from bdgs_ros.pipeline import BdgsSlam

    slam = BdgsSlam(with_values(BdgsConfig(), SETTINGS))
    results = [slam.process(frame).tracking for frame in BagSequence(bag)]
    assert len(results) == FRAMES
    online = Trajectory(
        tuple(
            StampedPose(r.stamp_ns, r.T_world_camera)
            for r in results
            if r.status is TrackingStatus.OK
        )
    )
    return online, slam.mapper.final_trajectory(online)


@pytest.fixture
def graph(tmp_path: Path) -> Iterator[Graph]:
    """Give a graph whose processes end with the test."""
    with Graph(tmp_path) as graph:
        yield graph


@pytest.fixture
def ros(graph: Graph, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable]:
    """Give a function that makes a spinning node in the graph's domain, in this process."""
    import threading

    import rclpy
    from rclpy.context import Context
    from rclpy.executors import SingleThreadedExecutor
    from rclpy.node import Node

    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'LOCALHOST')
    context = Context()
    rclpy.init(context=context, domain_id=graph.domain)

    @contextmanager
    def spinning() -> Iterator[Node]:
        node = Node('test', context=context)
        executor = SingleThreadedExecutor(context=context)
        executor.add_node(node)
        stop = threading.Event()

        def spin() -> None:
            while not stop.is_set():
                executor.spin_once(timeout_sec=0.1)

        thread = threading.Thread(target=spin)
        thread.start()
        try:
            yield node
        finally:
            stop.set()
            thread.join()
            node.destroy_node()

    yield spinning
    rclpy.shutdown(context=context)
