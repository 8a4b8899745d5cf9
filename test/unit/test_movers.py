"""The class-agnostic prior of tracking."""

import numpy as np
import pytest

from bdgs_ros.core.config.tracking import MoversConfig
from bdgs_ros.tracking.align import ResidualMaps
from bdgs_ros.tracking.movers import MoverMask, gone_from_model, nearer_than_model

CONFIG = MoversConfig()
SHAPE = (240, 320)


def maps(where: tuple[slice, slice], sigma: float = 20.0, valid: bool = True) -> ResidualMaps:
    depth_sigma = np.zeros((120, 160), np.float32)
    depth_sigma[where] = sigma
    return ResidualMaps(depth_sigma, np.zeros_like(depth_sigma), np.full(depth_sigma.shape, valid))


THING = (slice(20, 60), slice(40, 80))


def test_a_large_near_thing_is_marked_at_full_size() -> None:
    image = nearer_than_model(maps(THING), SHAPE, CONFIG)
    assert image.shape == SHAPE
    assert (image[44:116, 84:156] == round(255 * CONFIG.p_dynamic)).all()
    assert not image[130:].any()


@pytest.mark.parametrize(
    'residuals',
    [
        maps((slice(50, 53), slice(50, 53))),  # a speck
        maps((slice(20, 100), slice(50, 52))),  # a rim, as small pose errors leave
        maps(THING, sigma=CONFIG.depth_sigma / 2),  # within the noise
        maps(THING, sigma=-20.0),  # farther than the map
        maps(THING, valid=False),  # nothing to compare with
    ],
)
def test_other_residuals_are_no_movers(residuals: ResidualMaps) -> None:
    assert not nearer_than_model(residuals, SHAPE, CONFIG).any()


def test_the_next_frame_expects_it_a_little_larger() -> None:
    mask = MoverMask(CONFIG)
    assert not mask.expected(SHAPE).any()
    seen = mask.update(maps(THING), SHAPE) > 0
    expected = mask.expected(SHAPE) > 0
    assert (expected >= seen).all()
    assert expected.sum() > 1.05 * seen.sum()
    mask.reset()
    assert not mask.expected(SHAPE).any()


def test_a_door_that_was_opened_is_gone_up_to_its_hinges() -> None:
    door = (slice(0, 120), slice(20, 80))
    opened = maps(door, sigma=-20.0)
    opened.depth_sigma[:, 70:80] = -0.4 * CONFIG.depth_sigma  # beside the hinges
    opened.depth_sigma[10:20, 120:130] = -0.4 * CONFIG.depth_sigma  # noise elsewhere
    gone = gone_from_model(opened, SHAPE, CONFIG)
    assert gone is not None
    assert (gone[:, 40:160] == 255).all()
    assert not gone[:, 164:].any()


@pytest.mark.parametrize(
    'residuals',
    [
        maps((slice(0, 120), slice(0, 40)), sigma=-20.0),  # a quarter of the view
        maps((slice(0, 120), slice(20, 80)), sigma=20.0),  # nearer
        maps((slice(0, 120), slice(20, 80)), sigma=-20.0, valid=False),
        maps((slice(0, 120), slice(0, 160)), sigma=-0.5 * CONFIG.depth_sigma),  # a pose is off
        maps((slice(0, 120), slice(0, 150)), sigma=-20.0),  # there would be no map left
    ],
)
def test_nothing_else_is_gone(residuals: ResidualMaps) -> None:
    assert gone_from_model(residuals, SHAPE, CONFIG) is None
