"""The class-agnostic prior: what stands nearer to the camera than the static map."""

from __future__ import annotations

import cv2
import numpy as np

from bdgs_ros.core.config.tracking import MoversConfig
from bdgs_ros.core.images import opened, without_specks
from bdgs_ros.core.types import ProbabilityImage
from bdgs_ros.tracking.align import ResidualMaps


def nearer_than_model(
    maps: ResidualMaps, shape: tuple[int, int], config: MoversConfig
) -> ProbabilityImage:
    """
    Mark what moved in front of the static map.

    Parameters
    ----------
    maps : ResidualMaps
        Depth residuals of the current frame against the model, positive where nearer.
    shape : tuple of int
        (H, W) of the result; the maps may be smaller.
    config : MoversConfig
        Threshold and smallest size.

    Returns
    -------
    p_dynamic : ndarray, shape (H, W), uint8
        `config.p_dynamic` x 255 on such pixels, 0 elsewhere.

    """
    nearer = (maps.depth_sigma > config.depth_sigma) & (maps.valid > 0)
    things = without_specks(opened(nearer), config.min_share)
    value = np.uint8(round(255 * config.p_dynamic))
    image = np.where(things, value, np.uint8(0))
    resized = cv2.resize(image, (shape[1], shape[0]), interpolation=cv2.INTER_NEAREST)
    return np.asarray(resized, np.uint8)


class MoverMask:
    """
    What stood before the map in the last frame, where it may be expected in the next.

    The coarse alignment needs to know the movers before it can see them against the map. At
    camera rate they are about where they were.
    """

    def __init__(self, config: MoversConfig) -> None:
        self._config = config
        self._last: ProbabilityImage | None = None

    def reset(self) -> None:
        """Forget the last frame."""
        self._last = None

    def expected(self, shape: tuple[int, int]) -> ProbabilityImage:
        """Return the last movers, grown by how far they may have come; 0 where unknown."""
        if self._last is None or self._last.shape != shape:
            return np.zeros(shape, np.uint8)
        reach = 2 * round(self._config.reach * shape[1]) + 1
        return np.asarray(cv2.dilate(self._last, np.ones((reach, reach), np.uint8)), np.uint8)

    def update(self, maps: ResidualMaps, shape: tuple[int, int]) -> ProbabilityImage:
        """Take the residuals of this frame and return its movers, see `nearer_than_model`."""
        self._last = nearer_than_model(maps, shape, self._config)
        return self._last
