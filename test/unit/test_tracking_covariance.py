"""How far off poses are said to be, against how far off they are."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.config.tracking import CovarianceConfig
from bdgs_ros.tracking import covariance
from bdgs_ros.tracking.align import Cells

ROWS, COLUMNS, POINTS = 16, 20, 30
PLAIN = CovarianceConfig(spread=1.0, open=0.0, smear_s=0.0)
NOTHING = np.zeros((6, 6))


def solved(rng: np.random.Generator, together: float) -> tuple[Cells, np.ndarray]:
    """Squares whose pixels err together by this share, and the pose that they choose."""
    count = ROWS * COLUMNS
    J = rng.normal(size=(count, POINTS, 6)) * 10 + rng.normal(size=(count, 1, 6)) * 10
    noise = rng.normal(size=(count, POINTS)) + together * rng.normal(size=(count, 1))
    information = np.einsum('cki,ckj->cij', J, J)
    gradient = np.einsum('cki,ck->ci', J, noise)
    error = -np.linalg.solve(information.sum(axis=0), gradient.sum(axis=0))
    ones = np.ones(count)
    cells = Cells(
        information, gradient, (noise**2).sum(axis=1), POINTS * ones, ones, POINTS * ones,
        COLUMNS, np.zeros((count, 3)),
    )  # fmt: skip
    return cells, error


@pytest.mark.parametrize('together', [0.0, 1.0, 3.0])
def test_errors_are_one_sigma_whether_pixels_err_together_or_not(together: float) -> None:
    rng = np.random.default_rng(0)
    squared = []
    for _ in range(60):
        cells, error = solved(rng, together)
        moved = np.zeros((ROWS, COLUMNS), bool)
        found = covariance.of_alignment(cells, moved, error, NOTHING, np.zeros(6), PLAIN)
        squared.append(error @ np.linalg.solve(found, error))
    assert np.mean(squared) == pytest.approx(6.0, rel=0.35)


def test_what_moves_has_no_say() -> None:
    cells, error = solved(np.random.default_rng(1), 1.0)
    moved = np.zeros((ROWS, COLUMNS), bool)
    moved[:, :10] = True
    wild = cells.gradient.reshape(ROWS, COLUMNS, 6).copy()
    wild[moved] *= 1000
    cells = Cells(**{**cells.__dict__, 'gradient': wild.reshape(-1, 6)})
    still = covariance.of_alignment(cells, moved, error, NOTHING, np.zeros(6), PLAIN)
    pulled = covariance.of_alignment(cells, ~moved, error, NOTHING, np.zeros(6), PLAIN)
    assert np.trace(pulled) > 1e4 * np.trace(still)


def test_motion_and_what_is_left_open_come_on_top() -> None:
    cells, error = solved(np.random.default_rng(2), 0.0)
    moved = np.zeros((ROWS, COLUMNS), bool)
    config = CovarianceConfig(spread=0.0, open=0.5, smear_s=0.01)
    cells.depth_m[:] = 2.0
    velocity = np.array([1.0, 0, 0, 0, 2.0, 0])  # the image shifts by 2 and 1 / 2 rad/s
    found = covariance.of_alignment(cells, moved, error, np.eye(6), velocity, config)
    assert np.sqrt(found[0, 0] - 0.5) == pytest.approx(0.05)  # m at a depth of 2 m
    assert np.sqrt(found[4, 4] - 0.5) == pytest.approx(0.025)


def test_a_chain_adds_up_as_samples_do() -> None:
    rng = np.random.default_rng(3)
    T = se3.exp(np.array([0.5, -0.2, 1.0, 0.3, 0.6, -0.2]))
    a, b = np.diag([1, 2, 3, 4, 5, 6]) * 1e-6, np.diag([3, 1, 2, 1, 2, 1]) * 1e-6
    samples = []
    for _ in range(4000):
        first, second = (rng.multivariate_normal(np.zeros(6), c) for c in (a, b))
        samples.append(se3.log(se3.inverse(T) @ se3.exp(first) @ T @ se3.exp(second)))
    found = covariance.chained(a, T, b)
    assert np.abs(np.cov(np.array(samples).T) - found).max() < 0.1 * np.abs(found).max()
