"""
Direct RGB-D alignment of the current frame to a reference image of known pose.

The reference is a keyframe or a rendered view of the static map. Both images become pyramids;
Gauss-Newton from the coarsest to the finest level finds `T_current_reference`. The method is
written down in `align_numpy`, the readable twin of the compiled kernel that runs here.
"""

from __future__ import annotations

import logging
from dataclasses import dataclass, replace
from functools import cached_property
from importlib import import_module
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.camera import PinholeCamera
from bdgs_ros.core.config.tracking import AlignConfig
from bdgs_ros.core.errors import ConfigError
from bdgs_ros.core.types import DepthImage, Pose, ProbabilityImage
from bdgs_ros.tracking import align_numpy

_aligner: ModuleType | None
try:
    _aligner = import_module('bdgs_ros._aligner')
except ImportError:
    _aligner = None

_log = logging.getLogger(__name__)

_FINE_LEVELS = 2  # of a refinement
_FEWEST_POINTS = 256  # per level
_AT_REST = np.zeros(6)
CELL = 4  # pixels
_OPEN = 10.0  # m and rad, standard deviation of what the images do not tell


@dataclass(frozen=True)
class ImagePyramid:
    """
    One image prepared for alignment; made by `Aligner.pyramid` and reused.

    `handle` belongs to the backend; `widths` are those of its levels, finest first.
    """

    handle: Any
    camera: PinholeCamera
    widths: tuple[int, ...]

    @cached_property
    def depth_m(self) -> float:
        """Median; 1 where there is none. Only references are asked."""
        return _median_depth(self.handle.level(len(self.widths) - 1))


@dataclass(frozen=True)
class AlignResult:
    """Where the reference lies in the current camera, and how well the two images agree."""

    T_current_reference: Pose
    covariance: NDArray[np.float64]
    """Shape (6, 6): of xi = (rho, phi) in `exp(xi) @ T_current_reference`, m^2 and rad^2."""
    inlier_ratio: float
    """Share of the compared pixels whose colour and depth agree."""
    texture: float
    """Correlation of the gradients of grey: 1 the same, 0 nothing in common."""
    coverage: float
    """Compared static pixels over all pixels of the finest level."""
    overlap: float
    """Share of the static pixels of the reference with depth that the current image shows."""
    depth_m: float
    """Median depth of the reference."""
    median_intensity: float
    """Median absolute colour residual, grey level in [0, 1]."""
    median_depth_sigma: float
    """Median absolute depth residual in sigma_z."""
    iterations: int
    converged: bool
    gain: float
    """Exposure: the current grey level is `gain * reference + bias`."""
    bias: float
    depth_pattern: NDArray[np.float64]
    """Shape (3,): xx, yy, xy of the sensor's error of inverse depth over the image, 1/m."""


@dataclass(frozen=True)
class ResidualMaps:
    """What the current image shows against the reference, per pixel of a pyramid level."""

    depth_sigma: NDArray[np.float32]
    """Positive where the image is nearer than the reference, negative where it sees through."""
    color: NDArray[np.float32]
    """Grey level of the reference minus that of the image."""
    valid: NDArray[np.bool_]
    """Both have depth here."""


@dataclass(frozen=True)
class Cells:
    """What C squares of an image say of the motion, row by row."""

    information: NDArray[np.float64]
    """Shape (C, 6, 6): of xi = (rho, phi) in `exp(xi) @ T_current_reference`."""
    gradient: NDArray[np.float64]
    """Shape (C, 6): of half the cost."""
    cost: NDArray[np.float64]
    """Shape (C,): squared residuals over their variance, weighted; so are the next."""
    weight: NDArray[np.float64]
    depth_m: NDArray[np.float64]
    seen: NDArray[np.float64]
    """Points."""
    columns: int
    plane: NDArray[np.float64]
    """Shape (C, 3): inverse depth of the image and its slope along u and v, per square; mean."""


class Aligner:
    """
    Coarse-to-fine Gauss-Newton on colour and inverse depth; one thread.

    Parameters
    ----------
    config : AlignConfig
        Sizes, noise and iterations; `backend` chooses the compiled kernel or its numpy twin.

    Raises
    ------
    ConfigError
        If the compiled kernel is asked for and was not built.

    Examples
    --------
    >>> aligner = Aligner(AlignConfig())
    >>> reference = aligner.pyramid(color_a, depth_a, None, camera)
    >>> current = aligner.pyramid(color_b, depth_b, None, camera)
    >>> T_b_a = aligner.align(reference, current, np.eye(4)).T_current_reference

    """

    def __init__(self, config: AlignConfig) -> None:
        self._config = config
        self._backend = _choose_backend(config.backend)
        self._params = _make_params(config, self._backend)

    def compare(self, share: float) -> None:
        """Compare this share of `max_points` from now on: a frame costs less, and is noisier."""
        self._params.max_points = max(round(share * self._config.max_points), _FEWEST_POINTS)

    def pyramid(
        self,
        image: NDArray[np.uint8],
        depth_m: DepthImage,
        p_dynamic: ProbabilityImage | None,
        camera: PinholeCamera,
        sweep: NDArray[np.float64] | None = None,
    ) -> ImagePyramid:
        """
        Prepare an image for alignment, as reference or as current.

        Parameters
        ----------
        image : ndarray, shape (H, W) or (H, W, 3), uint8
            Grey or RGB.
        depth_m : ndarray, shape (H, W), float32
            0 or NaN where invalid.
        p_dynamic : ndarray, shape (H, W), uint8, optional
            P(dynamic) x 255; None where everything may be static.
        camera : PinholeCamera
            Rectified.
        sweep : ndarray, shape (6,), optional
            Motion of the camera while the image was read out, (rho, phi) in its frame; None
            for a global shutter, or a camera at rest.

        Raises
        ------
        ValueError
            If an image does not have the camera's height and width.

        """
        _check_shapes(image, depth_m, p_dynamic, camera)
        block, count = _levels(camera.width, self._config)
        handle = self._backend.build_pyramid(
            np.ascontiguousarray(image),
            np.ascontiguousarray(depth_m, dtype=np.float32),
            p_dynamic,
            camera.width,
            camera.height,
            camera.fx,
            camera.fy,
            camera.cx,
            camera.cy,
            block,
            count,
            self._config.depth_noise,
            _AT_REST if sweep is None else sweep,
        )
        widths = tuple(handle.level(i).width for i in range(count))
        return ImagePyramid(handle, camera, widths)

    def with_dynamic(
        self,
        pyramid: ImagePyramid,
        p_dynamic: ProbabilityImage,
        sweep: NDArray[np.float64] | None = None,
    ) -> ImagePyramid:
        """
        Return the pyramid of the same image with another mask and motion during the readout.

        Far cheaper than a new one.
        """
        height, width = pyramid.camera.shape
        still = _AT_REST if sweep is None else sweep
        handle = self._backend.with_dynamic(pyramid.handle, p_dynamic, width, height, still)
        return replace(pyramid, handle=handle)

    def align(
        self,
        reference: ImagePyramid,
        current: ImagePyramid,
        T_current_reference_init: Pose,
        fine_only: bool = False,
        prior_information: NDArray[np.float64] | None = None,
        T_current_reference_prior: Pose | None = None,
    ) -> AlignResult:
        """
        Find the pose of the reference in the current camera.

        Parameters
        ----------
        reference, current : ImagePyramid
            Of any sizes: levels are paired by width.
        T_current_reference_init : ndarray, shape (4, 4)
            Start.
        fine_only : bool
            Skip the coarse levels: the start is good to a few pixels.
        prior_information : ndarray, shape (6, 6), optional
            Inverse covariance of the prior; decides where the images cannot.
        T_current_reference_prior : ndarray, shape (4, 4), optional
            Mean of the prior; by default the start.

        Returns
        -------
        result : AlignResult
            Always finite; whether to believe it is told by its ratios.

        """
        pairs = _pair_levels(reference.widths, current.widths)
        start = np.ascontiguousarray(T_current_reference_init, dtype=np.float64)
        prior = start
        if T_current_reference_prior is not None:
            prior = np.ascontiguousarray(T_current_reference_prior, dtype=np.float64)
        information = None
        if prior_information is not None:
            information = prior_information * self._config.correlated_pixels
        raw = self._backend.align(
            reference.handle,
            current.handle,
            pairs[-_FINE_LEVELS:] if fine_only else pairs,
            start,
            prior if information is not None else None,
            information,
            self._params,
        )
        return self._result(raw, reference, pairs[-1][0])

    def residual_maps(
        self,
        reference: ImagePyramid,
        current: ImagePyramid,
        T_current_reference: Pose,
        width: int = 160,
        gain: float = 1.0,
        bias: float = 0.0,
    ) -> ResidualMaps:
        """
        Warp the reference into the current view and compare depth and colour.

        The reference goes through a z-buffer, one level finer than the map so that no holes
        open. A pixel is compared with the whole range of the reference within one pixel: edges
        that are off by one pixel are no evidence.

        Parameters
        ----------
        reference, current : ImagePyramid
            The static model and the frame.
        T_current_reference : ndarray, shape (4, 4)
            As aligned.
        width : int
            Wanted width of the maps; the nearest level is taken.
        gain, bias : float
            Exposure as aligned.

        """
        target = _nearest(current.widths, width)
        source = _nearest(reference.widths, 2 * current.widths[target])
        depth_sigma, color, valid = self._backend.residual_maps(
            reference.handle,
            current.handle,
            source,
            target,
            np.ascontiguousarray(T_current_reference, dtype=np.float64),
            gain,
            bias,
            self._params,
        )
        return ResidualMaps(depth_sigma, color, valid.astype(bool))

    def cells(
        self,
        reference: ImagePyramid,
        current: ImagePyramid,
        result: AlignResult,
        width: int = 80,
    ) -> Cells:
        """
        Ask every square of the current image what it says of the motion, on its own.

        Parameters
        ----------
        reference, current : ImagePyramid
            What was aligned; masks are ignored.
        result : AlignResult
            Where: motions are small ones from there.
        width : int
            Wanted width of the image that squares of `CELL` pixels are cut of.

        """
        target = _nearest(current.widths, width)
        raw = self._backend.cells(
            reference.handle,
            current.handle,
            _nearest(reference.widths, current.widths[target]),
            target,
            np.ascontiguousarray(result.T_current_reference, dtype=np.float64),
            result.gain,
            result.bias,
            result.depth_pattern,
            CELL,
            self._params,
        )
        return Cells(**raw, plane=_planes(current.handle.level(target)))

    def _result(self, raw: dict[str, Any], reference: ImagePyramid, level: int) -> AlignResult:
        finest = reference.handle.level(level)
        return AlignResult(
            T_current_reference=raw['T'],
            covariance=self._covariance(raw),
            inlier_ratio=raw['inliers'] / max(raw['compared'], 1),
            texture=raw['texture'],
            coverage=raw['compared'] / (finest.width * finest.height),
            overlap=raw['in_view'] / max(raw['reference'], 1),
            depth_m=reference.depth_m,
            median_intensity=raw['median_intensity'],
            median_depth_sigma=raw['median_inverse_depth'] / self._config.depth_noise,
            iterations=raw['iterations'],
            converged=raw['converged'],
            gain=raw['gain'],
            bias=raw['bias'],
            depth_pattern=raw['pattern'],
        )

    def _covariance(self, raw: dict[str, Any]) -> NDArray[np.float64]:
        """Invert what both images say; scaled by the residuals and by pixels that err together."""
        information = raw['agreed'].copy()
        information[8:, 8:] += np.eye(3) * self._params.pattern_information
        information += np.diag(1e-9 + 1e-6 * np.abs(np.diag(information)))
        motion, mixed, other = information[:6, :6], information[:6, 6:], information[6:, 6:]
        variance = max(raw['cost'] / max(raw['weight'], 1.0), 1e-3)
        scale = variance * self._config.correlated_pixels
        return _inverse(motion - mixed @ np.linalg.solve(other, mixed.T), scale)


def _inverse(information: NDArray[np.float64], scale: float) -> NDArray[np.float64]:
    """Return the covariance; what is left open is as wide as `_OPEN`."""
    values, axes = np.linalg.eigh(information / scale)
    return np.asarray((axes / np.maximum(values, _OPEN**-2)) @ axes.T)


def _choose_backend(name: str) -> ModuleType:
    if name == 'numpy':
        return align_numpy
    if _aligner is not None:
        return _aligner
    if name == 'native':
        raise ConfigError(
            "tracking.align.backend = 'native', but bdgs_ros._aligner is not built; install a "
            "C++17 compiler and this package again, or take 'auto'"
        )
    _warn_once()
    return align_numpy


_warned = False


def _warn_once() -> None:
    global _warned
    if not _warned:
        _log.warning(
            'bdgs_ros._aligner is not built: tracking runs on its numpy twin, far below camera '
            'rate; install a C++17 compiler and this package again'
        )
    _warned = True


def _make_params(config: AlignConfig, backend: ModuleType) -> Any:
    params = backend.Params()
    for name in (
        'max_iterations',
        'stop_px',
        'dof',
        'intensity_noise',
        'pixel_noise',
        'depth_noise',
        'depth_weight',
        'inlier_intensity',
        'inlier_depth_sigma',
        'min_static',
        'shade',
        'max_points',
    ):
        setattr(params, name, getattr(config, name))
    params.pattern_information = config.correlated_pixels / config.pattern_sigma**2
    return params


def _check_shapes(
    image: NDArray[np.uint8],
    depth_m: DepthImage,
    p_dynamic: ProbabilityImage | None,
    camera: PinholeCamera,
) -> None:
    images: dict[str, NDArray[Any] | None] = {
        'image': image,
        'depth_m': depth_m,
        'p_dynamic': p_dynamic,
    }
    for name, array in images.items():
        if array is not None and array.shape[:2] != camera.shape:
            raise ValueError(
                f'{name}: expected height and width {camera.shape}, received {array.shape}'
            )


def _levels(width: int, config: AlignConfig) -> tuple[int, int]:
    """Return the block of input pixels averaged for the finest level, and how many levels."""
    block = 2 ** max(0, round(np.log2(width / config.fine_width)))
    finest = width // block
    count = 1
    while finest >> count >= 0.7 * config.coarse_width:
        count += 1
    return block, count


def _planes(level: Any) -> NDArray[np.float64]:
    """Return inverse depth and its slopes of each square, 0 where none of it is one surface."""
    rows, columns = -(-level.height // CELL), -(-level.width // CELL)
    images = np.zeros((4, rows * CELL, columns * CELL), np.float32)
    seen = images[:, : level.height, : level.width]
    seen[:] = level.smooth > 0, level.smooth, level.dx, level.dy
    seen[2:] *= CELL
    count, *sums = images.reshape(4, rows, CELL, columns, CELL).sum(axis=(2, 4)).reshape(4, -1)
    return np.asarray(np.stack(sums, axis=1) / np.maximum(count, 1)[:, None], np.float64)


def _median_depth(level: Any) -> float:
    known = level.inverse_depth[level.inverse_depth > 0]
    return 1.0 / float(np.median(known)) if len(known) else 1.0


def _pair_levels(reference: tuple[int, ...], current: tuple[int, ...]) -> list[tuple[int, int]]:
    """Pair every level of the image with fewer pixels with the other's nearest, coarse first."""
    if reference[0] <= current[0]:
        pairs = [(i, _nearest(current, width)) for i, width in enumerate(reference)]
    else:
        pairs = [(_nearest(reference, width), i) for i, width in enumerate(current)]
    return pairs[::-1]


def _nearest(widths: tuple[int, ...], width: int) -> int:
    """Return the level whose width is nearest in ratio."""
    return int(np.argmin(np.abs(np.log(np.array(widths) / width))))
