"""Every so-many-th image of a stream, by its stamps; ROS-free."""

from __future__ import annotations

from bdgs_ros.data.trajectory_io import NS_PER_S

_EARLY = 0.25  # of a period: stamps of cameras jitter


class Pace:
    """
    Choose images so that there are not more than a rate, spread evenly.

    Parameters
    ----------
    rate_hz : float
        Of the chosen ones, on average; infinite for all.

    """

    def __init__(self, rate_hz: float) -> None:
        self._period_ns = NS_PER_S / rate_hz
        self._due_ns: float | None = None

    def is_due(self, stamp_ns: int) -> bool:
        """Return whether this image is chosen; ask once for each, in order."""
        if self._due_ns is None:
            self._due_ns = stamp_ns
        if stamp_ns < self._due_ns - _EARLY * self._period_ns:
            return False
        # from where it was due, so that jitter does not add up; not from long before
        self._due_ns = max(self._due_ns + self._period_ns, stamp_ns + self._period_ns / 2)
        return True

    def set_rate(self, rate_hz: float) -> None:
        """Choose more or fewer from now on."""
        self._period_ns = NS_PER_S / rate_hz

    def reset(self) -> None:
        """The next image is chosen."""
        self._due_ns = None
