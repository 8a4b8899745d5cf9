"""Gaussian-splatting SLAM among moving people; importing this loads neither torch nor rclpy."""

__version__ = '0.1.0'
