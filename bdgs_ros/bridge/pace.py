"""Every so-many-th image of a stream, by its stamps; ROS-free."""

from __future__ import annotations

from bdgs_ros.bridge.governor import Shed
from bdgs_ros.data.trajectory_io import NS_PER_S

_FEW = 0.5  # of the labels, when tracking is behind or nobody is seen
_QUIET = 10  # labels in a row that show nobody
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
        """Choose more or fewer from the last chosen one on."""
        period_ns = NS_PER_S / rate_hz
        if self._due_ns is not None:
            self._due_ns += period_ns - self._period_ns
        self._period_ns = period_ns

    def reset(self) -> None:
        """The next image is chosen."""
        self._due_ns = None


class LabelsPace(Pace):
    """
    Choose the images that get labels: half of them under load, and where nobody is seen.

    In a room where nobody is, the detector would take as much of the machine as the map; who
    comes in is seen one image later.
    """

    def __init__(self, rate_hz: float) -> None:
        super().__init__(rate_hz)
        self._rate_hz = rate_hz
        self._is_shed = False
        self._quiet = 0  # labels since the last that showed anybody

    def note_load(self, level: Shed) -> None:
        """Hear what is left out."""
        self._is_shed = level >= Shed.LABELS
        self._choose()

    def note_labels(self, show_anybody: bool) -> None:
        """Hear what the labels of an image show."""
        self._quiet = 0 if show_anybody else self._quiet + 1
        self._choose()

    def _choose(self) -> None:
        few = self._is_shed or self._quiet >= _QUIET
        self.set_rate(self._rate_hz * (_FEW if few else 1.0))
