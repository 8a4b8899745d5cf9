"""Small operations on masks that several stages need."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

Mask = NDArray[np.bool_]


def without_specks(mask: Mask, share: float) -> Mask:
    """Drop connected components smaller than `share` of the image, mask of shape (H, W)."""
    count, labels, stats, _ = cv2.connectedComponentsWithStats(mask.astype(np.uint8))
    if count < 2:
        return np.zeros_like(mask)
    large = stats[:, cv2.CC_STAT_AREA] >= share * mask.size
    large[0] = False
    return np.asarray(large[labels])


def opened(mask: Mask, size: int = 3) -> Mask:
    """Remove structures thinner than `size` pixels: the rims that small pose errors leave."""
    kernel = np.ones((size, size), np.uint8)
    return np.asarray(cv2.morphologyEx(mask.astype(np.uint8), cv2.MORPH_OPEN, kernel) > 0)
