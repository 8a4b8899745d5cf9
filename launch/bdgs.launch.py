"""Detection, tracking and mapping for a live camera: `ros2 launch bdgs_ros bdgs.launch.py`."""

import sys
from pathlib import Path

from launch import LaunchDescription

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _args


def generate_launch_description():
    """Return the graph."""
    return LaunchDescription([*_args.declare_graph(), *_args.graph_nodes()])
