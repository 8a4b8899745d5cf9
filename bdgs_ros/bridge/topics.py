"""Topic and service names, frame ids and quality of service: each named once."""

from __future__ import annotations

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

from bdgs_ros.bridge.node_config import QosConfig

COLOR = 'camera/color/image_raw'
COLOR_INFO = 'camera/color/camera_info'
DEPTH = 'camera/depth/image_raw'

LABELS = 'bdgs/labels'
DETECTIONS = 'bdgs/detections'
POSE = 'bdgs/pose'
ODOMETRY = 'bdgs/odometry'
PATH = 'bdgs/path'
KEYFRAMES = 'bdgs/keyframes'
STATUS = 'bdgs/status'
"""One message per image that tracking took: the acknowledgement that lockstep waits for."""
KEYFRAME = 'bdgs/keyframe'
KEYFRAME_MOVING = 'bdgs/keyframe/moving'
"""What is large in a keyframe and moves on its own though no label says so, mono8."""
SHED = 'bdgs/shed'
"""What is to be left out so that tracking keeps up, see `bridge.governor`."""
MOVE = 'bdgs/move'
"""By what tracking moved the present before a frame: it learnt where its keyframes are."""
PIECE = 'bdgs/piece'
"""The poses of frames that were seen while the camera was lost, once it is known where."""
PIECE_KEYFRAME = 'bdgs/piece/keyframe'
"""Which of them mapping shall keep the images of; the pose is in the piece."""
DEPTH_OFFSET = 'bdgs/depth_offset'
"""By how much stamps of depth are late, s, if tracking has measured it and may correct it."""
MODEL_IMAGE = 'bdgs/model/image'
MODEL_DEPTH = 'bdgs/model/depth'
MODEL_DYNAMIC = 'bdgs/model/dynamic'
MODEL_POSE = 'bdgs/model/pose'
MODEL_READOUT = 'bdgs/model/readout'
"""Where mapping now knows the keyframe to be that the model images show."""
RENDERED_IMAGE = 'bdgs/rendered/image'
RENDERED_DEPTH = 'bdgs/rendered/depth'
DYNAMIC_PROBABILITY = 'bdgs/dynamic_probability'
MAP = 'bdgs/map'
RESET_EVENT = 'bdgs/reset_event'
"""Tracking tells the other nodes that it forgot everything."""

MAP_REQUEST = 'bdgs/map_request'
"""Tracking asks to be shown the map that it is to begin in."""
LOCALIZATION = 'bdgs/localization'
"""Whether the map is frozen."""
MAP_LOADED = 'bdgs/map_loaded'
"""The file of the map that bdgs/load_map has put in place of the one before; empty: none."""

TF = '/tf'
CLOCK = '/clock'
DIAGNOSTICS = '/diagnostics'

RESET = 'bdgs/reset'
PAUSE = 'bdgs/pause'
SET_LOCALIZATION_MODE = 'bdgs/set_localization_mode'
SAVE_MAP = 'bdgs/save_map'
LOAD_MAP = 'bdgs/load_map'
SAVE_TRAJECTORY = 'bdgs/save_trajectory'
SAVE_FINAL_TRAJECTORY = 'bdgs/save_final_trajectory'
REPLAY_PAUSE = 'bdgs/replay/pause'
REPLAY_STEP = 'bdgs/replay/step'

RELIABLE = QoSProfile(depth=100, reliability=ReliabilityPolicy.RELIABLE)
"""Small messages: every one counts, also after a stall of three seconds."""
KEPT = QoSProfile(
    depth=10,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Labels: those published before a subscriber was discovered still reach it."""
MODELS = QoSProfile(
    depth=4,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""Model views, likewise; they are large, so fewer are kept. One part missing spoils a view."""
LATCHED = QoSProfile(
    depth=1,
    reliability=ReliabilityPolicy.RELIABLE,
    durability=DurabilityPolicy.TRANSIENT_LOCAL,
)
"""The last message waits for subscribers that come late."""


def image_qos(config: QosConfig) -> QoSProfile:
    """Return the profile of the camera topics, which live drivers may publish best-effort."""
    policies = {
        'reliable': ReliabilityPolicy.RELIABLE,
        'best_effort': ReliabilityPolicy.BEST_EFFORT,
    }
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=config.depth,
        reliability=policies[config.reliability],
    )
