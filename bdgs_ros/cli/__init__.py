"""The command `bdgs`."""

from bdgs_ros.core.threads import one_thread_in_blas

one_thread_in_blas()
