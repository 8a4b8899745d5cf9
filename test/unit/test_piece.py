"""A lost camera makes a piece of map of its own; it joins the world, or takes its place."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BdgsConfig
from bdgs_ros.core.types import Pose, RgbdFrame, StampedPose, TrackingResult, TrackingStatus
from bdgs_ros.core.types import Trajectory as Poses
from bdgs_ros.data.synth.render import FrameRenderer
from bdgs_ros.data.synth.scenarios import make_world
from bdgs_ros.eval.recorder import Recorder
from bdgs_ros.pipeline import BdgsSlam, FrameResult
from bdgs_ros.tracking.piece import Explorer, Piece

CAMERA = PinholeCamera(160, 120, 133.8, 134.8, 79.9, 61.8)
STEP_NS = 33_333_333
CONFIG = BdgsConfig().tracking
HASTY = replace(CONFIG, piece=replace(CONFIG.piece, patience_s=0.05, least_s=0.1))
SURE = 1e-6 * np.eye(6)


@pytest.fixture(scope='module')
def way() -> tuple[list[RgbdFrame], list[Pose]]:
    """A camera in a room of a loop: 8 frames at one place, then 30 that come back to it."""
    world = make_world('loop_room', 0, 13.0)
    renderer = FrameRenderer(world, CAMERA, 0.01)
    times = [*np.arange(8) / 30, *np.linspace(1.8, 0.1, 30)]
    frames, poses = [], []
    for i, time_s in enumerate(times):
        images = renderer.render(time_s)
        color = np.ascontiguousarray(images.color).astype(np.uint8)
        depth = images.static_depth_m.astype(np.float32)
        frames.append(RgbdFrame((i + 1) * STEP_NS, color, depth, CAMERA))
        poses.append(world.camera_path.pose(time_s))
    return frames, [se3.inverse(poses[0]) @ pose for pose in poses]


def result(
    frame: RgbdFrame, pose: Pose, status: TrackingStatus = TrackingStatus.OK, moving: int = 0
) -> TrackingResult:
    mask = np.full(CAMERA.shape, moving, np.uint8)
    return TrackingResult(frame.stamp_ns, status, pose, SURE, False, mask)


def lost(frame: RgbdFrame) -> TrackingResult:
    return result(frame, np.eye(4), TrackingStatus.LOST)


def off_m(pose: Pose, truth: Pose) -> float:
    return float(np.linalg.norm(pose[:3, 3] - truth[:3, 3]))


def test_what_was_seen_while_lost_is_placed_once_the_camera_is_found(way: tuple) -> None:
    frames, poses = way
    explorer = Explorer(HASTY)
    for frame, pose in zip(frames[:8], poses, strict=False):
        assert explorer.follow(frame, None, result(frame, pose)) is None
    for frame in frames[8:30]:
        assert explorer.follow(frame, None, lost(frame)) is None
    assert explorer.length_s > 0.5
    piece = explorer.follow(frames[30], None, result(frames[30], poses[30]))
    assert piece is not None and not piece.is_new_world
    assert explorer.length_s == 0.0
    truth = {frame.stamp_ns: pose for frame, pose in zip(frames, poses, strict=True)}
    assert len(piece.poses) > 18
    assert frames[30].stamp_ns not in {pose.stamp_ns for pose in piece.poses}
    assert max(off_m(p.T_world_camera, truth[p.stamp_ns]) for p in piece.poses) < 0.02
    for keyframe, covariance in zip(piece.keyframes, piece.covariances, strict=True):
        offset = off_m(keyframe.T_world_camera, truth[keyframe.frame.stamp_ns])
        assert offset < 0.02
        assert offset < 5 * np.sqrt(np.trace(covariance[:3, :3]))


def test_a_short_loss_makes_no_piece(way: tuple) -> None:
    frames, poses = way
    explorer = Explorer(CONFIG)
    explorer.follow(frames[0], None, result(frames[0], poses[0]))
    for frame in frames[8:20]:
        assert explorer.follow(frame, None, lost(frame)) is None
    assert explorer.length_s == 0.0
    assert explorer.follow(frames[20], None, result(frames[20], poses[20])) is None


def followed(way: tuple, moving: int, is_known: bool = False) -> list[Piece | None]:
    """A world of eight frames, then nothing of it is recognised any more."""
    frames, poses = way
    explorer = Explorer(HASTY)
    explorer.reset(is_known)
    for frame, pose in zip(frames[:8], poses, strict=False):
        explorer.follow(frame, None, result(frame, pose, moving=moving))
    return [explorer.follow(frame, None, lost(frame)) for frame in frames[8:]]


def test_a_world_of_people_alone_is_given_up_for_what_stands_still(way: tuple) -> None:
    pieces = [piece for piece in followed(way, moving=255) if piece is not None]
    assert [piece.is_new_world for piece in pieces] == [True]
    (piece,) = pieces
    assert np.array_equal(piece.poses[0].T_world_camera, np.eye(4))
    assert piece.entrance().stamp_ns == piece.keyframes[-1].frame.stamp_ns


def test_a_world_that_was_well_seen_or_loaded_is_not_given_up(way: tuple) -> None:
    assert followed(way, moving=0) == [None] * 30
    assert followed(way, moving=255, is_known=True) == [None] * 30


def test_a_piece_can_be_switched_off(way: tuple) -> None:
    frames, _ = way
    explorer = Explorer(replace(HASTY, piece=replace(HASTY.piece, enabled=False)))
    for frame in frames:
        explorer.follow(frame, None, lost(frame))
    assert explorer.length_s == 0.0


def run(frames: list[RgbdFrame]) -> tuple[BdgsSlam, Recorder]:
    config = replace(BdgsConfig(), tracking=HASTY)
    slam, recorder = BdgsSlam(config), Recorder(max_samples=0)
    for frame in frames:
        outcome: FrameResult = slam.process(frame)
        if outcome.gave_up:
            recorder.give_up()
        recorder.add(frame, outcome.tracking, {})
    return slam, recorder


def test_the_final_trajectory_and_the_map_have_what_was_seen_while_lost(way: tuple) -> None:
    """The camera is carried away with its eyes shut, and comes back."""
    frames, poses = way
    slam, recorder = run(frames)
    online = recorder.result().trajectory
    final: Poses = slam.mapper.final_trajectory(online)
    assert len(online) < 31 < 35 <= len(final)
    truth = {frame.stamp_ns: pose for frame, pose in zip(frames, poses, strict=True)}
    assert max(off_m(p.T_world_camera, truth[p.stamp_ns]) for p in online.poses) < 0.02
    assert max(off_m(p.T_world_camera, truth[p.stamp_ns]) for p in final.poses) < 0.03
    seen_ns = slam.mapper.keyframe_poses()
    assert any(frames[8].stamp_ns <= stamp_ns < frames[16].stamp_ns for stamp_ns in seen_ns)
    one = StampedPose(frames[2].stamp_ns, poses[2])
    assert off_m(slam.mapper.final_pose(*vars(one).values()), poses[2]) < 0.03


def test_a_start_that_shows_nothing_is_given_up(way: tuple) -> None:
    """The camera is switched on before a plain wall, and nobody can say where that was."""
    frames, poses = way
    wall = replace(
        frames[0],
        color=np.full_like(frames[0].color, 190),
        depth_m=np.full_like(frames[0].depth_m, 1.2),
    )
    begin = [replace(wall, stamp_ns=frame.stamp_ns) for frame in frames[:8]]
    slam, recorder = run([*begin, *frames[8:]])
    rows = recorder.result().rows
    assert all(row.status is TrackingStatus.LOST for row in rows[:8])
    online = recorder.result().trajectory
    assert len(online) > 5
    final = slam.mapper.final_trajectory(online)
    assert len(final) > 25
    origin = poses[[frame.stamp_ns for frame in frames].index(final.poses[0].stamp_ns)]
    truth = {f.stamp_ns: se3.inverse(origin) @ T for f, T in zip(frames, poses, strict=True)}
    assert max(off_m(p.T_world_camera, truth[p.stamp_ns]) for p in final.poses) < 0.03
