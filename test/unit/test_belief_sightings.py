"""Features add up as in Eq. 5, whether a keyframe is asked at once or later."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from bdgs_ros.belief.sightings import DYNAMIC, STATIC, UNKNOWN, Sightings, fuse
from bdgs_ros.core.errors import DatasetError

SECOND_NS = 1_000_000_000
DECAY = np.exp(-0.5)  # of one second at a rate of 0.5 / s


def two_gaussians() -> Sightings:
    """Gaussian 0 is seen three times; 1 comes with keyframe 1, and 0 is asked about it."""
    return Sightings(
        names=np.array(['a', 'b']),
        stamps_ns=np.array([0, SECOND_NS, 3 * SECOND_NS]),
        born_at=np.array([0, 1], np.int32),
        initial=np.array([0.3, 0.5], np.float32),
        gaussian=np.array([0, 0, 1, 1, 0, 1], np.int32),
        seen_at=np.array([0, 1, 0, 1, 2, 2], np.int32),
        known_at=np.array([0, 1, 1, 1, 2, 2], np.int32),
        features=np.array([[1, 0], [1, 0], [0, 1], [1, 1], [2, 0], [0, 3]], np.float32),
        truth=np.array([STATIC, STATIC, DYNAMIC, DYNAMIC, UNKNOWN, DYNAMIC], np.int8),
        posterior=np.linspace(0, 1, 6).astype(np.float32),
    )


def test_features_add_up_with_weights_by_age() -> None:
    fused = fuse(two_gaussians(), 0.5)
    examples = fused.examples
    np.testing.assert_array_equal(fused.rows, [0, 1, 3, 5])  # asked later, unknown: no examples
    # what is said at birth comes as memory, of other keyframes too
    memory = [[1, 0], [1, 0], [1, 1 + DECAY], [1, 1 + DECAY]]
    np.testing.assert_allclose(examples.memory, memory, rtol=1e-5)
    np.testing.assert_allclose(examples.views, np.zeros((4, 2)), atol=1e-6)
    np.testing.assert_allclose(examples.newest, [[0, 0], [1, 0], [0, 0], [0, 3]])
    np.testing.assert_array_equal(fused.count, [1, 2, 2, 3])
    np.testing.assert_array_equal(examples.truth, [False, False, True, True])


def test_what_was_seen_since_birth_fades() -> None:
    seen = two_gaussians()
    later = replace(seen, truth=np.full(6, STATIC, np.int8))
    views = fuse(later, 0.5).examples.views
    np.testing.assert_allclose(views[3], [DECAY**2, 0], rtol=1e-5)  # keyframe 1 at keyframe 2


def test_the_initial_belief_fades_from_birth_on() -> None:
    examples = fuse(two_gaussians(), 0.5).examples
    start = np.log(0.3 / 0.7)
    np.testing.assert_allclose(examples.start, [start, start, 0, 0], atol=1e-6)
    np.testing.assert_allclose(examples.fade, [1, DECAY, 1, DECAY**2], rtol=1e-5)


def test_files_bring_back_what_was_saved(tmp_path: Path) -> None:
    seen = two_gaussians()
    seen.save(tmp_path / 'seen.npz')
    back = Sightings.load(tmp_path / 'seen.npz')
    np.testing.assert_array_equal(back.features, seen.features)
    assert list(back.names) == ['a', 'b']


@pytest.mark.parametrize('content', [b'', b'nonsense', None])
def test_a_damaged_file_is_named(tmp_path: Path, content: bytes | None) -> None:
    path = tmp_path / 'seen.npz'
    if content is not None:
        path.write_bytes(content)
    with pytest.raises(DatasetError, match=r'seen\.npz.*remove it'):
        Sightings.load(path)


def test_a_file_of_another_version_is_named(tmp_path: Path) -> None:
    np.savez(tmp_path / 'seen.npz', features=np.zeros(3))
    with pytest.raises(DatasetError, match='names'):
        Sightings.load(tmp_path / 'seen.npz')


def test_nothing_seen_is_no_example() -> None:
    seen = two_gaussians()
    nothing = replace(
        seen,
        **{
            name: getattr(seen, name)[:0]
            for name in ('gaussian', 'seen_at', 'known_at', 'features', 'truth', 'posterior')
        },
    )
    assert len(fuse(nothing, 0.5).examples) == 0
