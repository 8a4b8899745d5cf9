"""Gaussian-splatting SLAM among moving people; importing this loads neither torch nor rclpy."""

import os

# OpenMP threads that spin while they wait take the cores from the other nodes: on two cores a
# mapping step took five times as long. Read when libgomp loads, so it must be set first.
os.environ.setdefault('OMP_WAIT_POLICY', 'passive')

__version__ = '0.1.0'
