"""Direct alignment on an analytic scene with exact poses; native kernel against numpy twin."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera, Rectifier
from bdgs_ros.core.config.tracking import AlignConfig, PartsConfig
from bdgs_ros.core.errors import ConfigError
from bdgs_ros.tracking import align as module
from bdgs_ros.tracking import align_numpy
from bdgs_ros.tracking.align import Aligner, AlignResult, ImagePyramid
from bdgs_ros.tracking.parts import find_world

CAMERA = PinholeCamera(320, 240, 262.5, 262.5, 159.5, 119.5)
MOTION = np.array([0.03, -0.02, 0.025, 0.01, -0.02, 0.015])
ROOM = (np.array([-2.0, -1.3, -1.0]), np.array([2.2, 1.4, 3.5]))
BOX = (np.array([-0.7, 0.1, 1.6]), np.array([0.1, 1.4, 2.2]))
Image = tuple[np.ndarray, np.ndarray]

needs_native = pytest.mark.skipif(module._aligner is None, reason='the kernel is not built')
BACKENDS = [pytest.param('native', marks=needs_native), 'numpy']


def paint(points: np.ndarray) -> np.ndarray:
    """Return a smooth random grey in [0, 1] for every point of the world."""
    rng = np.random.default_rng(11)
    value = np.zeros(points.shape[:-1])
    for octave in (1.5, 3.0, 6.0, 12.0):
        for _ in range(3):
            direction = rng.standard_normal(3)
            phase = points @ (octave * direction) + rng.uniform(0, 6)
            value += np.sin(phase) / octave**0.5
    return np.clip(0.5 + 0.12 * value, 0, 1)


def cast(T_world_camera: np.ndarray, camera: PinholeCamera, boxes: list) -> Image:
    """Return grey in [0, 1] and depth in metres of the room and boxes in it."""
    rays = camera.rays().astype(np.float64) @ T_world_camera[:3, :3].T
    origin = T_world_camera[:3, 3]
    with np.errstate(divide='ignore'):
        sides = [((corner - origin) / rays) for corner in ROOM]
    depth = np.maximum(*sides).min(axis=-1)
    for low, high in boxes:
        with np.errstate(divide='ignore'):
            a, b = (low - origin) / rays, (high - origin) / rays
        enter, leave = np.minimum(a, b).max(axis=-1), np.maximum(a, b).min(axis=-1)
        hit = (enter < leave) & (enter > 0) & (enter < depth)
        depth = np.where(hit, enter, depth)
    return paint(origin + rays * depth[..., None]), depth.astype(np.float32)


def picture(xi: np.ndarray, camera: PinholeCamera = CAMERA, boxes: list | None = None) -> Image:
    """Return grey uint8 and depth of a camera at `exp(xi)`."""
    grey, depth = cast(se3.exp(xi), camera, [BOX] if boxes is None else boxes)
    return np.rint(255 * grey).astype(np.uint8), depth


def run(a: Image, b: Image, config: AlignConfig | None = None, **kwargs: object) -> AlignResult:
    aligner = Aligner(config or AlignConfig())
    reference = aligner.pyramid(*a, None, CAMERA)
    current = aligner.pyramid(*b, None, CAMERA)
    return aligner.align(reference, current, np.eye(4), **kwargs)


def errors(T_current_reference: np.ndarray, xi: np.ndarray = MOTION) -> tuple[float, float]:
    """Return the error in metres and degrees when the reference stood at the origin."""
    error = se3.log(T_current_reference @ se3.exp(xi))
    return float(np.linalg.norm(error[:3])), float(np.rad2deg(np.linalg.norm(error[3:])))


@pytest.mark.parametrize('backend', BACKENDS)
def test_it_finds_the_motion(backend: str) -> None:
    result = run(picture(np.zeros(6)), picture(MOTION), AlignConfig(backend=backend))
    metres, degrees = errors(result.T_current_reference)
    assert metres < 0.001 and degrees < 0.02  # half of it from the silhouette of the box
    assert result.converged and result.iterations <= 20
    assert result.inlier_ratio > 0.95 and result.coverage > 0.8 and result.overlap > 0.9
    assert result.median_intensity < 0.01 and result.median_depth_sigma < 1.0


@needs_native
def test_there_is_no_bias() -> None:
    rng = np.random.default_rng(5)
    reference = picture(np.zeros(6), boxes=[])
    moves = [rng.normal(0, 1, 6) * [0.02, 0.02, 0.02, 0.01, 0.01, 0.01] for _ in range(8)]
    config = AlignConfig(max_points=10**6)  # of a third of the points: 0.00035
    rest = [
        se3.log(run(reference, picture(xi, boxes=[]), config).T_current_reference @ se3.exp(xi))
        for xi in moves
    ]
    assert np.abs(np.mean(rest, axis=0)[:3]).max() < 0.0002  # measured 0.0001
    assert np.abs(np.mean(rest, axis=0)[3:]).max() < np.deg2rad(0.004)


@needs_native
def test_images_of_different_size_are_aligned() -> None:
    aligner = Aligner(AlignConfig())
    big = PinholeCamera(640, 480, 525.0, 525.0, 319.5, 239.5)
    wide = PinholeCamera(424, 240, 262.5, 262.5, 211.5, 119.5)
    current = aligner.pyramid(*picture(MOTION, big), None, big)
    for camera in (CAMERA, CAMERA.scaled(0.5), wide):
        reference = aligner.pyramid(*picture(np.zeros(6), camera), None, camera)
        result = aligner.align(reference, current, np.eye(4))
        metres, degrees = errors(result.T_current_reference)
        assert metres < 0.002 and degrees < 0.04, camera


@needs_native
def test_a_colour_image_is_as_good_as_grey() -> None:
    (grey_a, depth_a), (grey_b, depth_b) = picture(np.zeros(6)), picture(MOTION)
    color_a, color_b = (np.repeat(g[..., None], 3, axis=2) for g in (grey_a, grey_b))
    result = run((color_a, depth_a), (color_b, depth_b))
    same = run((grey_a, depth_a), (grey_b, depth_b))
    assert np.allclose(result.T_current_reference, same.T_current_reference, atol=1e-6)


@needs_native
def test_exposure_is_found_and_does_no_harm() -> None:
    grey, depth = picture(MOTION)
    darker = np.rint(0.8 * grey + 12).astype(np.uint8)
    result = run(picture(np.zeros(6)), (darker, depth))
    assert errors(result.T_current_reference)[0] < 0.001
    assert result.gain == pytest.approx(0.8, abs=0.02)
    assert result.bias == pytest.approx(12 / 255, abs=0.02)


@needs_native
def test_a_large_motion_is_found_from_nothing() -> None:
    xi = np.array([0.1, 0.05, -0.1, 0.05, 0.12, -0.05])
    result = run(picture(np.zeros(6)), picture(xi), AlignConfig(max_iterations=40))
    assert errors(result.T_current_reference, xi)[0] < 0.003


@needs_native
@pytest.mark.parametrize('masked', [True, False])
def test_a_mover_does_not_pull_the_camera(masked: bool) -> None:
    shift = np.array([0.15, 0.0, -0.1])
    moved = [(BOX[0] + shift, BOX[1] + shift)]
    (grey_a, depth_a), (grey_b, depth_b) = picture(np.zeros(6)), picture(MOTION, boxes=moved)
    aligner = Aligner(AlignConfig())
    empty = [picture(xi, boxes=[])[1] for xi in (np.zeros(6), MOTION)]
    masks = [
        (np.abs(e - d) > 0.01).astype(np.uint8) * 255
        for e, d in zip(empty, (depth_a, depth_b), strict=True)
    ]
    reference = aligner.pyramid(grey_a, depth_a, masks[0] if masked else None, CAMERA)
    current = aligner.pyramid(grey_b, depth_b, masks[1] if masked else None, CAMERA)
    metres, _ = errors(aligner.align(reference, current, np.eye(4)).T_current_reference)
    assert metres < (0.001 if masked else 0.005)


@needs_native
def test_a_sensor_that_bends_depth_is_seen_through() -> None:
    """A wall that looks curved in every frame must not hold the camera back."""
    xi = np.array([0.0, 0.0, 0.0, 0.0, 0.08, 0.0])
    images = []
    for pose in (np.zeros(6), xi):
        grey, depth = picture(pose, boxes=[])
        x = CAMERA.rays()[..., 0]
        images.append((grey, (1.0 / (1.0 / depth + 0.05 * x**2)).astype(np.float32)))
    believing = run(*images, AlignConfig(pattern_sigma=1e-5))
    doubting = run(*images, AlignConfig())
    held, free = (errors(r.T_current_reference, xi)[0] for r in (believing, doubting))
    assert free < 0.5 * held
    assert doubting.depth_pattern[0] == pytest.approx(-0.05, abs=0.02)


@needs_native
def test_a_prior_decides_where_images_cannot() -> None:
    blank = np.full(CAMERA.shape, 128, np.uint8), np.full(CAMERA.shape, 2.0, np.float32)
    start = se3.exp(np.array([0.05, 0.0, 0.0, 0.0, 0.0, 0.0]))
    aligner = Aligner(AlignConfig())
    pyramid = aligner.pyramid(*blank, None, CAMERA)
    information = np.eye(6) * 1e4
    result = aligner.align(pyramid, pyramid, start, prior_information=information)
    assert np.allclose(result.T_current_reference, start, atol=2e-3)


@needs_native
def test_covariance_is_larger_where_less_is_seen() -> None:
    whole = run(picture(np.zeros(6)), picture(MOTION))
    grey, depth = picture(MOTION)
    depth[:, 100:] = 0
    grey[:, 100:] = 128
    part = run(picture(np.zeros(6)), (grey, depth))
    assert np.all(np.linalg.eigvalsh(whole.covariance) > 0)
    assert np.trace(part.covariance) > np.trace(whole.covariance)


@pytest.mark.parametrize('backend', BACKENDS)
@pytest.mark.parametrize('value', [0.0, np.nan])
def test_no_depth_at_all_is_no_alignment_and_no_crash(backend: str, value: float) -> None:
    grey, depth = picture(np.zeros(6), CAMERA)
    nothing = grey, np.full_like(depth, value)
    result = run(nothing, (grey, depth), AlignConfig(backend=backend))
    assert result.coverage == 0 and result.inlier_ratio == 0
    assert np.isfinite(result.T_current_reference).all() and np.isfinite(result.covariance).all()


def test_an_image_of_the_wrong_size_is_refused() -> None:
    grey, depth = picture(np.zeros(6))
    with pytest.raises(ValueError, match=r'depth_m: expected height and width \(240, 320\)'):
        Aligner(AlignConfig()).pyramid(grey, depth[:-1], None, CAMERA)


def test_without_the_kernel_native_is_refused_and_auto_falls_back(
    monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    monkeypatch.setattr(module, '_aligner', None)
    monkeypatch.setattr(module, '_warned', False)
    with pytest.raises(ConfigError, match='not built'):
        Aligner(AlignConfig(backend='native'))
    for _ in range(2):
        assert Aligner(AlignConfig())._backend is align_numpy
    assert len([r for r in caplog.records if 'numpy twin' in r.message]) == 1


# ---------------------------------------------------------------------------- residual maps


@pytest.mark.parametrize('backend', BACKENDS)
def test_maps_show_what_came_and_what_left(backend: str) -> None:
    aligner = Aligner(AlignConfig(backend=backend))
    with_box, without = picture(MOTION), picture(np.zeros(6), boxes=[])
    static = aligner.pyramid(*without, None, CAMERA)
    frame = aligner.pyramid(*with_box, None, CAMERA)
    T_frame_static = se3.inverse(se3.exp(MOTION))
    maps = aligner.residual_maps(static, frame, T_frame_static)
    empty = cast(se3.exp(MOTION), CAMERA, [])[1]
    box = cv2.resize((empty - with_box[1] > 0.3).astype(np.uint8), (160, 120)) > 0
    core = cv2.erode(box.astype(np.uint8), np.ones((5, 5))) > 0
    around = cv2.dilate(box.astype(np.uint8), np.ones((5, 5))) == 0
    assert (maps.depth_sigma[core & maps.valid] > 8).mean() > 0.95
    assert (np.abs(maps.depth_sigma[around & maps.valid]) < 2).mean() > 0.99
    assert np.abs(maps.color[around & maps.valid]).max() < 0.05
    assert maps.valid[around].mean() > 0.9
    back = aligner.residual_maps(frame, static, se3.inverse(T_frame_static))
    assert (back.depth_sigma < -8).sum() > 0.5 * core.sum()


def test_maps_leave_out_what_moved_in_the_reference() -> None:
    aligner = Aligner(AlignConfig())
    grey, depth = picture(np.zeros(6))
    mask = np.zeros(CAMERA.shape, np.uint8)
    mask[:, :160] = 255
    reference = aligner.with_dynamic(aligner.pyramid(grey, depth, None, CAMERA), mask)
    current = aligner.pyramid(grey, depth, None, CAMERA)
    maps = aligner.residual_maps(reference, current, np.eye(4))
    assert not maps.valid[:, :78].any() and maps.valid[2:-2, 82:-2].all()


# ---------------------------------------------------------------------------- twins


@pytest.fixture(scope='module')
def noisy() -> tuple[Image, Image, np.ndarray]:
    """Return two images with noise, holes and a mask: every branch is taken."""
    rng = np.random.default_rng(7)
    images = []
    for xi in (np.zeros(6), MOTION):
        grey, depth = picture(xi)
        depth = depth + 0.0025 * depth**2 * rng.standard_normal(depth.shape)
        depth[rng.random(depth.shape) < 0.02] = 0
        noise = rng.normal(0, 2, grey.shape)
        noisy = np.clip(grey + noise, 0, 255).astype(np.uint8)
        images.append((noisy, depth.astype(np.float32)))
    mask = np.zeros(CAMERA.shape, np.uint8)
    mask[40:120, 60:150] = 230
    return images[0], images[1], mask


@pytest.mark.parametrize('backend', BACKENDS)
def test_with_fewer_points_the_motion_is_found_as_well(backend: str) -> None:
    aligner = Aligner(AlignConfig(backend=backend))
    grey_a, depth_a = picture(np.zeros(6))
    grey_b, depth_b = picture(MOTION)
    reference = aligner.pyramid(grey_a, depth_a, None, CAMERA)
    current = aligner.pyramid(grey_b, depth_b, None, CAMERA)
    exact = se3.inverse(se3.exp(MOTION))
    errors = []
    for share in (1.0, 0.25, 1.0):
        aligner.compare(share)
        found = aligner.align(reference, current, np.eye(4)).T_current_reference
        errors.append(np.linalg.norm(se3.log(found @ se3.inverse(exact))))
    assert errors[0] == errors[2] != errors[1]
    assert max(errors) < 0.004


def pyramids(
    images: tuple[Image, Image, np.ndarray],
    backend: str,
    max_points: int = 20000,
    shade: float = AlignConfig.shade,
) -> tuple:
    config = AlignConfig(backend=backend, max_iterations=12, max_points=max_points, shade=shade)
    aligner = Aligner(config)
    a, b, mask = images
    return aligner, aligner.pyramid(*a, mask, CAMERA), aligner.pyramid(*b, None, CAMERA)


@needs_native
def test_twins_build_the_same_pyramid(noisy: tuple) -> None:
    _, native, _ = pyramids(noisy, 'native')
    _, twin, _ = pyramids(noisy, 'numpy')
    planes = ('grey', 'gx', 'gy', 'inverse_depth', 'smooth', 'dx', 'dy', 'p_static')
    for i in range(len(native.widths)):
        a, b = native.handle.level(i), twin.handle.level(i)
        assert np.allclose(a.intrinsics, b.intrinsics)
        for name in planes:
            # a pixel at the limit of a discontinuity may fall on either side
            differs = np.abs(getattr(a, name) - getattr(b, name)) > 1e-5
            assert differs.mean() < 1e-4, (i, name)


@needs_native
@pytest.mark.parametrize('max_points', [1500, 5000, 1000000])
def test_twins_agree_on_normal_equations(noisy: tuple, max_points: int) -> None:
    sums = []
    for backend in ('native', 'numpy'):
        aligner, reference, current = pyramids(noisy, backend, max_points)
        T = se3.exp(-0.8 * MOTION)
        sums.append(
            aligner._backend.normal_equations(
                reference.handle,
                current.handle,
                1,
                1,
                T,
                1.05,
                -0.02,
                [0.01, -0.02, 0.03],
                0.02,
                0.004,
                aligner._params,
            )
        )
    for name in ('information', 'gradient', 'cost', 'weight'):
        a, b = np.asarray(sums[0][name]), np.asarray(sums[1][name])
        assert np.abs(a - b).max() <= 1e-4 * np.abs(b).max(), name
    for name in ('compared', 'inliers', 'in_view', 'reference'):
        assert abs(sums[0][name] - sums[1][name]) <= 10, name


@needs_native
def test_a_share_of_the_points_stands_for_all(noisy: tuple) -> None:
    results = []
    for max_points in (3000, 1000000):
        aligner, reference, current = pyramids(noisy, 'native', max_points)
        results.append(aligner.align(reference, current, np.eye(4)))
    some, every = results
    assert some.coverage == pytest.approx(every.coverage, rel=0.1)
    assert some.overlap == pytest.approx(every.overlap, abs=0.08)
    assert np.sqrt(np.diag(some.covariance)) == pytest.approx(
        np.sqrt(np.diag(every.covariance)), rel=0.3
    )


@needs_native
def test_twins_find_the_same_pose_and_maps(noisy: tuple) -> None:
    results, maps = [], []
    for backend in ('native', 'numpy'):
        aligner, reference, current = pyramids(noisy, backend)
        results.append(aligner.align(reference, current, np.eye(4)))
        maps.append(aligner.residual_maps(reference, current, se3.inverse(se3.exp(MOTION))))
    a, b = results
    assert a.iterations == b.iterations
    assert np.abs(a.T_current_reference - b.T_current_reference).max() < 1e-5
    scale = np.sqrt(np.diag(b.covariance))
    assert np.abs((a.covariance - b.covariance) / np.outer(scale, scale)).max() < 5e-3
    assert a.texture == pytest.approx(b.texture, abs=1e-3)
    assert np.abs(maps[0].valid ^ maps[1].valid).mean() < 1e-3
    assert (np.abs(maps[0].depth_sigma - maps[1].depth_sigma) > 0.01).mean() < 1e-3


@needs_native
def test_twins_ask_the_same_of_squares(noisy: tuple) -> None:
    found = []
    for backend in ('native', 'numpy'):
        aligner, reference, current = pyramids(noisy, backend)
        result = aligner.align(reference, current, np.eye(4))
        at = replace(result, T_current_reference=se3.exp(MOTION), gain=1.02, bias=-0.01)
        at = replace(at, depth_pattern=np.array([0.02, -0.01, 0.01]))
        found.append(aligner.cells(reference, current, at))
    a, b = found
    for field in ('information', 'gradient', 'cost', 'weight', 'depth_m', 'seen'):
        one, other = getattr(a, field), getattr(b, field)
        assert np.abs(one - other).max() <= 1e-4 * np.abs(other).max(), field
    assert a.columns == b.columns and len(a.cost) % a.columns == 0


@needs_native
def test_squares_together_say_what_the_whole_image_says(noisy: tuple) -> None:
    """The step that their sum asks for leads to where the alignment ends, if all are as bright."""
    aligner, reference, current = pyramids(noisy, 'native', shade=1e-6)
    end = aligner.align(reference, current, np.eye(4))
    off = np.array([0.02, -0.01, 0.02, 0.01, 0.01, -0.01])
    start = replace(end, T_current_reference=se3.exp(off) @ end.T_current_reference)
    cells = aligner.cells(reference, current, start)
    step = -np.linalg.solve(cells.information.sum(axis=0), cells.gradient.sum(axis=0))
    assert step == pytest.approx(-off, abs=4e-3)


@pytest.mark.parametrize('backend', BACKENDS)
@pytest.mark.parametrize(('vignette', 'bend'), [(0.2, 0.0), (0.0, 0.08)])
def test_a_vignette_and_a_bent_depth_image_are_no_motion(
    backend: str, vignette: float, bend: float
) -> None:
    """The camera turned; towards the corners its images are darker, or nearer."""
    v, u = np.mgrid[-1:1:240j, -1:1:320j]
    corner = (u**2 + v**2).astype(np.float32)

    def moved(config: AlignConfig, knows_bend: bool) -> float:
        aligner = Aligner(config)
        reference, current = (
            aligner.pyramid(
                np.rint(grey * (1 - vignette * corner)).astype(np.uint8),
                1 / (1 / depth_m + bend * corner),
                None,
                CAMERA,
            )
            for grey, depth_m in (picture(np.zeros(6)), picture(turn))
        )
        found = aligner.align(reference, current, np.eye(4))
        if not knows_bend:
            found = replace(found, depth_pattern=np.zeros(3))
        cells = aligner.cells(reference, current, found)
        parts = find_world(cells, np.zeros(6), np.zeros((6, 6)), PartsConfig())
        assert parts is not None
        return float((parts.excess > PartsConfig.moved).mean())

    turn = np.array([0.0, 0.0, 0.0, 0.0, 0.12, 0.0])
    assert moved(AlignConfig(backend=backend), True) < 0.02
    assert moved(AlignConfig(backend=backend, shade=1e-6), False) > 0.1


@pytest.mark.parametrize('backend', BACKENDS)
def test_noise_tells_nothing_and_a_wrong_place_neither(backend: str) -> None:
    """A plain wall with noise, and two walls that have nothing written on them in common."""
    rng = np.random.default_rng(0)
    config = replace(AlignConfig(), backend=backend)
    aligner = Aligner(config)
    camera = PinholeCamera(160, 120, 130.0, 130.0, 79.5, 59.5)
    depth_m = np.full(camera.shape, 1.5, np.float32)

    def wall(shades: float, seed: int) -> ImagePyramid:
        pattern = np.random.default_rng(seed).normal(size=(15, 20)).astype(np.float32)
        image = 128 + shades * cv2.resize(pattern, (160, 120), interpolation=cv2.INTER_CUBIC)
        image = np.clip(image + 3 * rng.normal(size=image.shape), 0, 255).astype(np.uint8)
        return aligner.pyramid(image, depth_m, None, camera)

    def open_to(a: ImagePyramid, b: ImagePyramid) -> tuple[float, float]:
        result = aligner.align(a, b, np.eye(4))
        return float(np.sqrt(result.covariance[0, 0])), result.texture

    plain, wrong, right = (
        open_to(wall(shades, 1), wall(shades, seed))
        for shades, seed in ((0.0, 1), (30.0, 2), (30.0, 1))
    )
    assert plain[0] > 1.0 and abs(plain[1]) < 0.1
    assert wrong[0] > 0.5 and wrong[1] < 0.35
    assert right[0] < 0.05 and right[1] > 0.8


def test_jacobians_are_derivatives() -> None:
    """Against central differences, on planes smooth enough that interpolation is exact."""
    v, u = np.mgrid[0:60, 0:80].astype(np.float32)
    grey = 0.3 + 0.003 * u + 0.002 * v
    inverse_depth = 0.4 + 0.001 * u - 0.0015 * v
    one = np.ones_like(grey)
    level = align_numpy.Level(
        80,
        60,
        (65.0, 66.0, 39.5, 29.5),
        grey,
        0.003 * one,
        0.002 * one,
        inverse_depth,
        inverse_depth,
        0.001 * one,
        -0.0015 * one,
        one,
    )
    points = align_numpy.collect_points(align_numpy.Pyramid((level,), 1, np.zeros(6)), 0)
    T, at_rest = se3.exp(0.3 * MOTION), np.zeros(6)
    values = np.array([1.1, 0.02, 0.01, 0.02, -0.03])
    rows = align_numpy.linearise(points, level, T, at_rest, align_numpy.Appearance(values))
    step = 1e-5
    for k in range(11):
        delta = np.zeros(11)
        delta[k] = step
        ends = [
            align_numpy.linearise(
                points,
                level,
                se3.exp(sign * delta[:6]) @ T,
                at_rest,
                align_numpy.Appearance(values + sign * delta[6:]),
            )
            for sign in (1, -1)
        ]
        use = rows.seen & rows.has_depth & ends[0].has_depth & ends[1].has_depth
        for name, jacobian in (('grey', rows.J_I), ('depth', rows.J_D)):
            slope = (getattr(ends[0], name) - getattr(ends[1], name)) / (2 * step)
            if name == 'depth' and k < 6:
                slope = slope - _pattern_slope(points, level, T, delta[:6], step, values)
            assert np.allclose(jacobian[use, k], slope[use], atol=2e-4), (name, k)


def _pattern_slope(
    points: align_numpy.Points,
    level: align_numpy.Level,
    T: np.ndarray,
    delta: np.ndarray,
    step: float,
    values: np.ndarray,
) -> np.ndarray:
    """Return how the pattern itself moves with the camera: left out of the Jacobian as small."""
    ends = [
        align_numpy._pattern(
            points, align_numpy.warp(points, level, se3.exp(s * delta) @ T, np.zeros(6))
        )
        for s in (1, -1)
    ]
    return (ends[0] - ends[1]) @ values[2:] / (2 * step)


# ---------------------------------------------------------------------------- recording


@needs_native
@pytest.mark.recording
def test_a_recorded_pair_agrees_with_motion_capture(shared_dir: Path) -> None:
    """TUM fr1/rpy, frames 0.07 s apart while the camera turns."""
    folder = shared_dir / 'data' / 'rgbd_dataset_freiburg1_rpy_part'
    distortion = (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
    camera = PinholeCamera(640, 480, 517.3, 516.5, 318.6, 255.3, distortion)
    rectifier = Rectifier(camera)
    names = [_rows(folder / f'{kind}.txt') for kind in ('rgb', 'depth')]
    truth = np.array([[float(x) for x in row] for row in _rows(folder / 'groundtruth.txt')])
    aligner = Aligner(AlignConfig())
    loaded = []
    for index in (100, 102):
        stamp, name = names[0][index]
        depth_name = min(names[1], key=lambda row: abs(float(row[0]) - float(stamp)))[1]
        color = cv2.cvtColor(cv2.imread(str(folder / name)), cv2.COLOR_BGR2RGB)
        raw = cv2.imread(str(folder / depth_name), cv2.IMREAD_UNCHANGED)
        depth = rectifier.depth((raw / 5000.0).astype(np.float32))
        row = truth[np.argmin(np.abs(truth[:, 0] - float(stamp)))]
        pose = se3.from_position_quat_xyzw(row[1:4], row[4:8])
        pyramid = aligner.pyramid(rectifier.color(color), depth, None, rectifier.camera)
        loaded.append((pyramid, pose))
    (reference, pose_a), (current, pose_b) = loaded
    T_true = se3.inverse(pose_b) @ pose_a
    result = aligner.align(reference, current, np.eye(4))
    error = se3.log(result.T_current_reference @ se3.inverse(T_true))
    assert np.linalg.norm(error[:3]) < 0.02  # the truth itself is good to about a centimetre
    assert np.rad2deg(np.linalg.norm(error[3:])) < 1.0
    assert result.inlier_ratio > 0.7


def _rows(path: Path) -> list[list[str]]:
    return [line.split() for line in path.read_text().splitlines() if not line.startswith('#')]


def test_levels_fit_any_width() -> None:
    config = AlignConfig()
    for width, finest in ((640, 320), (320, 320), (848, 424), (1280, 320), (160, 160)):
        block, count = module._levels(width, config)
        assert width // block == finest
        assert finest >> (count - 1) >= 28
    assert module._levels(640, replace(config, fine_width=640))[0] == 1
