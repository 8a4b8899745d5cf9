"""Where tracking comes into a map that exists: a view of it from about where the camera is."""

from __future__ import annotations

from pathlib import Path

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.errors import MapError
from bdgs_ros.core.types import NO_KEYFRAME_NS, ModelView, Pose
from bdgs_ros.mapping.mapper import Mapper

_LEAST_SEEN = 0.1  # of the view; with less there is nothing to align to


def entrance(mapper: Mapper, T_world_camera: Pose, camera: PinholeCamera, width: int) -> ModelView:
    """
    Render the map as tracking is shown it before its first frame.

    Parameters
    ----------
    mapper : Mapper
        Holds the map.
    T_world_camera : ndarray, shape (4, 4)
        About where the camera is.
    camera : PinholeCamera
        Of the frames, rectified.
    width : int
        Of the view at most, in pixels.

    """
    small = camera.scaled(min(1.0, width / camera.width))
    return mapper.view(NO_KEYFRAME_NS, T_world_camera, small)


def check_entrance(view: ModelView, map_file: Path) -> None:
    """Raise `MapError` if a view shows so little of the map that no frame can be aligned to it."""
    seen = float((view.depth_m > 0).mean())
    if seen < _LEAST_SEEN:
        position = ', '.join(f'{x:.2f}' for x in view.T_world_camera[:3, 3])
        raise MapError(
            f"'{map_file}' covers {100 * seen:.0f} % of the view from the start pose at "
            f'({position}) m; give another start pose'
        )
