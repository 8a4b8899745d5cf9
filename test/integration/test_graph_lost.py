"""A covered lens in the graph: LOST is said, no pose is published, and the camera comes back."""

from __future__ import annotations

import json
from pathlib import Path

import cv2
import numpy as np
import pytest

pytest.importorskip('rclpy', reason='needs rclpy')
pytestmark = [pytest.mark.ros, pytest.mark.slow]

from graph_processes import Graph  # noqa: E402

from bdgs_ros.core.config import BdgsConfig, with_values  # noqa: E402
from bdgs_ros.core.types import StampedPose, TrackingStatus, Trajectory  # noqa: E402
from bdgs_ros.data.bag_recording import BagSequence  # noqa: E402
from bdgs_ros.data.convert import convert  # noqa: E402
from bdgs_ros.data.synth.writer import write_recording  # noqa: E402
from bdgs_ros.data.trajectory_io import read_trajectory, write_trajectory  # noqa: E402
from bdgs_ros.mapping.history import History  # noqa: E402
from bdgs_ros.pipeline import BdgsSlam  # noqa: E402

FRAMES = 22
COVERED = range(8, 14)


@pytest.fixture(scope='module')
def covered_bag(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[int]]:
    """Put a lid on the lens for a few frames; returns the bag and all stamps (ns)."""
    folder = tmp_path_factory.mktemp('covered')
    write_recording(folder / 'synth', 'static', 5, FRAMES, size=(320, 240), jobs=1)
    for kind in ('rgb', 'depth'):
        files = sorted((folder / 'synth' / kind).glob('*.png'))
        for i in COVERED:
            image = cv2.imread(str(files[i]), cv2.IMREAD_UNCHANGED)
            cv2.imwrite(str(files[i]), np.zeros_like(image))
    convert(folder / 'synth', folder / 'bag')
    truth = read_trajectory(folder / 'synth' / 'groundtruth.txt')
    return folder / 'bag', truth.stamps_ns.tolist()


def test_a_covered_lens_in_the_graph(
    graph: Graph,
    covered_bag: tuple[Path, list[int]],
    settings: dict[str, object],
    tmp_path: Path,
) -> None:
    bag, stamps_ns = covered_bag
    out = tmp_path / 'out'
    slam = graph.node(
        'slam_node', bag=bag, output=out, exit_at_end=True, mode='lockstep', **settings
    )
    assert slam.wait(120.0) == 0, slam.text()
    found = read_trajectory(out / 'trajectory.txt')
    expected = [s for i, s in enumerate(stamps_ns) if i not in COVERED]
    assert found.stamps_ns.tolist() == expected
    report = json.loads((out / 'metrics.json').read_text())
    assert report['nodes']['tracking']['frames_lost'] == str(len(COVERED))
    assert report['nodes']['tracking']['frames_without_depth'] == str(len(COVERED))
    assert report['metrics']['frames_lost']['value'] == len(COVERED)
    assert report['metrics']['ate_rmse']['value'] < 2.0
    assert f'{len(COVERED)} lost' in slam.text()
    assert 'received an image of zeros or NaN' in slam.text()
    offline = without_ros(bag, settings)
    assert found.stamps_ns.tolist() == offline.stamps_ns.tolist()
    assert found.positions == pytest.approx(offline.positions, abs=1e-4)


@pytest.fixture(scope='module')
def carried_bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Carry the camera away between two frames; from there it comes back by itself."""
    folder = tmp_path_factory.mktemp('carried')
    synth = folder / 'synth'
    write_recording(synth, 'loop_room', 0, 96, size=(320, 240), jobs=1)
    order = [*range(8), *range(95, 2, -3)]
    truth = read_trajectory(synth / 'groundtruth.txt')
    for kind in ('rgb', 'depth'):
        rows = [line.split() for line in (synth / f'{kind}.txt').read_text().splitlines()]
        rows = [row for row in rows if row[0] != '#']
        seen = [f'{rows[i][0]} {rows[j][1]}' for i, j in enumerate(order)]
        (synth / f'{kind}.txt').write_text('\n'.join(seen))
    poses = [StampedPose(int(truth.stamps_ns[i]), truth.matrices[j]) for i, j in enumerate(order)]
    write_trajectory(synth / 'groundtruth.txt', Trajectory(tuple(poses)))
    convert(synth, folder / 'bag')
    return folder / 'bag'


@pytest.mark.parametrize('mode', ['lockstep', 'realtime'])
def test_what_was_seen_while_lost_joins_the_world(
    graph: Graph, carried_bag: Path, settings: dict[str, object], tmp_path: Path, mode: str
) -> None:
    out = tmp_path / 'out'
    slam = graph.node(
        'slam_node',
        bag=carried_bag,
        output=out,
        exit_at_end=True,
        mode=mode,
        rate=0.3,
        tracking__piece__patience_s=0.05,
        **settings,
    )
    assert slam.wait(120.0) == 0, slam.text()
    online, final = (
        read_trajectory(out / name) for name in ('trajectory.txt', 'trajectory_final.txt')
    )
    assert len(online) < 30
    assert len(final) >= 33, slam.text()
    assert set(online.stamps_ns.tolist()) < set(final.stamps_ns.tolist())
    assert 'a piece of map is joined' in slam.text()
    metrics = json.loads((out / 'metrics.json').read_text())['metrics']
    assert metrics['ate_rmse']['value'] < 2.0
    assert metrics['ate_final_rmse']['value'] < 2.0
    mapped_ns = History.from_document(
        json.loads((out / 'map_keyframes' / 'transforms.json').read_text())['bdgs']['history']
    ).stamps_ns
    assert any(online.stamps_ns[7] < stamp_ns < online.stamps_ns[8] for stamp_ns in mapped_ns)


def without_ros(bag: Path, settings: dict[str, object]) -> Trajectory:
    values = {name.replace('__', '.'): value for name, value in settings.items()}
    slam = BdgsSlam(with_values(BdgsConfig(), values))
    results = [slam.process(frame).tracking for frame in BagSequence(bag)]
    mapped = slam.mapper.history.stamps_ns
    assert mapped == [r.stamp_ns for r in results if r.is_keyframe]
    assert not {results[i].stamp_ns for i in COVERED} & set(mapped)
    return Trajectory(
        tuple(
            StampedPose(r.stamp_ns, r.T_world_camera)
            for r in results
            if r.status is TrackingStatus.OK
        )
    )
