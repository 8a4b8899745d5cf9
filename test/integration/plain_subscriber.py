"""
A ROS 2 program that knows nothing of this project: two subscriptions, one report.

Usage: plain_subscriber.py POSES SECONDS REPORT
"""

import json
import sys
import time
from pathlib import Path

import rclpy
from geometry_msgs.msg import PoseStamped
from sensor_msgs.msg import Image


def main() -> None:
    wanted, seconds, report = int(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
    poses, images = [], []

    def on_pose(message: PoseStamped) -> None:
        stamp, p, q = message.header.stamp, message.pose.position, message.pose.orientation
        poses.append([stamp.sec * 10**9 + stamp.nanosec, p.x, p.y, p.z, q.x, q.y, q.z, q.w])

    def on_image(message: Image) -> None:
        mean = sum(message.data) / max(1, len(message.data))
        images.append([message.width, message.height, message.encoding, mean])

    rclpy.init(args=[])
    node = rclpy.create_node('somebody_else')
    node.create_subscription(PoseStamped, 'bdgs/pose', on_pose, 100)
    node.create_subscription(Image, 'bdgs/rendered/image', on_image, 10)
    deadline = time.monotonic() + seconds
    greeted = False
    while time.monotonic() < deadline and not (len(poses) >= wanted and images):
        rclpy.spin_once(node, timeout_sec=0.1)
        if (
            not greeted
            and node.count_publishers('bdgs/pose')
            and node.count_publishers('bdgs/rendered/image')
        ):
            greeted = True
            sys.stdout.write('matched\n')
            sys.stdout.flush()
    Path(report).write_text(json.dumps({'poses': poses, 'images': images}), encoding='utf-8')
    rclpy.shutdown()


if __name__ == '__main__':
    main()
