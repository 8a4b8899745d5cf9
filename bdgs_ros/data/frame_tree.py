"""Fixed transforms between named frames, as tf carries them."""

from __future__ import annotations

from bdgs_ros.core import se3
from bdgs_ros.core.types import Pose


class FrameTree:
    """A tree of fixed transforms; names with and without a leading slash are the same."""

    def __init__(self) -> None:
        self._parents: dict[str, tuple[str, Pose]] = {}

    def add(self, parent: str, child: str, T_parent_child: Pose) -> None:
        """Add an edge; the first value of an edge stays."""
        self._parents.setdefault(clean(child), (clean(parent), T_parent_child))

    def lookup(self, ancestor: str, descendant: str) -> Pose | None:
        """Return `T_ancestor_descendant`, or None where no chain of edges leads up there."""
        frame, top = clean(descendant), clean(ancestor)
        T_frame_descendant = se3.identity()
        for _ in range(len(self._parents) + 1):
            if frame == top:
                return T_frame_descendant
            if frame not in self._parents:
                return None
            frame, T_parent_frame = self._parents[frame]
            T_frame_descendant = T_parent_frame @ T_frame_descendant
        return None

    def describe(self) -> str:
        """List the edges."""
        edges = [f'{parent}->{child}' for child, (parent, _) in sorted(self._parents.items())]
        return ', '.join(edges) or 'no transforms'


def clean(frame: str) -> str:
    """Drop the leading slash that ROS 1 puts before frame names."""
    return frame.lstrip('/')
