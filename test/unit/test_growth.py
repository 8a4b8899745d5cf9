"""Where Gaussians may come from, and which keyframes stay."""

import numpy as np
import pytest

from bdgs_ros.core import images, se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import MappingConfig
from bdgs_ros.core.types import Keyframe, Labels, RgbdFrame
from bdgs_ros.mapping import growth
from bdgs_ros.mapping.keyframes import MapKeyframe, build_levels, most_redundant, shrink

CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)
INSERT = MappingConfig().insert


def keyframe(depth: np.ndarray, moving: np.ndarray | None = None) -> MapKeyframe:
    moving = np.zeros(CAMERA.shape, bool) if moving is None else moving
    color = np.full((48, 64, 3), 128, np.uint8)
    levels = build_levels(color, depth.astype(np.float32), moving, CAMERA, 3)
    return MapKeyframe(0, 0, np.eye(4), np.zeros(CAMERA.shape, np.uint8), levels)


def candidates_of(kf: MapKeyframe) -> np.ndarray:
    return growth.usable_depth(kf.levels[0].depth_m, INSERT) & growth.far_from_movers(
        kf.levels[0].weight > 0, INSERT
    )


def test_nothing_comes_from_movers_or_their_margin() -> None:
    moving = np.zeros(CAMERA.shape, bool)
    moving[10:20, 10:20] = True
    candidates = candidates_of(keyframe(np.full((48, 64), 2.0), moving))
    margin = INSERT.margin_px
    assert not candidates[10 - margin : 20 + margin, 10 - margin : 20 + margin].any()
    assert candidates.sum() > 300


def test_nothing_comes_from_edges_or_bad_depth() -> None:
    depth = np.full((48, 64), 2.0)
    depth[:, 32:] = 3.0
    depth[5:10] = 0
    depth[40:] = INSERT.max_depth + 1
    candidates = candidates_of(keyframe(depth))
    assert not candidates[:, 31:33].any()
    assert not candidates[5:10].any()
    assert not candidates[40:].any()


@pytest.mark.parametrize('width', [64, 32])
def test_shrinking_keeps_depths_measured_and_movers_present(width: int) -> None:
    depth = np.where(np.arange(64) % 2, 1.0, 3.0).astype(np.float32)[None].repeat(48, 0)
    prior = np.zeros((48, 64), np.uint8)
    prior[11, 13] = 255
    frame = RgbdFrame(0, np.zeros((48, 64, 3), np.uint8), depth, CAMERA)
    small = shrink(Keyframe(frame, np.eye(4), prior), width)
    assert small.frame.camera.width == width
    assert set(np.unique(small.frame.depth_m)) <= {1.0, 3.0}
    assert small.p_dynamic.max() == 255


def test_the_keyframe_that_another_stands_in_for_is_forgotten_first() -> None:
    kept = [keyframe(np.full((48, 64), 2.0)) for _ in range(4)]
    for kf, x in zip(kept, (0.0, 1.0, 1.05, 3.0), strict=True):
        kf.T_world_camera = se3.exp(np.array([x, 0, 0, 0, 0, 0]))
    assert most_redundant(kept) in kept[1:3]


def test_the_fast_median_of_four_is_the_lower_median_of_what_is_valid() -> None:
    blocks = np.random.default_rng(0).uniform(0.5, 6, (4, 40, 50)).astype(np.float32)
    blocks[np.random.default_rng(1).random(blocks.shape) < 0.4] = 0
    expected = images._lower_median(blocks)
    assert (np.count_nonzero(blocks, axis=0) == 0).any()
    np.testing.assert_array_equal(images._lower_median_of_four(blocks), expected)


@pytest.mark.parametrize(('large', 'width'), [((48, 84), 64), ((48, 84), 42), ((45, 80), 37)])
def test_colour_and_depth_stay_on_top_of_each_other_at_any_ratio(
    large: tuple[int, int], width: int
) -> None:
    x = np.arange(large[1], dtype=np.float32)[None].repeat(large[0], 0)
    color = np.repeat((x * 2)[..., None], 3, axis=2).astype(np.uint8)
    camera = PinholeCamera(large[1], large[0], 60.0, 60.0, large[1] / 2, large[0] / 2)
    frame = RgbdFrame(0, color, (1 + 0.002 * x).astype(np.float32), camera)
    small = images.shrink_frame(frame, width)
    from_color, from_depth = small.color[..., 0] / 2, (small.depth_m - 1) / 0.002
    assert np.abs(from_color - from_depth)[:, 1:-1].max() < 1.1
    assert from_depth[:, -2].min() > large[1] - 2.5 * large[1] / width - 1


def test_a_wide_frame_is_halved_but_not_below_the_width() -> None:
    camera = PinholeCamera(256, 144, 200.0, 200.0, 128.0, 72.0)
    frame = RgbdFrame(
        0, np.zeros((144, 256, 3), np.uint8), np.ones((144, 256), np.float32), camera
    )
    p_dynamic = np.zeros((144, 256), np.uint8)
    p_dynamic[31, 77] = 200
    assert images.halved(frame, 129) is frame
    small = images.halved(frame, 64)
    assert (small.camera.width, small.camera.height) == (64, 36)
    labels = images.fitted(Labels(0, p_dynamic), small)
    assert labels.p_dynamic.shape == (36, 64)
    assert labels.p_dynamic.max() == 200
