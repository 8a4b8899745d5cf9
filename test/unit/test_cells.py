"""Cells are small where there is detail and cover what is wanted once."""

import numpy as np
import pytest

from bdgs_ros.mapping.cells import Cells, average, choose_cells, lost_detail


def covered(cells: Cells, shape: tuple[int, int]) -> np.ndarray:
    count = np.zeros(shape, int)
    for row, column, size in zip(cells.row, cells.column, cells.size, strict=True):
        count[row : row + size, column : column + size] += 1
    return count


def half_textured(shape: tuple[int, int]) -> np.ndarray:
    color = np.full((*shape, 3), 0.5, np.float32)
    color[:, : shape[1] // 2] += np.random.default_rng(0).uniform(
        -0.3, 0.3, (shape[0], shape[1] // 2, 3)
    )
    return color.astype(np.float32)


@pytest.mark.parametrize('shape', [(48, 64), (45, 61)])
def test_every_wanted_pixel_is_covered_once_and_finely_where_there_is_detail(
    shape: tuple[int, int],
) -> None:
    color = half_textured(shape)
    wanted = np.ones(shape, bool)
    cells = choose_cells(wanted, color, 1, 2, 0.03)
    count = covered(cells, shape)
    assert (count <= 1).all()
    assert count.mean() > 0.99
    assert set(cells.size[cells.column < 24]) == {1}
    assert set(cells.size[cells.column > 40]) == {4}


def test_a_ramp_is_no_detail() -> None:
    ramp = np.linspace(0, 1, 64, dtype=np.float32)[None, :, None].repeat(48, 0).repeat(3, 2)
    assert lost_detail(ramp, 8)[:, 1:-1].max() < 1e-3


def test_nothing_comes_from_pixels_that_are_not_wanted() -> None:
    wanted = np.zeros((48, 64), bool)
    wanted[10:30, 12:40] = True
    color = np.zeros((48, 64, 3), np.float32)
    cells = choose_cells(wanted, color, 1, 2, 0.03)
    np.testing.assert_array_equal(covered(cells, wanted.shape) > 0, wanted)
    far = np.ones_like(wanted)
    far[10:30, 12:40] = False
    assert not (covered(cells, wanted.shape) > 0)[far].any()


def test_the_smallest_cell_need_not_be_a_power_of_two() -> None:
    wanted = np.ones((48, 60), bool)
    cells = choose_cells(wanted, half_textured((48, 60)), 3, 1, 0.03)
    assert set(cells.size) == {3, 6}
    np.testing.assert_array_equal(covered(cells, wanted.shape), 1)


def test_averages_are_those_of_each_cell() -> None:
    image = np.random.default_rng(0).uniform(0, 1, (8, 8)).astype(np.float32)
    cells = Cells(np.array([0, 5]), np.array([4, 2]), np.array([4, 1]))
    expected = [image[0:4, 4:8].mean(), image[5, 2]]
    np.testing.assert_allclose(average(image, cells), expected, rtol=1e-5)
