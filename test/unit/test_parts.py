"""Which part of the view is the world, on made-up squares and on rendered images."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core.config.tracking import PartsConfig
from bdgs_ros.tracking.align import Cells
from bdgs_ros.tracking.parts import Parts, find_world

ROWS, COLUMNS = 12, 16
CONFIG = PartsConfig()
RESTING = np.zeros(6)
SURE = np.diag([0.002**-2] * 3 + [0.002**-2] * 3)
UNSURE = np.diag([0.5**-2] * 6)


def cells(near: np.ndarray, near_step: np.ndarray, far_step: np.ndarray, seed: int = 0) -> Cells:
    """Squares of two surfaces, 1 m and 4 m away, that saw two motions, with some noise."""
    rng = np.random.default_rng(seed)
    count = ROWS * COLUMNS
    J = rng.normal(size=(count, 30, 6)) * 100
    steps = np.where(near.reshape(-1, 1), near_step, far_step)
    residuals = -np.einsum('cki,ci->ck', J, steps) + rng.normal(size=(count, 30))
    return Cells(
        information=np.einsum('cki,ckj->cij', J, J),
        gradient=np.einsum('cki,ck->ci', J, residuals),
        cost=(residuals**2).sum(axis=1),
        weight=np.full(count, 30.0),
        depth_m=np.where(near.reshape(-1), 1.0, 4.0),
        seen=np.full(count, 16.0),
        columns=COLUMNS,
        plane=np.zeros((count, 3)),
    )


def left(share: float) -> np.ndarray:
    near = np.zeros((ROWS, COLUMNS), bool)
    near[:, : round(share * COLUMNS)] = True
    return near


def world(*arguments: object) -> Parts:
    parts = find_world(*arguments, CONFIG)  # type: ignore[arg-type]
    assert parts is not None
    return parts


STEP = np.array([0.05, 0.0, 0.025, 0.0, 0.025, 0.0])


@pytest.mark.parametrize('share', [0.3, 0.55, 0.75])
def test_what_covers_most_of_the_view_need_not_be_the_world(share: float) -> None:
    """A person at 1 m before a wall at 4 m: the alignment went with the person."""
    found = world(cells(left(share), RESTING, STEP), STEP, UNSURE)
    assert found.is_other
    assert found.step == pytest.approx(STEP, abs=1e-3)
    assert (found.moved == left(share)).mean() > 0.97


def test_the_aligned_world_is_kept_and_what_moves_is_marked() -> None:
    found = world(cells(left(0.4), STEP, RESTING), RESTING, UNSURE)
    assert not found.is_other and not found.step.any()
    assert (found.moved == left(0.4)).mean() > 0.97


def test_where_nothing_moves_nothing_is_marked() -> None:
    found = world(cells(left(0.5), RESTING, RESTING), RESTING, SURE)
    assert not found.is_other and found.moved.mean() < 0.02


def test_of_two_equals_the_expected_motion_is_the_world() -> None:
    """Both surfaces are 1 m away; the camera was at rest."""
    even = cells(left(0.5), RESTING, STEP)
    even = Cells(**{**even.__dict__, 'depth_m': np.ones(ROWS * COLUMNS)})
    assert not world(even, RESTING, SURE).is_other
    assert world(even, STEP, SURE).is_other


def test_a_door_moves_as_a_whole_though_its_hinges_do_not() -> None:
    """A plane whose left two thirds were seen to move, before others that go on behind it."""
    door = left(0.6)
    seen = cells(left(0.4), STEP, RESTING)
    plane = np.zeros((ROWS, COLUMNS, 3))
    plane[..., 0] = np.where(door, 0.8 + 0.01 * np.arange(COLUMNS), 0.25)
    plane[..., 1] = np.where(door, 0.01, 0.0)
    whole = Cells(**{**seen.__dict__, 'plane': plane.reshape(-1, 3)})
    assert (world(whole, RESTING, UNSURE).moved == door).mean() > 0.97
    assert (world(seen, RESTING, UNSURE).moved == left(0.4)).mean() > 0.97
    everywhere = np.tile([0.5, 0.0, 0.0], (ROWS * COLUMNS, 1))  # one plane: nothing would be left
    plain = Cells(**{**cells(left(0.6), STEP, RESTING).__dict__, 'plane': everywhere})
    assert world(plain, RESTING, UNSURE).moved.mean() < 0.7


def test_too_little_tells_nothing() -> None:
    few = cells(left(0.5), RESTING, RESTING)
    few = Cells(**{**few.__dict__, 'seen': np.r_[[16.0] * 3, [0.0] * (ROWS * COLUMNS - 3)]})
    assert find_world(few, RESTING, SURE, CONFIG) is None


def test_the_mask_has_the_size_of_the_image() -> None:
    found = world(cells(left(0.25), STEP, RESTING), RESTING, UNSURE)
    mask = found.mask((120, 160), 0.8)
    assert mask.shape == (120, 160)
    assert (mask[:, :36] == 204).mean() > 0.95 and (mask[:, 44:] == 0).mean() > 0.95


def test_what_no_motion_explains_is_not_the_world() -> None:
    """A limb that swings past: its squares show something else than what they were compared to."""
    seen = cells(left(0.0), RESTING, RESTING)
    limb = np.zeros((ROWS, COLUMNS), bool)
    limb[4:7, 5:9] = True
    seen.cost[limb.reshape(-1)] *= 30
    seen.plane[:, 0] = np.where(limb.reshape(-1), 1.0, 0.25)
    found = world(seen, RESTING, UNSURE)
    assert found.moved[limb].all()
    assert found.moved[~limb].mean() < 0.02
    seen.plane[:, 0] = 0.25  # no thing of its own: the room, blurred here and there
    assert world(seen, RESTING, UNSURE).moved.mean() < 0.02


def test_the_plain_parts_of_a_thing_move_with_it() -> None:
    """A shirt has a pattern in its middle alone; the wall behind it has one everywhere."""
    shirt = np.zeros((ROWS, COLUMNS), bool)
    shirt[2:, 3:10] = True
    pattern = np.zeros_like(shirt)
    pattern[3:8, 3:9] = True
    seen = cells(shirt, STEP, RESTING)
    plain = (shirt & ~pattern).reshape(-1)
    seen.information[plain] *= 1e-6
    seen.gradient[plain] *= 1e-6
    seen.cost[plain] = 30.0
    seen.plane[:, 0] = np.where(shirt.reshape(-1), 1.0, 0.25)
    found = world(seen, RESTING, SURE)
    assert not found.is_other
    assert (found.moved == shirt).mean() > 0.97
    seen.plane[:, 0] = 0.0  # nothing is known of what hangs together
    assert (world(seen, RESTING, SURE).moved == pattern).mean() > 0.97


def test_keyframes_go_by_what_is_large_and_unnamed() -> None:
    """A door over half of the view is no landmark; what a detector has named is known already."""
    found = world(cells(left(0.5), 2 * STEP, RESTING), RESTING, SURE)
    prior = np.zeros((ROWS * 16, COLUMNS * 16), np.uint8)
    large = found.large(prior, 0.8)
    assert large is not None
    assert large.shape == prior.shape
    assert ((large > 127) == np.kron(left(0.5), np.ones((16, 16), bool))).mean() > 0.95
    assert found.large(np.full_like(prior, 255), 0.8) is None
    small = np.zeros((ROWS, COLUMNS), bool)
    small[4:7, 4:8] = True
    slow = cells(left(0.5), 0.4 * STEP, RESTING)
    for seen in (cells(small, 2 * STEP, RESTING), slow):
        assert world(seen, RESTING, SURE).large(prior, 0.8) is None
