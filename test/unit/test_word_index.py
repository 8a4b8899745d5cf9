"""The image that shows the same is the likeliest one, and no image is better than a wrong one."""

from __future__ import annotations

import numpy as np

from bdgs_ros.tracking.word_index import WordIndex


def descriptors(seed: int, count: int = 100) -> np.ndarray:
    return np.random.default_rng(seed).integers(0, 256, (count, 32), np.uint8)


def seen_again(image: np.ndarray) -> np.ndarray:
    """Flip a twentieth of the bits."""
    flipped = np.random.default_rng(1).random((len(image), 256)) < 0.05
    return np.asarray(image ^ np.packbits(flipped, axis=1), np.uint8)


def test_an_image_seen_again_is_the_likeliest() -> None:
    index = WordIndex()
    images = [index.words(descriptors(seed)) for seed in range(50)]
    query = index.words(seen_again(descriptors(17)))
    likely = index.likely(query, images, 4)
    assert likely[0] == 17
    assert len(likely) <= 4


def test_what_all_images_show_counts_little() -> None:
    index = WordIndex()
    common, own = descriptors(0, 45), descriptors(1, 40)
    images = [index.words(np.concatenate([common, descriptors(s, 55)])) for s in range(10, 30)]
    images.append(index.words(np.concatenate([own, descriptors(30, 60)])))
    query = index.words(np.concatenate([common, own]))
    assert index.likely(query, images, 1) == [20]


def test_nothing_is_like_nothing() -> None:
    index = WordIndex()
    words = index.words(descriptors(0))
    assert index.likely(words, [], 4) == []
    assert index.likely(index.words(np.zeros((0, 32), np.uint8)), [words], 4) == []
