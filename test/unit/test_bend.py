"""The functions of a bend, at rays and at all pixels of an image."""

import numpy as np

from bdgs_ros.core.bend import BENDS, bend_functions, inverse_depth_bend
from bdgs_ros.core.camera import PinholeCamera


def test_the_image_of_a_bend_is_that_of_its_functions() -> None:
    camera = PinholeCamera(64, 48, 55.0, 57.0, 30.2, 25.1)
    coefficients = (-0.008, 0.004, -0.012, -0.01, 0.006)
    functions = bend_functions(camera.rays().reshape(-1, 3)[:, :2])
    assert functions.shape == (64 * 48, BENDS)
    image = inverse_depth_bend(camera, coefficients)
    np.testing.assert_allclose(image.ravel(), functions @ coefficients, atol=1e-7)
