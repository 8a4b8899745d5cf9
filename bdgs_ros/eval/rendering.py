"""
How well does a rendered image match the true one, on the pixels where the truth is known.

Images are float in [0, 1]; a mask is True where the pixel counts.

References
----------
.. [1] Z. Wang et al., "Image quality assessment: from error visibility to structural similarity",
   IEEE TIP 13(4), 2004.

"""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.errors import EvaluationError

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_WINDOW = 11
_SIGMA = 1.5
_C1 = 0.01**2
_C2 = 0.03**2
_MSE_OF_EIGHT_BITS = (1.0 / 255.0) ** 2 / 12.0  # identical images: not infinite, but 58.9 dB


def psnr(image: NDArray[Any], truth: NDArray[Any], valid: Mask | None = None) -> float:
    """
    Return the peak signal-to-noise ratio in dB over the valid pixels.

    Parameters
    ----------
    image, truth : ndarray, shape (H, W, 3)
        Float in [0, 1], or uint8.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that count; all by default.

    Returns
    -------
    psnr : float
        Capped at 58.9 dB, the rounding of 8 bits; NaN if no pixel is valid.

    Raises
    ------
    EvaluationError
        If the shapes differ.

    """
    image, truth, valid = _prepare(image, truth, valid)
    if not valid.any():
        return float('nan')
    mse = float(np.mean((image - truth)[valid] ** 2))
    return float(-10.0 * np.log10(max(mse, _MSE_OF_EIGHT_BITS)))


def ssim(image: NDArray[Any], truth: NDArray[Any], valid: Mask | None = None) -> float:
    """
    Return the mean structural similarity over the valid pixels, Eq. (13) of [1]_.

    Gaussian windows of 11 pixels, sigma 1.5, each normalised over the valid pixels inside it
    (also at the border), so that what is masked out has no influence on what is not.

    Parameters
    ----------
    image, truth : ndarray, shape (H, W, 3)
        Float in [0, 1], or uint8.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that count; all by default.

    Returns
    -------
    ssim : float
        NaN if no pixel is valid.

    Raises
    ------
    EvaluationError
        If the shapes differ.

    """
    image, truth, valid = _prepare(image, truth, valid)
    if not valid.any():
        return float('nan')
    image, truth = image.astype(np.float32), truth.astype(np.float32)  # blurs much faster
    weight = valid.astype(np.float32)
    total = np.maximum(_blur(weight), np.float32(1e-12))[..., None]

    def mean(values: NDArray[Any]) -> NDArray[Any]:
        return np.asarray(_blur(values * weight[..., None]) / total)

    mu_x, mu_y = mean(image), mean(truth)
    var_x = mean(image**2) - mu_x**2
    var_y = mean(truth**2) - mu_y**2
    cov = mean(image * truth) - mu_x * mu_y
    score = ((2 * mu_x * mu_y + _C1) * (2 * cov + _C2)) / (
        (mu_x**2 + mu_y**2 + _C1) * (var_x + var_y + _C2)
    )
    return float(np.mean(score[valid], dtype=np.float64))


def depth_l1(depth_m: NDArray[Any], truth_m: NDArray[Any], valid: Mask | None = None) -> float:
    """
    Return the mean absolute depth error in metres where both depths are known (not 0).

    Parameters
    ----------
    depth_m, truth_m : ndarray, shape (H, W)
        Metres.
    valid : ndarray of bool, shape (H, W), optional
        Pixels that count; all by default.

    Returns
    -------
    error_m : float
        NaN if no pixel has both depths.

    """
    if depth_m.shape != truth_m.shape:
        raise EvaluationError(_shapes('depth images', depth_m, truth_m))
    both = (depth_m > 0) & (truth_m > 0)
    if valid is not None:
        both &= valid
    return float(np.mean(np.abs(depth_m[both] - truth_m[both]))) if both.any() else float('nan')


def fit_exposure(image: NDArray[Any], truth: NDArray[Any], valid: Mask | None = None) -> Array:
    """
    Return `image` with the gain and offset per channel that bring it nearest to `truth`.

    Scores after this fit say how good the map is apart from brightness; they are always reported
    beside, never instead of, the plain ones.

    Parameters
    ----------
    image, truth : ndarray, shape (H, W, 3)
        Float in [0, 1], or uint8.
    valid : ndarray of bool, shape (H, W), optional
        Pixels used for the fit; all by default.

    Returns
    -------
    fitted : ndarray, shape (H, W, 3), float64
        Clipped to [0, 1].

    """
    image, truth, valid = _prepare(image, truth, valid)
    fitted = image.copy()
    if valid.sum() < 2:
        return fitted
    for channel in range(image.shape[2]):
        x = image[..., channel][valid]
        y = truth[..., channel][valid]
        spread = float(np.mean(x * x) - np.mean(x) ** 2)
        # least squares of y = gain x + offset; a flat channel keeps its gain
        gain = float(np.mean(x * y) - np.mean(x) * np.mean(y)) / spread if spread > 0 else 1.0
        fitted[..., channel] = gain * (image[..., channel] - np.mean(x)) + np.mean(y)
    return np.clip(fitted, 0.0, 1.0)


def _blur(values: NDArray[Any]) -> NDArray[Any]:
    # zeros outside: the same blur of the weights makes the border exact
    return np.asarray(
        cv2.GaussianBlur(values, (_WINDOW, _WINDOW), _SIGMA, borderType=cv2.BORDER_CONSTANT)
    )


def _prepare(
    image: NDArray[Any], truth: NDArray[Any], valid: Mask | None
) -> tuple[Array, Array, Mask]:
    if image.shape != truth.shape or image.ndim != 3:
        raise EvaluationError(_shapes('colour images [H, W, 3]', image, truth))
    if valid is None:
        valid = np.ones(image.shape[:2], dtype=bool)
    if valid.shape != image.shape[:2]:
        raise EvaluationError(_shapes('image and mask', image, valid))
    return _unit(image), _unit(truth), valid


def _unit(image: NDArray[Any]) -> Array:
    scale = 1.0 / 255.0 if image.dtype == np.uint8 else 1.0
    return np.asarray(image, dtype=np.float64) * scale


def _shapes(what: str, a: NDArray[Any], b: NDArray[Any]) -> str:
    return f'{what} must have one shape, but are {a.shape} and {b.shape}'
