"""
Images that did not arrive whole: the rest of a cut-off one is filled with one value.

Decoders paint what is missing of a JPEG in one grey (pyorbbecsdk issue 123, librealsense issue
10379), drivers leave rows black. Such rows say nothing, and a keyframe of them would be wrong
for as long as it is looked at.
"""

from __future__ import annotations

import numpy as np

from bdgs_ros.core.types import ColorImage, ProbabilityImage

_STRIDE = 4  # rows; a share needs no more
_SPREAD = 2  # grey levels: compression ripples
_LEAST = 0.05  # of the rows
_MOST = 5  # images in a row; then it is what the camera shows
_ALL = 0.95  # then the lens is covered, which is no fault of the image


class BrokenRows:
    """Finds rows at the end of an image that are of one colour, where they were not lately."""

    def __init__(self) -> None:
        self.reset()

    def reset(self) -> None:
        """Forget what is usual: a part of the robot may cover the lower edge for good."""
        self._usual = 0.0
        self._in_a_row = 0

    def share(self, color: ColorImage) -> float:
        """
        Return the share of rows, from the last one up, that are missing.

        Parameters
        ----------
        color : ndarray, shape (H, W, 3), uint8
            The next image.

        """
        flat = flat_share(color)
        is_broken = self._usual + _LEAST <= flat <= _ALL
        self._in_a_row = self._in_a_row + 1 if is_broken else 0
        if self._in_a_row > _MOST:
            self._usual, is_broken = flat, False
        elif not is_broken:
            self._usual = min(self._usual, flat)
        return flat if is_broken else 0.0


def flat_share(color: ColorImage) -> float:
    """Return the share of rows, from the last one up, that have one and the same colour."""
    rows = color[::-1][::_STRIDE]
    last = rows[0, 0].astype(np.int16)
    count = 0
    for row in rows:
        if np.abs(row.astype(np.int16) - last).max() > _SPREAD:
            break
        count += 1
    return count / len(rows)


def without_rows(p_dynamic: ProbabilityImage, share: float) -> ProbabilityImage:
    """Return a mask by which the last rows are not looked at."""
    masked = p_dynamic.copy()
    masked[round((1 - share) * len(masked)) :] = 255
    return masked
