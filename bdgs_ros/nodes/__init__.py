"""Thin rclpy nodes: convert, call, publish."""

import os

# Read by OpenBLAS when it is loaded: the other nodes need the other processors.
os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')

MEMORY = 'glibc.malloc.hugetlb=1'
"""
Memory in pages of 2 MB: with small ones a node that keeps images spends a tenth of its time on them.
"""
# Read by the C library when a process starts, so by the children of slam_node.
os.environ.setdefault('GLIBC_TUNABLES', MEMORY)
