"""The steps of the Kalman filter, against Bayes' rule for Gaussians."""

from __future__ import annotations

import numpy as np
import pytest

from bdgs_ros.core import kalman

SEED = 5


def positive(rng: np.random.Generator, size: int) -> np.ndarray:
    root = rng.normal(size=(size, size))
    return root @ root.T + 0.1 * np.eye(size)


def test_prediction_is_the_linear_map_of_a_gaussian() -> None:
    rng = np.random.default_rng(SEED)
    mean, covariance, F, Q = (
        rng.normal(size=4),
        positive(rng, 4),
        rng.normal(size=(4, 4)),
        np.eye(4),
    )
    samples = rng.multivariate_normal(mean, covariance, 200_000) @ F.T
    state, spread = kalman.predict(mean, covariance, F, Q)
    assert samples.mean(axis=0) == pytest.approx(state, abs=0.1)
    assert np.cov(samples.T) + Q == pytest.approx(spread, rel=0.05, abs=0.2)


def test_update_is_the_posterior_in_information_form() -> None:
    rng = np.random.default_rng(SEED)
    state, covariance = rng.normal(size=6), positive(rng, 6)
    H, z, R = rng.normal(size=(3, 6)), rng.normal(size=3), positive(rng, 3)
    information = np.linalg.inv(covariance) + H.T @ np.linalg.inv(R) @ H
    vector = np.linalg.inv(covariance) @ state + H.T @ np.linalg.inv(R) @ z
    found, spread = kalman.update(state, covariance, z, R, H)
    assert found == pytest.approx(np.linalg.solve(information, vector))
    assert spread == pytest.approx(np.linalg.inv(information))


def test_the_covariance_stays_positive_over_measurements_that_are_nearly_exact() -> None:
    state, covariance = np.zeros(2), np.diag([1.0, 1e-3])
    for _ in range(1000):
        state, covariance = kalman.update(
            state, covariance, np.zeros(1), np.array([[1e-12]]), np.array([[1.0, 1.0]])
        )
    assert np.linalg.eigvalsh(covariance).min() > -1e-15
