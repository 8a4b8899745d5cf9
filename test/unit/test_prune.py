"""What is taken out of the map, and what must stay."""

import numpy as np

from bdgs_ros.belief.likelihood import FEATURES, Features
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.mapping import prune
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians

CONFIG = MappingConfig().prune


def small_map(
    opacities: list[float], scales: list[float] | np.ndarray, keyframe_index: int = 0
) -> GaussianMap:
    gaussians = GaussianMap(BeliefConfig())
    for opacity, scale in zip(opacities, scales, strict=True):
        new = NewGaussians(
            np.zeros((1, 3), np.float32),
            np.array([scale], np.float32),
            np.zeros((1, 3), np.float32),
            np.array([0.3], np.float32),
        )
        gaussians.append(new, opacity, keyframe_index)
    return gaussians


def features(visible: list[bool], agree: list[bool], prior: list[float]) -> Features:
    values = np.zeros((len(visible), len(FEATURES)), np.float32)
    values[:, FEATURES.index('agreement')] = agree
    values[:, FEATURES.index('prior')] = prior
    return Features(values, np.array(visible), np.zeros(len(visible), np.int32))


def test_faint_and_large_gaussians_go() -> None:
    gaussians = small_map([0.9, CONFIG.opacity / 2, 0.9], [0.01, 0.01, 2 * CONFIG.scale])
    assert prune.worth_keeping(gaussians, CONFIG).tolist() == [True, False, False]


def test_needles_go_and_flat_ones_stay() -> None:
    shapes = np.array([[0.1, 0.1, 0.0005], [0.1, 0.001, 0.001], [0.1, 0.01, 0.01]])
    gaussians = small_map([0.9] * 3, shapes)
    assert prune.worth_keeping(gaussians, CONFIG).tolist() == [True, False, True]


def test_over_the_budget_the_least_useful_go() -> None:
    gaussians = small_map([0.3 + 0.004 * i for i in range(120)], [0.01] * 120)
    gaussians.contribution[100:110] = 0.01
    gone = prune.least_useful(gaussians, 20)
    assert gone.tolist() == [i < 10 or 100 <= i < 110 for i in range(120)]
    assert not prune.least_useful(gaussians, -5).any()


def test_what_adds_to_no_view_of_its_surface_is_redundant() -> None:
    gaussians = small_map([0.9] * 4, [0.01] * 4)
    agree = np.array([True, True, False, True])
    weight = np.array([0.5, 0.0, 0.0, 0.0], np.float32)
    resolved = np.array([True, True, True, False])
    for _ in range(10):
        prune.note_contribution(gaussians, agree, weight, resolved, CONFIG)
    assert prune.redundant(gaussians, CONFIG).tolist() == [False, True, False, False]


def test_one_view_is_not_enough_to_be_redundant() -> None:
    gaussians = small_map([0.9], [0.01])
    yes = np.array([True])
    prune.note_contribution(gaussians, yes, np.zeros(1, np.float32), yes, CONFIG)
    assert not prune.redundant(gaussians, CONFIG).any()


def test_a_far_view_does_not_resolve_small_gaussians() -> None:
    camera = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
    gaussians = small_map([0.9] * 2, [0.05, 0.005])
    away = np.eye(4)
    away[2, 3] = 2.0
    assert prune.resolved_by(gaussians, away, camera).tolist() == [True, False]


def test_a_new_gaussian_that_is_not_seen_again_goes_and_an_old_one_stays() -> None:
    newest = CONFIG.trial + 1
    gaussians = small_map([0.9] * 4, [0.01] * 4, newest - 2)
    gaussians.keyframe_index[3] = 0
    seen = features([True, True, False, True], [True, False, False, False], [0.0] * 4)
    for _ in range(CONFIG.trial_checks):
        prune.note_checks(gaussians, seen)
    gone = prune.unconfirmed(gaussians, newest, CONFIG)
    assert gone.tolist() == [False, True, False, False]


def test_a_person_does_not_confirm_a_gaussian() -> None:
    gaussians = small_map([0.9], [0.01])
    for _ in range(CONFIG.trial_checks):
        prune.note_checks(gaussians, features([True], [True], [0.9]))
    assert prune.unconfirmed(gaussians, 1, CONFIG).all()


def test_what_is_remembered_follows_the_gaussians() -> None:
    gaussians = small_map([0.9] * 3, [0.01] * 3)
    gaussians.contribution[:] = [0.1, 0.2, 0.3]
    gaussians.checks[:] = [1, 2, 3]
    gaussians.confirmations[:] = [4, 5, 6]
    gaussians.keep(np.array([True, False, True]))
    np.testing.assert_allclose(gaussians.contribution, [0.1, 0.3])
    assert gaussians.checks.tolist() == [1, 3]
    assert gaussians.confirmations.tolist() == [4, 6]


def test_only_what_is_seen_through_again_and_again_is_deleted() -> None:
    gaussians = small_map([0.9] * 4, [0.01] * 4)
    gaussians.belief.smoothed[:] = [0.99, 0.99, 0.2, 0.99]
    gaussians.violations[:] = [2, 0, 2, 1]
    gone = prune.confirmed_gone(gaussians, BeliefConfig(delete_after=2))
    assert gone.tolist() == [True, False, False, False]
