"""Thin rclpy nodes: convert, call, publish."""

import os

from bdgs_ros.core.threads import one_thread_in_blas

one_thread_in_blas()

MEMORY = ':'.join(
    (
        # Threads have no heaps of their own, which are given back and cleared anew all the time.
        'glibc.malloc.arena_max=1',
        # What images are freed from waits for the next ones.
        'glibc.malloc.mmap_threshold=33554432',
        'glibc.malloc.trim_threshold=268435456',
        # Pages have 2 MB.
        'glibc.malloc.hugetlb=1',
    )
)
"""How a process takes memory: by default, new pages cost mapping a seventh of its time."""
# Read by the C library when a process starts, so by the children of slam_node.
os.environ.setdefault('GLIBC_TUNABLES', MEMORY)
