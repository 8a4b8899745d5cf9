"""A camera turns once round in a room with people: drift shows when it is back, and goes."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np
import pytest

from bdgs_ros.back_end.back_end import BackEnd
from bdgs_ros.core import se3
from bdgs_ros.core.config import BackEndConfig, with_values
from bdgs_ros.core.types import Keyframe, Pose, RgbdFrame
from bdgs_ros.data.synth import room
from bdgs_ros.data.synth.plan import RecordingPlan
from bdgs_ros.data.synth.render import FrameRenderer

RATE_HZ = 3.0  # 10 degrees from keyframe to keyframe
KEYFRAMES = 42  # the last six look where the first ones did
DRIFT = 1.015  # of the turn: so much is the focal length too long
OFF = {'loop.enabled': False, 'bundle.older': 0}


@dataclass(frozen=True)
class Shot:
    """A keyframe with its true pose."""

    frame: RgbdFrame
    p_dynamic: np.ndarray
    T_world_camera: Pose


@pytest.fixture(scope='module')
def shots() -> list[Shot]:
    plan = RecordingPlan('loop_room', 0, KEYFRAMES, 240, 180, RATE_HZ)
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(room, 'WALL_DENSITY', 80.0)
        patch.setattr(room, 'FURNITURE_DENSITY', 120.0)
        patch.setattr(room, 'PRINT_DENSITY', 160.0)
        world = plan.world()
        renderer = FrameRenderer(world, plan.camera, 0.0)
    found = []
    for i in range(KEYFRAMES):
        time_s = plan.time_s(i)
        images = renderer.render(time_s)
        moving = np.isin(images.object_id, world.scene.moving_ids(time_s))
        color = np.clip(images.color, 0, 255).astype(np.uint8)
        frame = RgbdFrame(plan.stamp_ns(i), color, images.depth_m.astype(np.float32), plan.camera)
        found.append(Shot(frame, moving.astype(np.uint8) * 255, world.camera_path.pose(time_s)))
    return found


@dataclass(frozen=True)
class Outcome:
    """What the back end made of a turn."""

    turn_error_deg: float
    """Of the last keyframe to the first."""
    moved_m: float
    """The farthest that a keyframe was moved at once."""
    loops: int


def turn_round(shots: list[Shot], values: Mapping[str, object]) -> Outcome:
    """Go once round with a camera whose focal length is thought to be too long."""
    back_end = BackEnd(with_values(BackEndConfig(), {'bundle.window': 3, **values}))
    poses: dict[int, Pose] = {}
    tracked, moved_m = se3.identity(), 0.0
    for i, shot in enumerate(shots):
        if i:
            step = se3.log(se3.inverse(shots[i - 1].T_world_camera) @ shot.T_world_camera)
            tracked = tracked @ se3.exp(step * np.repeat([1, DRIFT], 3))
        camera = shot.frame.camera
        camera = replace(camera, fx=camera.fx * DRIFT, fy=camera.fy * DRIFT)
        frame = replace(shot.frame, camera=camera)
        moved = back_end.process(Keyframe(frame, tracked, shot.p_dynamic), poses)
        poses[frame.stamp_ns] = tracked
        for stamp_ns, T_new_old in moved.items():
            new = se3.orthonormalise(T_new_old @ poses[stamp_ns])
            moved_m = max(moved_m, float(np.linalg.norm((new - poses[stamp_ns])[:3, 3])))
            poses[stamp_ns] = new
        tracked = poses[frame.stamp_ns]
    true = se3.inverse(shots[0].T_world_camera) @ shots[-1].T_world_camera
    off = se3.inverse(true) @ se3.inverse(poses[shots[0].frame.stamp_ns]) @ tracked
    return Outcome(float(np.rad2deg(se3.rotation_angle_rad(off))), moved_m, back_end.loops)


def test_a_turn_in_a_room_is_closed(shots: list[Shot]) -> None:
    left = turn_round(shots, OFF)
    closed = turn_round(shots, {})
    assert left.loops == 0
    assert left.turn_error_deg > 1.5
    assert closed.loops > 0
    assert closed.turn_error_deg < 0.75
    assert 0.01 < closed.moved_m < 0.3
