"""The launch arguments that both launch files share, each described, and the nodes they feed."""

from launch.actions import DeclareLaunchArgument
from launch.conditions import IfCondition
from launch.substitutions import (
    EnvironmentVariable,
    LaunchConfiguration,
    PathJoinSubstitution,
)
from launch_ros.actions import Node
from launch_ros.parameter_descriptions import ParameterValue
from launch_ros.substitutions import FindPackageShare

PACKAGE = 'bdgs_ros'
# As in bdgs_ros.nodes, which slam_node reads: how a process takes memory.
MEMORY = (
    'glibc.malloc.arena_max=1:glibc.malloc.mmap_threshold=33554432'
    ':glibc.malloc.trim_threshold=268435456:glibc.malloc.hugetlb=1'
)
NODES = ('detection_node', 'tracking_node', 'mapping_node')
# (name, default, description); a default of None is filled in below
GRAPH_ARGUMENTS = (
    ('namespace', '', 'namespace of all nodes and of every relative topic'),
    ('params_file', None, 'ROS 2 parameter file; the default lists every parameter'),
    ('mode', 'realtime', 'realtime: never wait; lockstep: wait, drop nothing, repeatable'),
    ('weights', '', 'YOLOv5 ONNX file; empty: the class-agnostic geometric prior alone'),
    ('reliability', 'reliable', 'of the camera topics: reliable or best_effort'),
    ('color', 'camera/color/image_raw', 'topic of the colour images'),
    ('color_info', 'camera/color/camera_info', 'topic of the camera calibration'),
    ('depth', 'camera/depth/image_raw', 'topic of the depth images, registered to colour'),
    ('map_file', '', 'where bdgs/save_map writes and bdgs/load_map reads'),
    ('load_at_start', 'false', 'begin in the map of map_file, if it exists, and go on mapping'),
    ('localization', 'false', 'begin in the map of map_file and leave it as it is'),
    ('start_pose', '', 'about where the camera starts in that map: x y z qx qy qz qw'),
    ('trajectory_file', '', 'where bdgs/save_trajectory writes, and the end of the node'),
    ('final_trajectory_file', '', 'the same of bdgs/save_final_trajectory'),
    ('use_sim_time', 'false', 'take the time from /clock'),
    ('rviz', 'false', 'open rviz with a view of map, pose and renders'),
)
REPLAY_ARGUMENTS = (
    ('bag', None, 'recording to replay'),
    ('rate', '1.0', 'speed of real-time replay'),
    ('start', '0.0', 'offset into the recording in seconds'),
    ('duration', '0.0', 'seconds to play; 0: all'),
    ('loop', 'false', 'begin again at the end'),
)


def share(*parts):
    """Return a path below the package's share folder."""
    return PathJoinSubstitution([FindPackageShare(PACKAGE), *parts])


def declare_graph():
    """Declare the arguments of the graph."""
    defaults = {'params_file': share('config', 'bdgs.yaml')}
    return [
        DeclareLaunchArgument(
            name, default_value=defaults.get(name, default), description=description
        )
        for name, default, description in GRAPH_ARGUMENTS
    ]


def declare_replay():
    """Declare the arguments of the replay; `bag` has no default, so it must be given."""
    return [
        DeclareLaunchArgument(name, description=description)
        if default is None
        else DeclareLaunchArgument(name, default_value=default, description=description)
        for name, default, description in REPLAY_ARGUMENTS
    ]


def _value(name, kind):
    return ParameterValue(LaunchConfiguration(name), value_type=kind)


def _parameters():
    return [
        LaunchConfiguration('params_file'),
        {
            'mode': _value('mode', str),
            'qos.reliability': _value('reliability', str),
            'detection.weights': _value('weights', str),
            'map_file': _value('map_file', str),
            'load_at_start': _value('load_at_start', bool),
            'localization': _value('localization', bool),
            'start_pose': _value('start_pose', str),
            'trajectory_file': _value('trajectory_file', str),
            'final_trajectory_file': _value('final_trajectory_file', str),
            'use_sim_time': _value('use_sim_time', bool),
        },
    ]


def _remappings():
    return [
        ('camera/color/image_raw', LaunchConfiguration('color')),
        ('camera/color/camera_info', LaunchConfiguration('color_info')),
        ('camera/depth/image_raw', LaunchConfiguration('depth')),
    ]


def _node(executable, parameters, **options):
    return Node(
        package=PACKAGE,
        executable=executable,
        namespace=LaunchConfiguration('namespace'),
        parameters=parameters,
        remappings=_remappings(),
        output='screen',
        additional_env={
            'GLIBC_TUNABLES': EnvironmentVariable('GLIBC_TUNABLES', default_value=MEMORY)
        },
        **options,
    )


def graph_nodes():
    """Return detection, tracking and mapping, each started again when it dies, and rviz."""
    rviz = Node(
        package='rviz2',
        executable='rviz2',
        arguments=['-d', share('rviz', 'bdgs.rviz')],
        condition=IfCondition(LaunchConfiguration('rviz')),
    )
    nodes = [_node(name, _parameters(), respawn=True, respawn_delay=1.0) for name in NODES]
    return [*nodes, rviz]


def replay_node():
    """Return the replay, which waits for the three nodes of the graph."""
    values = {
        'bag': _value('bag', str),
        'rate': _value('rate', float),
        'start': _value('start', float),
        'duration': _value('duration', float),
        'loop': _value('loop', bool),
        'wait_subscribers': len(NODES),
    }
    return _node('replay_node', [*_parameters(), values])
