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
