"""Thin rclpy nodes: convert, call, publish."""

import os

# Read by OpenMP when it is loaded, so before any kernel: threads that wait must not burn the
# cores that the other nodes need.
os.environ.setdefault('OMP_WAIT_POLICY', 'passive')
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')
