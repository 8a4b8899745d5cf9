"""What a keyframe says about Gaussians in front of, on and behind the measured surface."""

import numpy as np
import pytest

from bdgs_ros.belief import likelihood
from bdgs_ros.belief.likelihood import FEATURES, Observation, Points
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.belief import LikelihoodConfig

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
CONFIG = LikelihoodConfig()


def points(means: np.ndarray, surface: int = 0, streak: int = 0) -> Points:
    """Grey Gaussians about which little is known."""
    n = len(means)
    count, number = np.full(n, streak, np.int32), np.full(n, surface, np.int32)
    grey, one = np.full((n, 3), 0.5, np.float32), np.ones(n, np.float32)
    return Points(
        means.astype(np.float32), grey, one, count, count, count, np.zeros(n, np.float32), number
    )


def observation(depth: float = 2.0, prior: int = 0, color: float = 0.5) -> Observation:
    return Observation(
        0,
        np.eye(4),
        CAMERA,
        np.full((48, 64, 3), color, np.float32),
        np.full((48, 64), depth, np.float32),
        np.full((48, 64), prior, np.uint8),
    )


def evidence_at(z: float, seen: Observation) -> tuple[float, bool]:
    features = likelihood.extract(points(np.array([[0, 0, z]])), seen, CONFIG)
    return float(likelihood.evidence(features, CONFIG)[0]), bool(features.visible[0])


def test_a_gaussian_on_the_surface_is_static() -> None:
    value, visible = evidence_at(2.0, observation())
    assert visible
    assert value < 0


def test_the_same_where_the_detector_fires_is_dynamic() -> None:
    value, visible = evidence_at(2.0, observation(prior=230))
    assert visible
    assert value > 1


def test_a_gaussian_behind_someone_gets_no_evidence() -> None:
    value, visible = evidence_at(3.0, observation(prior=230))
    assert not visible
    assert value == 0


def test_a_gaussian_that_is_seen_through_is_dynamic_whatever_the_detector_says() -> None:
    for prior in (0, 230):
        value, visible = evidence_at(1.0, observation(prior=prior))
        assert visible
        assert value > 2


@pytest.mark.parametrize(('color', 'expected'), [(0.5, 0.0), (0.51, 0.04), (1.0, 0.2)])
def test_another_colour_at_the_same_depth_is_a_feature(color: float, expected: float) -> None:
    point = points(np.array([[0, 0, 2.0]]))
    found = likelihood.extract(point, observation(color=color), CONFIG).column('color')
    np.testing.assert_allclose(found, [expected], atol=0.17)


@pytest.mark.parametrize('point', [(0, 0, -1.0), (0, 0, 0.01), (5, 0, 1.0), (0, -5, 1.0)])
def test_outside_the_view_there_is_no_evidence(point: tuple[float, ...]) -> None:
    features = likelihood.extract(points(np.array([point])), observation(), CONFIG)
    assert not features.visible.any()
    assert not features.values.any()


def test_missing_depth_is_no_evidence() -> None:
    value, visible = evidence_at(2.0, observation(depth=0.0))
    assert not visible
    assert value == 0


def test_features_have_names() -> None:
    features = likelihood.extract(points(np.zeros((3, 3))), observation(), CONFIG)
    assert features.values.shape == (3, len(FEATURES))


def test_label_without_filter_is_the_prior_where_depth_agrees() -> None:
    means = np.array([[0, 0, 2.0], [0, 0, 3.0]], np.float32)
    features = likelihood.extract(points(means), observation(prior=255), CONFIG)
    np.testing.assert_allclose(likelihood.label(features), [1.0, 0.5])


def test_at_the_rim_of_something_nearer_nothing_counts_as_free_space() -> None:
    seen = observation(depth=2.0)
    seen.depth_m[:, 32:] = 1.0
    beside = np.array([[-0.01, 0.0, 1.5]])  # projects one pixel beside the near surface
    free = np.array([[-0.3, 0.0, 1.5]])
    features = likelihood.extract(points(np.concatenate([beside, free])), seen, CONFIG)
    assert features.visible.tolist() == [False, True]


def test_a_surface_that_is_mostly_labelled_speaks_for_all_of_it() -> None:
    seen = observation()
    seen.p_dynamic[:, 16:] = 255
    features = likelihood.extract(points(np.array([[-0.9, 0.0, 2.0]])), seen, CONFIG)
    assert features.column('prior')[0] == 0
    assert features.column('object')[0] == pytest.approx(0.75, abs=0.02)


def test_a_surface_that_is_seen_through_elsewhere_has_departed() -> None:
    seen = observation(depth=2.0)
    means = np.array([[0, 0, 2.0], [0.1, 0, 1.0], [0.2, 0, 1.0]])
    features = likelihood.extract(points(means, surface=7), seen, CONFIG)
    assert features.column('departed')[0] == pytest.approx(2 / 3)
    assert features.column('free_space')[1] == 1
    alone = likelihood.extract(points(means, surface=0), seen, CONFIG)
    assert alone.column('departed')[0] == 0


def test_features_of_history_saturate() -> None:
    means = np.array([[0, 0, 2.0]])
    short, long = (
        likelihood.extract(points(means, streak=n), observation(), CONFIG) for n in (1, 1000)
    )
    for name in ('streak', 'age', 'observations'):
        assert 0 < short.column(name)[0] < long.column(name)[0] == 1


def test_a_keyframe_that_is_off_as_a_whole_finds_no_free_space() -> None:
    rng = np.random.default_rng(0)
    means = np.column_stack([rng.uniform(-0.5, 0.5, (400, 2)), np.full(400, 2.0)])
    exact, off = (
        likelihood.extract(points(means), observation(depth=depth), CONFIG) for depth in (2.0, 2.2)
    )
    assert exact.agrees.all()
    assert off.agrees.all()
    means[:20] = [0.1, 0.1, 1.0]  # of these nothing is left
    gone = [
        likelihood.extract(points(means), observation(depth=depth), CONFIG) for depth in (2.0, 2.2)
    ]
    sure, unsure = (features.column('free_space')[:20] for features in gone)
    assert (sure == 1).all()
    assert (unsure > 0).all()
    assert (unsure < 0.5).all()
