"""The graph and a recording: `ros2 launch bdgs_ros replay.launch.py bag:=PATH`."""

import sys
from pathlib import Path

from launch import LaunchDescription

sys.path.insert(0, str(Path(__file__).resolve().parent))

import _args


def generate_launch_description():
    """Return the graph with the replay."""
    return LaunchDescription(
        [
            *_args.declare_graph(),
            *_args.declare_replay(),
            *_args.graph_nodes(),
            _args.replay_node(),
        ]
    )
