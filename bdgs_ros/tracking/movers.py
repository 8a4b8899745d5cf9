"""What changed against the static map: what stands before it, and what is gone from it."""

from __future__ import annotations

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.config.tracking import MoversConfig
from bdgs_ros.core.images import opened, without_specks
from bdgs_ros.core.types import ProbabilityImage
from bdgs_ros.tracking.align import ResidualMaps

_FAINT = 0.25  # of the threshold, beside what is clear
_MOST = 0.75  # of what is compared; of more it is the map or the pose that is wrong


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
    return _image(_things(nearer, config), shape, config.p_dynamic)


def gone_from_model(
    maps: ResidualMaps, shape: tuple[int, int], config: MoversConfig
) -> ProbabilityImage | None:
    """
    Mark where an image sees through the static map, if much of it does.

    What the map shows there is gone: a door was opened. What is seen instead does not move, but
    says nothing of where the map is; once it is most of the view, residuals of outliers pass for
    the usual.

    Parameters
    ----------
    maps, shape, config
        As for `nearer_than_model`.

    Returns
    -------
    gone : ndarray, shape (H, W), uint8, or None
        255 on such pixels, 0 elsewhere; None where they are less than `config.gone_share`, or
        hardly anything of the map is left.

    """
    farther = np.where(maps.valid, -maps.depth_sigma, 0.0)
    clearly = farther > config.depth_sigma
    if clearly.mean() < config.gone_share:
        return None
    whole = _connected_to(_things(clearly, config), farther > _FAINT * config.depth_sigma)
    return _image(whole, shape, 1.0) if whole.sum() < _MOST * maps.valid.sum() else None


def _connected_to(seeds: NDArray[np.bool_], mask: NDArray[np.bool_]) -> NDArray[np.bool_]:
    """Return the regions of a mask that hold a seed: a door is hardly gone near its hinges."""
    count, label = cv2.connectedComponents(mask.astype(np.uint8), connectivity=4)
    is_found = np.bincount(label[seeds], minlength=count) > 0
    is_found[0] = False
    return np.asarray(is_found[label])


def _things(mask: NDArray[np.bool_], config: MoversConfig) -> NDArray[np.bool_]:
    return without_specks(opened(mask), config.min_share)


def _image(mask: NDArray[np.bool_], shape: tuple[int, int], p_dynamic: float) -> ProbabilityImage:
    image = np.where(mask, np.uint8(round(255 * p_dynamic)), np.uint8(0))
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
