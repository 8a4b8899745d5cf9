"""What inference is told is written down once, with the truth, for the map and for its shadow."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.likelihood import FEATURES, Observation
from bdgs_ros.belief.sightings import DYNAMIC, STATIC, fuse
from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.inference import Inference
from bdgs_ros.mapping.witness import Shadow, Witness

CAMERA = PinholeCamera(32, 24, 30.0, 30.0, 15.5, 11.5)
CONFIG = BeliefConfig()
WALL_M, BOX_M = 3.0, 1.5


def scene(index: int, box: bool) -> Observation:
    """Return a wall, half of it behind a box if there is one, from places 0.2 m apart."""
    depth = np.full(CAMERA.shape, WALL_M, np.float32)
    if box:
        depth[:, :16] = BOX_M
    color = np.full((*CAMERA.shape, 3), 0.5, np.float32)
    pose = se3.exp(np.array([0.2 * index, 0, 0, 0, 0, 0]))
    return Observation(index * 10**9, pose, CAMERA, color, depth, np.zeros(CAMERA.shape, np.uint8))


def in_front(means: NDArray[np.float32], observation: Observation) -> NDArray[np.int8]:
    return np.where(means[:, 2] < WALL_M - 0.5, DYNAMIC, STATIC).astype(np.int8)


def new(means: list[list[float]]) -> NewGaussians:
    count = len(means)
    return NewGaussians(
        np.array(means, np.float32),
        np.full(count, 0.01, np.float32),
        np.full((count, 3), 0.5, np.float32),
        np.full(count, CONFIG.initial, np.float32),
    )


def watched(inference: Inference) -> GaussianMap:
    """Let a map with one Gaussian on the wall and one on the box see the box leave."""
    gaussians = GaussianMap(CONFIG)
    inference.observe(gaussians, scene(0, box=True), 0)
    gaussians.append(new([[0.5, 0, WALL_M], [-0.2, 0, BOX_M]]), 0.5, 0)
    inference.ask_memory(gaussians, np.arange(2), 0)
    for index in (1, 2):
        inference.observe(gaussians, scene(index, box=False), index)
    return gaussians


def test_a_witness_changes_nothing() -> None:
    plain, seen = watched(Inference(CONFIG)), watched(Witness(CONFIG, in_front))
    np.testing.assert_array_equal(plain.belief.belief, seen.belief.belief)
    np.testing.assert_array_equal(plain.observations, seen.observations)


def test_it_writes_down_who_was_seen_when_and_what_was_true() -> None:
    witness = Witness(CONFIG, in_front)
    gaussians = watched(witness)
    seen = witness.sightings()
    assert list(seen.names) == list(FEATURES)
    np.testing.assert_array_equal(seen.stamps_ns, [0, 10**9, 2 * 10**9])
    np.testing.assert_array_equal(seen.born_at, [0, 0])
    np.testing.assert_allclose(seen.initial, CONFIG.initial)
    np.testing.assert_array_equal(seen.truth, np.where(seen.gaussian == 1, DYNAMIC, STATIC))
    last = seen.known_at == 2
    np.testing.assert_array_equal(seen.gaussian[last], [0, 1])
    np.testing.assert_array_equal(seen.posterior[last], gaussians.belief.belief)
    free = seen.features[:, FEATURES.index('free_space')]
    assert (free[(seen.gaussian == 1) & (seen.known_at > 0)] == 1).all()
    assert (free[seen.gaussian == 0] == 0).all()


def test_only_every_nth_gaussian_is_followed() -> None:
    witness = Witness(CONFIG, in_front, every=2)
    watched(witness)
    seen = witness.sightings()
    assert len(seen.born_at) == 1
    assert set(seen.gaussian) == {0}
    assert (seen.truth == STATIC).all()


def test_a_witness_of_nothing_has_nothing_to_tell() -> None:
    seen = Witness(CONFIG, in_front).sightings()
    assert len(seen) == 0
    assert seen.features.shape == (0, len(FEATURES))


def test_the_shadow_takes_what_moves_too_and_asks_memory() -> None:
    witness = Witness(CONFIG, in_front)
    shadow = Shadow(CONFIG, witness, pixels=60, lifetime=10, seed=0)
    for index, box in enumerate((False, False, True, True)):
        shadow.update(scene(index, box), index)
    seen = witness.sightings()
    assert len(seen.born_at) == 4 * 60
    fused = fuse(seen, CONFIG.decay_rate)
    assert 0.05 < fused.examples.truth.mean() < 0.5
    later = seen.seen_at < seen.known_at  # keyframes 0 and 1 saw free space where the box came
    assert later.any()
    assert (seen.truth[later & (seen.features[:, FEATURES.index('free_space')] > 0)] == 1).all()


def test_the_shadow_forgets() -> None:
    witness = Witness(CONFIG, in_front)
    shadow = Shadow(CONFIG, witness, pixels=20, lifetime=2, seed=0)
    for index in range(5):
        shadow.update(scene(index, box=False), index)
    seen = witness.sightings()
    assert (seen.known_at - seen.born_at[seen.gaussian]).max() == 2
