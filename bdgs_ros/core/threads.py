"""
How many threads libraries take: one, but for our kernels, which are told.

Our images and matrices are small. Many threads on one of them mostly wait for each other, and on
a machine of many processors for each other's processors.
"""

from __future__ import annotations

import os


def one_thread_in_blas() -> None:
    """Tell OpenBLAS, unless the environment does; only before numpy is imported."""
    os.environ.setdefault('OPENBLAS_NUM_THREADS', '1')


def one_thread_in_cv2() -> None:
    """Tell OpenCV."""
    import cv2

    cv2.setNumThreads(1)
