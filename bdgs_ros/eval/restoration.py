"""Hidden statics that the camera sees again: are they rendered within a second."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]
Index = NDArray[np.int64]

LIMIT_S = 1.0
_LONG_AGO_NS = -(10**18)
_COUNTS = ('restored', 'not_restored', 'settled', 'not_settled', 'unresolved')


class Restorations:
    """
    The waits of Gaussians by serial number.

    A wait begins when a static Gaussian that is not rendered is seen and was rendered or not
    seen before (within `LIMIT_S`: depth images have holes). It ends well if the Gaussian is
    rendered at a keyframe within `LIMIT_S`, and badly if it is not, or is deleted because of
    its belief. It counts as neither if the Gaussian stops being static, is deleted for other
    reasons, or was seen in less than half of the keyframes meanwhile.
    """

    def __init__(self) -> None:
        self._start_ns = np.zeros(0, np.int64)
        self._last_ns = np.zeros(0, np.int64)
        self._keyframes = np.zeros(0, np.int32)
        self._seen = np.zeros(0, np.int32)
        self._waits = np.zeros(0, bool)
        self._shown = np.zeros(0, bool)
        self._ever_shown = np.zeros(0, bool)
        self.counts = dict.fromkeys(_COUNTS, 0)

    def note(self, stamp_ns: int, serial: Index, static: Mask, seen: Mask, shown: Mask) -> None:
        """
        Take one keyframe.

        Parameters
        ----------
        stamp_ns : int
            Its time.
        serial : ndarray, shape (N,)
            Of the Gaussians that are in the map now.
        static, seen, shown : ndarray of bool, shape (N,)
            By truth; measured by the camera just now; rendered from now on.

        """
        self._grow(int(serial.max(initial=-1)) + 1)
        self._resolve(stamp_ns, serial, static, seen, shown)
        hidden = static & seen & ~shown
        again = self._shown[serial] | (stamp_ns - self._last_ns[serial] > LIMIT_S * 1e9)
        begin = serial[hidden & again & ~self._waits[serial]]
        self._waits[begin] = True
        self._start_ns[begin] = stamp_ns
        self._keyframes[begin] = self._seen[begin] = 1
        self._last_ns[serial[hidden]] = stamp_ns
        self._shown[serial] = shown
        self._ever_shown[serial] |= shown

    def deleted(self, by_belief: Index, otherwise: Index) -> None:
        """End the waits of Gaussians that are no longer in the map."""
        self._end(by_belief[self._waits[by_belief]], good=False)
        self._drop(otherwise[self._waits[otherwise]])

    def open_waits(self) -> int:
        """Return how many Gaussians still wait."""
        return int(self._waits.sum())

    def _resolve(
        self, stamp_ns: int, serial: Index, static: Mask, seen: Mask, shown: Mask
    ) -> None:
        waiting = self._waits[serial]
        self._drop(serial[waiting & ~static])
        waiting &= static
        self._keyframes[serial[waiting]] += 1
        self._seen[serial[waiting & seen]] += 1
        in_time = stamp_ns - self._start_ns[serial] <= LIMIT_S * 1e9
        self._end(serial[waiting & shown & in_time], good=True)
        late = serial[waiting & ~in_time]
        watched = 2 * self._seen[late] >= self._keyframes[late]
        self._end(late[watched], good=False)
        self._drop(late[~watched])

    def _end(self, serial: Index, good: bool) -> None:
        before = int(self._ever_shown[serial].sum())
        prefix = '' if good else 'not_'
        self.counts[f'{prefix}restored'] += before
        self.counts[f'{prefix}settled'] += len(serial) - before
        self._waits[serial] = False

    def _drop(self, serial: Index) -> None:
        self.counts['unresolved'] += len(serial)
        self._waits[serial] = False

    def _grow(self, count: int) -> None:
        more = count - len(self._waits)
        if more <= 0:
            return
        for name in ('_start_ns', '_keyframes', '_seen', '_waits', '_shown', '_ever_shown'):
            old = getattr(self, name)
            setattr(self, name, np.concatenate([old, np.zeros(more, old.dtype)]))
        self._last_ns = np.concatenate([self._last_ns, np.full(more, _LONG_AGO_NS)])
