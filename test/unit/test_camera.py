"""Projection, scaling and rectification."""

from dataclasses import replace

import cv2
import numpy as np
import pytest

from bdgs_ros.core.camera import PinholeCamera, Rectifier
from bdgs_ros.core.errors import DatasetError

FR1 = PinholeCamera(
    640, 480, 517.3, 516.5, 318.6, 255.3, (0.2624, -0.9531, -0.0054, 0.0026, 1.1633)
)


def test_project_inverts_unproject() -> None:
    camera = FR1.rectified()
    depth = np.random.default_rng(0).uniform(0.5, 4, camera.shape).astype(np.float32)
    pixels = camera.project(camera.unproject(depth).reshape(-1, 3))
    v, u = np.mgrid[: camera.height, : camera.width]
    np.testing.assert_allclose(pixels, np.stack([u, v], -1).reshape(-1, 2), atol=1e-3)


def test_project_inverts_tangents() -> None:
    pixels = np.random.default_rng(0).uniform(0, 480, (20, 2))
    rays = np.column_stack([FR1.tangents(pixels), np.ones(20)])
    np.testing.assert_allclose(FR1.project(3 * rays), pixels)


def test_scaling_keeps_the_corners_of_the_image() -> None:
    half = FR1.scaled(0.5)
    left = (-0.5 - FR1.cx) / FR1.fx
    assert (-0.5 - half.cx) / half.fx == pytest.approx(left)
    right = (FR1.width - 0.5 - FR1.cx) / FR1.fx
    assert (half.width - 0.5 - half.cx) / half.fx == pytest.approx(right)


def test_wrong_depth_shape_is_named() -> None:
    with pytest.raises(ValueError, match=r'depth_m: expected shape \(480, 640\)'):
        FR1.unproject(np.zeros((2, 3), np.float32))


def test_rectifier_agrees_with_opencv_point_mapping() -> None:
    """A bright dot lands where cv2.undistortPoints says, in colour and in depth."""
    for source in ([50.0, 40.0], [600.0, 430.0], [320.0, 20.0]):
        color = np.zeros((480, 640, 3), np.uint8)
        depth = np.zeros((480, 640), np.float32)
        u, v = map(int, source)
        color[v - 2 : v + 3, u - 2 : u + 3] = 255
        depth[v - 2 : v + 3, u - 2 : u + 3] = 2.0
        rectifier = Rectifier(FR1)
        expected = cv2.undistortPoints(
            np.array([[source]]), FR1.matrix, np.array(FR1.distortion), P=FR1.matrix
        )[0, 0]
        for image in (rectifier.color(color)[..., 0], rectifier.depth(depth)):
            rows, columns = np.nonzero(image)
            np.testing.assert_allclose([columns.mean(), rows.mean()], expected, atol=0.7)


def test_rectified_depth_has_only_measured_values() -> None:
    depth = np.where(np.arange(640) % 2, 1.0, 3.0).astype(np.float32)[None].repeat(480, 0)
    assert set(np.unique(Rectifier(FR1).depth(depth))) <= {0.0, 1.0, 3.0}


def test_rectifier_without_distortion_copies_nothing() -> None:
    image = np.zeros((480, 640, 3), np.uint8)
    assert Rectifier(FR1.rectified()).color(image) is image


def test_rectifier_refuses_another_size() -> None:
    with pytest.raises(DatasetError, match=r'depth image has shape \(240, 320\)'):
        Rectifier(FR1).depth(np.zeros((240, 320), np.float32))


def test_the_other_models_agree_with_opencv_point_mapping() -> None:
    many = (0.2, -0.3, 0.001, 0.002, 0.1, 0.1, -0.1, 0.05)
    rational = replace(FR1, distortion=many, distortion_model='rational_polynomial')
    fisheye = replace(FR1, distortion=(0.1, -0.05, 0.01, 0.0), distortion_model='equidistant')
    for camera, undistort in (
        (rational, cv2.undistortPoints),
        (fisheye, cv2.fisheye.undistortPoints),
    ):
        depth = np.zeros(camera.shape, np.float32)
        depth[98:103, 448:453] = 2.0
        point = np.array([[[450.0, 100.0]]])
        expected = undistort(point, camera.matrix, np.array(camera.distortion), P=camera.matrix)
        rows, columns = np.nonzero(Rectifier(camera).depth(depth))
        np.testing.assert_allclose([columns.mean(), rows.mean()], expected[0, 0], atol=0.7)
        assert Rectifier(camera).camera.is_rectified
