"""
A DDS program without ROS, of another vendor: it reads two topics of the graph.

Usage: cyclone_subscriber.py DOMAIN POSES SECONDS REPORT
"""

import json
import sys
import time
from dataclasses import dataclass
from pathlib import Path

from cyclonedds.core import Policy, Qos
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct
from cyclonedds.idl.types import float64, int32, sequence, uint8, uint32
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration

CONFIG = """<CycloneDDS><Domain id="any">
<General><Interfaces><NetworkInterface name="lo" multicast="true"/></Interfaces></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex><MaxAutoParticipantIndex>30</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery></Domain></CycloneDDS>"""


@dataclass
class Time(IdlStruct, typename='builtin_interfaces::msg::dds_::Time_'):
    sec: int32
    nanosec: uint32


@dataclass
class Header(IdlStruct, typename='std_msgs::msg::dds_::Header_'):
    stamp: Time
    frame_id: str


@dataclass
class Image(IdlStruct, typename='sensor_msgs::msg::dds_::Image_'):
    header: Header
    height: uint32
    width: uint32
    encoding: str
    is_bigendian: uint8
    step: uint32
    data: sequence[uint8]


@dataclass
class Point(IdlStruct, typename='geometry_msgs::msg::dds_::Point_'):
    x: float64
    y: float64
    z: float64


@dataclass
class Quaternion(IdlStruct, typename='geometry_msgs::msg::dds_::Quaternion_'):
    x: float64
    y: float64
    z: float64
    w: float64


@dataclass
class Pose(IdlStruct, typename='geometry_msgs::msg::dds_::Pose_'):
    position: Point
    orientation: Quaternion


@dataclass
class PoseStamped(IdlStruct, typename='geometry_msgs::msg::dds_::PoseStamped_'):
    header: Header
    pose: Pose


def main() -> None:
    domain, wanted = int(sys.argv[1]), int(sys.argv[2])
    seconds, report = float(sys.argv[3]), sys.argv[4]
    _domain = Domain(domain, CONFIG)
    participant = DomainParticipant(domain)
    qos = Qos(Policy.Reliability.Reliable(duration(seconds=1)), Policy.History.KeepLast(100))
    pose_reader = DataReader(
        participant, Topic(participant, 'rt/bdgs/pose', PoseStamped, qos=qos), qos=qos
    )
    image_reader = DataReader(
        participant, Topic(participant, 'rt/bdgs/rendered/image', Image, qos=qos), qos=qos
    )
    sys.stdout.write('ready\n')
    sys.stdout.flush()
    poses, images = [], []
    deadline = time.monotonic() + seconds
    while time.monotonic() < deadline and not (len(poses) >= wanted and images):
        for sample in pose_reader.take(100):
            stamp, p = sample.header.stamp, sample.pose.position
            poses.append([stamp.sec * 10**9 + stamp.nanosec, p.x, p.y, p.z])
        images += [[s.width, s.height, s.encoding, len(s.data)] for s in image_reader.take(10)]
        time.sleep(0.02)
    Path(report).write_text(json.dumps({'poses': poses, 'images': images}), encoding='utf-8')


if __name__ == '__main__':
    main()
