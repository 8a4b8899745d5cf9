"""The view that tracking comes into a map by."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import MapError
from bdgs_ros.core.types import NO_KEYFRAME_NS
from bdgs_ros.mapping.entrance import check_entrance, entrance


class Room:
    """Stands for the mapper: a wall before the origin, nothing elsewhere."""

    def view(self, stamp_ns, T_world_camera, camera):
        from bdgs_ros.core.types import ModelView

        ahead = T_world_camera[2, 2] > 0
        depth_m = np.full(camera.shape, 2.0 if ahead else 0.0, np.float32)
        zero = np.zeros(camera.shape, np.uint8)
        return ModelView(stamp_ns, T_world_camera, camera, np.dstack([zero] * 3), depth_m, zero)


CAMERA = PinholeCamera(640, 480, 500.0, 500.0, 319.5, 239.5)


@pytest.mark.parametrize(('width', 'shape'), [(320, (240, 320)), (1280, (480, 640))])
def test_it_is_of_the_size_of_the_map_and_answers_no_keyframe(width, shape):
    view = entrance(Room(), se3.identity(), CAMERA, width)
    assert view.camera.shape == shape
    assert view.stamp_ns == NO_KEYFRAME_NS
    check_entrance(view, Path('map.ply'))


def test_a_start_pose_that_sees_nothing_is_refused():
    turned = se3.exp(np.array([0.0, 0, 0, 0, np.pi, 0]))
    turned[:3, 3] = 1.0, 2.0, 3.0
    view = entrance(Room(), turned, CAMERA, 320)
    with pytest.raises(MapError, match=r"'map.ply' covers 0 % .* \(1.00, 2.00, 3.00\) m"):
        check_entrance(view, Path('map.ply'))
