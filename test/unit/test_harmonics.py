"""View-dependent colour against scipy's spherical harmonics, torch's derivatives and files."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy.special
import torch
from numpy.typing import NDArray

from bdgs_ros.core import se3
from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config import BeliefConfig, MappingConfig
from bdgs_ros.mapping import harmonics
from bdgs_ros.mapping.gaussians import GaussianMap, NewGaussians
from bdgs_ros.mapping.harmonics import Shading, functions
from bdgs_ros.mapping.keyframes import MapKeyframe, build_levels
from bdgs_ros.mapping.optimise import Optimiser
from bdgs_ros.mapping.ply import load_ply, save_ply
from bdgs_ros.mapping.rasterize import render

Array = NDArray[Any]
Pose = NDArray[np.float64]

DEGREES = (1, 2, 3)
T_CAMERA_WORLD = se3.exp(np.array([0.3, -0.2, 0.5, 0.4, -0.7, 0.2]))


def textbook(d: Array, degree: int) -> Array:
    """Real spherical harmonics of unit vectors [N, 3], degree by degree, m = -l .. l, [N, K]."""
    polar, azimuth = np.arccos(d[:, 2]), np.arctan2(d[:, 1], d[:, 0])

    def complex_one(m: int, n: int) -> Array:
        if hasattr(scipy.special, 'sph_harm_y'):
            return np.asarray(scipy.special.sph_harm_y(n, m, polar, azimuth))
        return np.asarray(scipy.special.sph_harm(m, n, azimuth, polar))

    def real_one(m: int, n: int) -> Array:
        y = complex_one(abs(m), n)  # has the Condon-Shortley phase, which 3DGS keeps
        return np.sqrt(2) * y.imag if m < 0 else np.sqrt(2) * y.real if m > 0 else y.real

    return np.stack([real_one(m, n) for n in range(1, degree + 1) for m in range(-n, n + 1)], 1)


def twin(
    means: torch.Tensor, rest: torch.Tensor, dc: torch.Tensor, T: torch.Tensor
) -> torch.Tensor:
    """Colours of degree 1 to 3 as 3DGS writes them down, one Gaussian and channel at a time."""
    centre = -T[:3, :3].T @ T[:3, 3]
    out = []
    for mean, row, constant in zip(means, rest, dc, strict=True):
        x, y, z = (mean - centre) / torch.linalg.norm(mean - centre)
        basis = [-0.48860251 * y, 0.48860251 * z, -0.48860251 * x]
        basis += [1.09254843 * x * y, -1.09254843 * y * z, 0.31539157 * (2 * z**2 - x**2 - y**2)]
        basis += [-1.09254843 * x * z, 0.54627422 * (x**2 - y**2)]
        basis += [-0.59004359 * y * (3 * x**2 - y**2), 2.89061144 * x * y * z]
        basis += [-0.45704580 * y * (4 * z**2 - x**2 - y**2)]
        basis += [0.37317633 * z * (2 * z**2 - 3 * x**2 - 3 * y**2)]
        basis += [-0.45704580 * x * (4 * z**2 - x**2 - y**2), 1.44530572 * z * (x**2 - y**2)]
        basis += [-0.59004359 * x * (x**2 - 3 * y**2)]
        count = len(row) // 3
        for channel in range(3):
            mine = row[channel * count : (channel + 1) * count]
            out.append(
                constant[channel] + sum(c * b for c, b in zip(mine, basis[:count], strict=True))
            )
    return torch.stack(out).reshape(-1, 3)


def arrays(degree: int, count: int = 7) -> tuple[Array, Array, Array]:
    rng = np.random.default_rng(degree)
    sizes = (3, 3 * functions(degree), 3)
    means, rest, dc = (rng.normal(size=(count, n)).astype(np.float32) for n in sizes)
    return means, rest, dc


@pytest.fixture(params=[True, False], ids=['native', 'numpy'])
def native(request: pytest.FixtureRequest) -> bool:
    if request.param and harmonics._kernels is None:
        pytest.skip('bdgs_ros._harmonics is not built')
    return bool(request.param)


def test_the_functions_are_those_of_the_textbook() -> None:
    means, _, _ = arrays(3, 50)
    d = means / np.linalg.norm(means, axis=1, keepdims=True)
    for degree in DEGREES:
        expected = textbook(d.astype(np.float64), degree)
        got = harmonics.basis(np.ascontiguousarray(d.T), functions(degree))
        np.testing.assert_allclose(got, expected, atol=2e-6)


@pytest.mark.parametrize('degree', DEGREES)
def test_colours_and_gradients_are_those_of_the_twin(degree: int, native: bool) -> None:
    means, rest, dc = arrays(degree)
    by_color = np.random.default_rng(9).normal(size=dc.shape).astype(np.float32)
    exact = [torch.tensor(a, dtype=torch.float64, requires_grad=True) for a in (means, rest, dc)]
    expected = twin(exact[0], exact[1], exact[2], torch.tensor(T_CAMERA_WORLD))
    (expected * torch.tensor(by_color)).sum().backward()  # type: ignore[no-untyped-call]
    assert exact[1].grad is not None

    shading = Shading(means, rest, T_CAMERA_WORLD, native=native)
    rows = np.ones(len(means), bool)
    out = np.empty_like(rest)
    shading.gradient(by_color, rows, out)
    np.testing.assert_allclose(shading.colors(dc, rows), expected.detach().numpy(), atol=2e-5)
    np.testing.assert_allclose(out, exact[1].grad.numpy(), rtol=1e-4, atol=1e-5)


def test_other_rows_stay_as_they_are(native: bool) -> None:
    means, rest, dc = arrays(2)
    rows = np.arange(len(means)) % 2 == 0
    shading = Shading(means, rest, T_CAMERA_WORLD, native=native)
    out = np.full_like(rest, 7)
    shading.gradient(dc, rows, out)
    colors = shading.colors(dc, rows)
    assert (out[~rows] == 7).all() and not (out[rows] == 7).any()
    np.testing.assert_array_equal(colors[~rows], dc[~rows])
    assert np.abs(colors[rows] - dc[rows]).max() > 0.1


def test_threads_change_nothing() -> None:
    means, rest, dc = arrays(3, 5000)
    rows = np.ones(len(means), bool)
    one, two = (Shading(means, rest, T_CAMERA_WORLD, threads=t).colors(dc, rows) for t in (1, 2))
    np.testing.assert_array_equal(one, two)


def test_the_other_side_is_the_opposite_at_degree_one(native: bool) -> None:
    means, rest, dc = arrays(1, 1)
    rows = np.ones(1, bool)
    there = np.eye(4)
    there[:3, 3] = -2 * means[0]  # as far behind the Gaussian as the origin is before it
    here = Shading(means, rest, np.eye(4), native=native).colors(dc, rows) - dc
    behind = Shading(means, rest, there, native=native).colors(dc, rows) - dc
    np.testing.assert_allclose(behind, -here, atol=1e-6)


def test_a_gaussian_in_the_camera_breaks_nothing(native: bool) -> None:
    means, rest, dc = arrays(3)
    shading = Shading(np.zeros_like(means), rest, np.eye(4), native=native)
    assert np.isfinite(shading.colors(dc, np.ones(len(dc), bool))).all()


def test_degrees_and_their_numbers() -> None:
    assert [functions(d) for d in range(4)] == [0, 3, 8, 15]
    assert [harmonics.degree_of(n) for n in (0, 9, 24, 45, 10)] == [0, 1, 2, 3, None]


def test_another_degree_keeps_the_coarse_part() -> None:
    _, rest, _ = arrays(2, 4)
    blocks = rest.reshape(4, 3, 8)
    coarse = harmonics.resized(rest, 1).reshape(4, 3, 3)
    np.testing.assert_array_equal(coarse, blocks[:, :, :3])
    fine = harmonics.resized(rest, 3).reshape(4, 3, 15)
    np.testing.assert_array_equal(fine[:, :, :8], blocks)
    assert not fine[:, :, 8:].any()
    assert harmonics.resized(rest, 0).shape == (4, 0)


CAMERA = PinholeCamera(64, 48, 60.0, 60.0, 31.5, 23.5)


def wall(degree: int, spread: float) -> GaussianMap:
    """A wall two metres ahead whose colours change with the direction by about `spread`."""
    rng = np.random.default_rng(0)
    pixels = np.zeros(CAMERA.shape, bool)
    pixels[::2, ::2] = True
    means = CAMERA.unproject(np.full(CAMERA.shape, 2.0, np.float32))[pixels]
    count = len(means)
    gaussians = GaussianMap(BeliefConfig(), degree)
    colors = rng.uniform(0.3, 0.7, (count, 3)).astype(np.float32)
    scales, belief = (np.full(count, value, np.float32) for value in (0.04, 0.1))
    gaussians.append(NewGaussians(means, scales, colors, belief), 0.9, 0)
    shape = gaussians.harmonics.shape
    gaussians.harmonics[:] = rng.normal(0, spread, shape).astype(np.float32)
    return gaussians


def seen(gaussians: GaussianMap, T_camera_world: Pose) -> Array:
    shaded = gaussians.as_gaussians(gaussians.shading(T_camera_world, 1))
    return render(shaded, T_camera_world, CAMERA).color


def views() -> list[MapKeyframe]:
    """The shiny wall from seven places on an arc around it."""
    truth = wall(1, 0.0)
    truth.harmonics[:, [2, 5, 8]] = 0.6, 0.4, -0.5  # of Y_3 = -0.49 x
    out = []
    for i, angle in enumerate(np.linspace(-0.6, 0.6, 7)):
        turned = se3.exp(np.array([0, 0, 0, 0, angle, 0.0]))
        centre = np.eye(4)
        centre[2, 3] = 2.0
        T_world_camera = centre @ turned @ se3.inverse(centre)
        color = (255 * np.clip(seen(truth, se3.inverse(T_world_camera)), 0, 1)).astype(np.uint8)
        depth, still = np.zeros(CAMERA.shape, np.float32), np.zeros(CAMERA.shape, bool)
        levels = build_levels(color, depth, still, CAMERA, 1)
        labels = np.zeros(CAMERA.shape, np.uint8)
        out.append(MapKeyframe(0, i, T_world_camera, labels, levels))
    return out


def test_a_shiny_wall_is_learnt_and_shown_where_it_was_not_seen() -> None:
    """Fitted from six places, tested between the first two; degree 0 shows the average there."""
    config = replace(MappingConfig(), threads=1)
    config = replace(config, rate=replace(config.rate, harmonics=0.005))
    shots = views()
    errors = {}
    for degree in (0, 1):
        gaussians, optimiser = wall(degree, 0.0), Optimiser(config)
        for i in range(240):
            optimiser.step(gaussians, shots[(0, 2, 3, 4, 5, 6)[i % 6]], 0)
        image = seen(gaussians, shots[1].T_camera_world)
        errors[degree] = float(np.sqrt(np.mean((image - shots[1].levels[0].color) ** 2)))
    assert errors[1] < 0.6 * errors[0], errors


def test_without_it_the_map_is_that_of_before() -> None:
    gaussians = wall(0, 0.0)
    assert gaussians.shading(np.eye(4), 1) is None
    assert gaussians.as_gaussians().colors is gaussians.colors


def test_files_keep_it_in_the_layout_of_3dgs(tmp_path: Path) -> None:
    original = wall(2, 0.1)
    save_ply(tmp_path / 'map.ply', original)
    header = (tmp_path / 'map.ply').read_bytes().split(b'end_header')[0].decode()
    names = [line.split()[2] for line in header.splitlines() if line.startswith('property')]
    at = names.index('f_dc_2')
    assert names[at + 1 : at + 26] == [*(f'f_rest_{i}' for i in range(24)), 'opacity']
    for degree, count in ((None, 24), (0, 0), (1, 9), (2, 24), (3, 45)):
        loaded = load_ply(tmp_path / 'map.ply', BeliefConfig(), degree)
        assert loaded.harmonics.shape == (len(original), count)
        assert [m.shape for m in loaded.parameters.moments['harmonics']] == 2 * [
            loaded.harmonics.shape
        ]
        expected = harmonics.resized(original.harmonics, degree_of_count(count))
        np.testing.assert_array_equal(loaded.harmonics, expected)
        np.testing.assert_allclose(loaded.colors, original.colors, atol=1e-6)


def degree_of_count(count: int) -> int:
    degree = harmonics.degree_of(count)
    assert degree is not None
    return degree


def test_what_is_cut_off_is_said(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    save_ply(tmp_path / 'map.ply', wall(2, 0.1))
    load_ply(tmp_path / 'map.ply', BeliefConfig(), 1)
    assert 'degree 2; cut to mapping.color.degree = 1' in caplog.text


def test_a_number_of_coefficients_that_is_no_degree_is_passed_over(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    path = tmp_path / 'map.ply'
    save_ply(path, wall(1, 0.1))
    content = path.read_bytes()
    path.write_bytes(content.replace(b'f_rest_8', b'f_best_8', 1))
    assert load_ply(path, BeliefConfig(), 1).harmonics.max() == 0
    assert '8 f_rest properties make no degree' in caplog.text
