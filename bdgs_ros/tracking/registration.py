"""
Whether colour and depth belong together: in time, and pixel by pixel.

Where depth jumps from a thing to what is behind it, colour mostly changes as well. Edges of depth
are laid over the edges of colour images taken earlier and later, and scaled and shifted: where
they fit best tells by how much the two are apart (the edges of a depth image that is not
registered fit after some scale and shift; those of one that is late fit on an earlier image). No
pose and no map is needed, so what is found holds whether or not tracking works.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Generator, Iterable, Sequence
from dataclasses import dataclass

import cv2
import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.config.tracking import RegistrationConfig
from bdgs_ros.core.types import RgbdFrame

_log = logging.getLogger(__name__)

Array = NDArray[np.float64]
Steps = Generator[None, None, Array]

_WIDTH = 160  # pixels; edges are looked for in images so small
_POINTS, _FEWEST = 400, 50  # of the edges of a depth image: so many are used, so many needed
_DIRECTIONS = 4  # of edges; each edge of colour is of the two that it is between
_NEAREST_M = 0.05
_JUMP = 1.08  # of depth, from a thing to what is behind it
_STRONGEST = 0.12  # share of pixels whose gradients may be edges of colour
_REACH_PX = 1.5  # an edge of depth fits an edge of colour that is about as near
_RIM = 24  # pixels of zeros around; more than twice the furthest shift
_FAR_PX = 100.0  # no edge is
_LAGS = 30  # images earlier and later
_TIMES, _PLACES = 75, 30  # depth images that are tried on others, and at other places
_SCALES = np.exp(0.05 * np.arange(-5, 6))
_SHIFTS = np.linspace(-8, 8, 9)
_FINE_SCALES = np.exp(0.015 * np.arange(-4, 5))
_FINE_SHIFTS = np.linspace(-2, 2, 5)
_BLOCKS = 10  # of time, each left out once
_SURE = 3.0  # sigma
_DISTINCT = 0.02  # better than most lags, in the mean fit
_CLEARLY = 0.005  # better in the mean fit


@dataclass(frozen=True)
class Registration:
    """By how much colour and depth are apart; sigmas are standard deviations."""

    lag_s: float
    """Depth shows what colour showed so much later; negative: earlier."""
    lag_sigma_s: float
    scale: float
    """Of the depth image about the middle, to lie on colour."""
    scale_sigma: float
    shift_px: tuple[float, float]
    """Of the depth image after that, to the right and down."""
    shift_sigma_px: tuple[float, float]
    width: int
    """Of the image that those pixels are of."""
    delay_s: float
    """From the stamp of colour to that of its depth."""

    @property
    def depth_offset_s(self) -> float:
        """By how much stamps of depth are late: the value for `camera.depth_offset_s`."""
        return self.delay_s - self.lag_s

    def is_late(self, config: RegistrationConfig) -> bool:
        """Return whether the two are apart in time."""
        return abs(self.lag_s) > config.lag_s + _SURE * self.lag_sigma_s

    def is_elsewhere(self, config: RegistrationConfig) -> bool:
        """Return whether pixels of the two do not belong together."""
        shifts = zip(self.shift_px, self.shift_sigma_px, strict=True)
        return abs(self.scale - 1) > config.scale + _SURE * self.scale_sigma or any(
            abs(shift) > config.shift * self.width + _SURE * sigma for shift, sigma in shifts
        )

    def objection(self, config: RegistrationConfig) -> str:
        """Say in words how they are apart; nothing where they belong together."""
        found = []
        if self.is_late(config):
            when = 'later' if self.lag_s > 0 else 'earlier'
            found.append(
                f'depth shows what colour showed {1e3 * abs(self.lag_s):.0f} ms {when} '
                f'(+- {1e3 * self.lag_sigma_s:.0f}): synchronise the camera, or set '
                f'camera.depth_offset_s to {self.depth_offset_s:.3f}'
            )
        if self.is_elsewhere(config):
            across, down = self.shift_px
            found.append(
                f'depth is not registered to colour: it fits when scaled by {self.scale:.3f} '
                f'(+- {self.scale_sigma:.3f}) and shifted by ({across:.0f}, {down:.0f}) pixels of '
                f'{self.width}; have the driver register it (aligned_depth_to_color or the like)'
            )
        return '; '.join(found)


@dataclass(frozen=True)
class _Sample:
    """What is kept of a frame."""

    stamp_ns: int
    delay_s: float
    fit: NDArray[np.float32]
    """How well an edge of depth of a direction would fit those of colour, [D, H, W], 0 to 1."""
    points: Array
    """Edges of depth from the middle of the image, (u, v), [N, 2]."""
    direction: NDArray[np.intp]
    """Of each, [N]."""


class RegistrationWatch:
    """
    Measures for some seconds, again at once if that told little, and from time to time.

    Parameters
    ----------
    config : RegistrationConfig
        How long, and what is too much.

    """

    def __init__(self, config: RegistrationConfig) -> None:
        self._config = config
        self._width = 0
        self.found: Registration | None = None
        """The last result."""
        self.reset()

    def reset(self) -> None:
        """Begin anew: the camera may be another."""
        self._samples: list[_Sample] = []
        self._work: Generator[None, None, Registration | None] | None = None
        self._rests_until_ns = 0
        self._windows = 0
        self.found = None

    @property
    def objection(self) -> str:
        """What is wrong, in words; nothing while nothing is known to be."""
        return self.found.objection(self._config) if self.found is not None else ''

    def add(self, frame: RgbdFrame) -> None:
        """Take a frame, and go on measuring for a millisecond or two."""
        if not self._config.enabled or self.objection:
            return
        if self._work is not None:
            self._go_on(self._config.steps)
        elif frame.stamp_ns >= self._rests_until_ns:
            self._collect(frame)

    def finish(self) -> None:
        """Measure by what has been collected: no more frames come."""
        if self._work is None and len(self._samples) >= self._config.least_frames:
            self._begin()
        while self._work is not None:
            self._go_on(1)

    def measured_offset_s(self, frames: Iterable[RgbdFrame]) -> float:
        """Return by how much stamps of depth are late in the first frames; 0 if that is little."""
        for frame in frames:
            self._collect(frame)
            if self._work is not None:
                break
        self.finish()
        late = self.found is not None and self.found.is_late(self._config)
        return self.found.depth_offset_s if self.found is not None and late else 0.0

    def _is_clear(self) -> bool:
        found = self.found
        return found is not None and found.lag_sigma_s < self._config.lag_s

    def _collect(self, frame: RgbdFrame) -> None:
        self._width = frame.camera.width
        self._samples.append(_sample(frame))
        seconds = 1e-9 * (frame.stamp_ns - self._samples[0].stamp_ns)
        if seconds < 0:
            self._samples = []
        elif seconds >= self._config.window_s or len(self._samples) >= self._config.frames:
            self._begin()

    def _begin(self) -> None:
        samples, self._samples = self._samples, []
        self._windows += 1
        self._rests_until_ns = samples[-1].stamp_ns + round(1e9 * self._config.pause_s)
        enough = len(samples) >= self._config.least_frames
        self._work = _measured(samples, self._width) if enough else None

    def _go_on(self, steps: int) -> None:
        try:
            for _ in range(steps):
                assert self._work is not None
                next(self._work)
        except StopIteration as end:
            self._work = None
            self.found = end.value or self.found
            if self._windows == 1 and not self._is_clear():
                self._rests_until_ns = 0
            if self.objection:
                _log.warning('%s', self.objection)


def _sample(frame: RgbdFrame) -> _Sample:
    step = max(1, round(frame.camera.width / _WIDTH))
    height, width = (size // step for size in frame.camera.shape)
    depth = frame.depth_m[step // 2 :: step, step // 2 :: step][:height, :width]
    grey = cv2.resize(
        cv2.cvtColor(frame.color, cv2.COLOR_RGB2GRAY)[: height * step, : width * step],
        (width, height),
        interpolation=cv2.INTER_AREA,
    )
    delay_s = 1e-9 * frame.depth_delay_ns
    return _Sample(frame.stamp_ns, delay_s, _fit(np.asarray(grey)), *_edges(depth))


def _edges(depth_m: NDArray[np.float32]) -> tuple[Array, NDArray[np.intp]]:
    """Return the rims of things, also where no depth is known beside them: [N, 2], [N]."""
    depth_m = np.where(depth_m > 0, depth_m, 0).astype(np.float32)  # NaN is none
    near, far = np.ones((3, 3), np.uint8), np.ones((9, 9), np.uint8)
    beside_hole = cv2.dilate((depth_m == 0).astype(np.uint8), near) > 0
    is_rim = cv2.dilate(depth_m, near) > _JUMP * depth_m
    is_rim |= beside_hole & (cv2.dilate(depth_m, far) > _JUMP * depth_m)
    is_rim &= depth_m > 0
    is_rim[:3] = is_rim[-3:] = False
    is_rim[:, :3] = is_rim[:, -3:] = False
    v, u = np.nonzero(is_rim)
    chosen = np.linspace(0, len(u) - 1, min(len(u), _POINTS)).astype(int)
    u, v = u[chosen], v[chosen]
    filled = np.where(depth_m > 0, depth_m, cv2.dilate(depth_m, far))
    nearness = 1 / np.maximum(filled, _NEAREST_M)
    across, down = (cv2.Sobel(nearness, cv2.CV_32F, *d)[v, u] for d in ((1, 0), (0, 1)))
    height, width = depth_m.shape
    points = np.stack([u - (width - 1) / 2, v - (height - 1) / 2], axis=1)
    return points, np.rint(_turns(across, down)).astype(np.intp) % _DIRECTIONS


def _turns(across: NDArray[np.float32], down: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the directions of gradients, whatever their sign, from 0 to `_DIRECTIONS`."""
    return np.asarray(np.arctan2(down, across) / np.pi % 1 * _DIRECTIONS, np.float32)


def _fit(grey: NDArray[np.uint8]) -> NDArray[np.float32]:
    """Return how near the edges of an image of each direction are, 1 on them, [D, H, W]."""
    across, down = (cv2.Sobel(grey, cv2.CV_16S, *d) for d in ((1, 0), (0, 1)))
    strength = np.abs(across).astype(np.int32) + np.abs(down)
    limit = float(np.quantile(strength, 1 - _STRONGEST))
    edges = cv2.Canny(across, down, 0.5 * limit, limit)
    v, u = np.nonzero(edges)
    turn = _turns(across[v, u].astype(np.float32), down[v, u].astype(np.float32))
    height, width = grey.shape
    fit = np.zeros((_DIRECTIONS, height + 2 * _RIM, width + 2 * _RIM), np.float32)
    for direction in range(_DIRECTIONS):
        off = np.abs((turn - direction + _DIRECTIONS / 2) % _DIRECTIONS - _DIRECTIONS / 2)
        other = np.full(grey.shape, 255, np.uint8)
        other[v[off < 1], u[off < 1]] = 0
        squares = np.minimum(cv2.distanceTransform(other, cv2.DIST_L2, 3), _FAR_PX) ** 2
        near = np.exp(np.float32(-0.5 / _REACH_PX**2) * squares)
        fit[direction, _RIM:-_RIM, _RIM:-_RIM] = near
    return fit


class _Window:
    """Some seconds of images."""

    def __init__(self, samples: Sequence[_Sample], width: int) -> None:
        self.samples = samples
        self.pixels = width / (samples[0].fit.shape[2] - 2 * _RIM)
        self.usable = [i for i, sample in enumerate(samples) if len(sample.points) >= _FEWEST]
        self._stamps_ns = np.array([sample.stamp_ns for sample in samples])
        self.period_ns = float(np.median(np.diff(self._stamps_ns)))

    def later(self, i: int, lag: int) -> int | None:
        """Return which image was taken so many periods after another, if there is one."""
        at_ns = self._stamps_ns[i] + lag * self.period_ns
        after = int(np.searchsorted(self._stamps_ns, at_ns - 0.5 * self.period_ns))
        is_there = (
            after < len(self.samples) and self._stamps_ns[after] < at_ns + self.period_ns / 2
        )
        return after if is_there else None


def _measured(
    samples: Sequence[_Sample], width: int
) -> Generator[None, None, Registration | None]:
    """Measure step by step; None where there are too few edges."""
    window = _Window(samples, width)
    if len(window.usable) < _BLOCKS:
        return None
    lag_first = yield from _lag_then_place(window, None)
    place = yield from _place(window, 0)
    place_first = yield from _lag_then_place(window, place[:3])
    # A place explains what a lag does while the camera moves one way, and the other way round.
    better = lag_first[-1] > place_first[-1] + _CLEARLY
    lag, lag_sigma, scale, across, down, *sigmas, _ = lag_first if better else place_first
    period_s, pixels = 1e-9 * window.period_ns, window.pixels
    return Registration(
        lag * period_s,
        lag_sigma * period_s,
        scale,
        sigmas[0],
        (across * pixels, down * pixels),
        (sigmas[1] * pixels, sigmas[2] * pixels),
        width,
        float(np.median([samples[i].delay_s for i in window.usable])),
    )


def _lag_then_place(window: _Window, place: Array | None) -> Steps:
    """Return (lag, its sigma), in images, and what `_place` returns at that lag."""
    lag = yield from _lag(window, place)
    known = abs(lag[0]) > _SURE * lag[1]
    found = yield from _place(window, round(lag[0]) if known else 0)
    return np.concatenate([lag, found])


def _lag(window: _Window, place: Array | None) -> Steps:
    """Return how many images later the edges of depth fit best, and its sigma."""
    samples = window.samples
    reach = min(_LAGS, len(samples) // 3)
    scale, *shift = (1.0, 0.0, 0.0) if place is None else place
    rows = []
    for i in _evenly(window.usable, _TIMES):
        points = scale * samples[i].points + shift
        row = np.full(2 * reach + 1, np.nan)
        index, *_ = _on_pixels(samples[i].fit, samples[i], points)
        for lag in range(-reach, reach + 1):
            j = window.later(i, lag)
            if j is not None:
                row[reach + lag] = samples[j].fit.reshape(-1).take(index).mean()
        rows.append(row - row[reach])
        yield
    found = _jackknife(np.array(rows), _peak_of_lags)
    curve = _curve(np.array(rows))
    if curve.max() - np.median(curve) < _DISTINCT:
        found[1] = np.inf  # nothing moves
    return found


def _curve(rows: Array) -> Array:
    known = np.isfinite(rows).sum(axis=0)
    return np.asarray(np.where(known > 0, np.nansum(rows, axis=0) / np.maximum(known, 1), -1.0))


def _peak_of_lags(rows: Array) -> Array:
    curve = _curve(rows)
    best = int(np.argmax(curve))
    return np.array([best - len(curve) // 2 + _between(curve, best)])


def _place(window: _Window, lag: int) -> Steps:
    """Return (scale, shift u, v, their sigmas, fit) at which the edges fit best, in pixels."""
    samples = window.samples
    partners = [(i, window.later(i, lag)) for i in window.usable]
    among = [(samples[i], samples[j].fit) for i, j in partners if j is not None]
    pairs = [among[k] for k in _evenly(range(len(among)), _PLACES)]
    if len(pairs) < _BLOCKS:
        return np.array([1.0, 0.0, 0.0, np.inf, np.inf, np.inf, 0.0])
    total = np.zeros((len(_SCALES), len(_SHIFTS), len(_SHIFTS)))
    for sample, fit in pairs:
        total += _cube(fit, sample, _SCALES, _SHIFTS, _SHIFTS)
        yield
    a, b, c = np.unravel_index(int(np.argmax(total)), total.shape)
    grid = _SCALES[a] * _FINE_SCALES, _SHIFTS[b] + _FINE_SHIFTS, _SHIFTS[c] + _FINE_SHIFTS
    cubes = []
    for sample, fit in pairs:
        cubes.append(_cube(fit, sample, *grid))
        yield
    found = _jackknife(np.array(cubes), lambda some: _peak_of_places(some, *grid))
    return np.append(found, np.mean(cubes, axis=0).max())


def _peak_of_places(cubes: Array, scales: Array, across: Array, down: Array) -> Array:
    cube = cubes.mean(axis=0)
    a, b, c = np.unravel_index(int(np.argmax(cube)), cube.shape)
    return np.array(
        [
            scales[a] * (scales[1] / scales[0]) ** _between(cube[:, b, c], int(a)),
            across[b] + (across[1] - across[0]) * _between(cube[a, :, c], int(b)),
            down[c] + (down[1] - down[0]) * _between(cube[a, b], int(c)),
        ]
    )


def _cube(
    fit: NDArray[np.float32], sample: _Sample, scales: Array, across: Array, down: Array
) -> Array:
    """Return the fit of edges at all scales and shifts, which are whole pixels, [S, U, V]."""
    cube = np.empty((len(scales), len(across), len(down)))
    shifts = across.astype(np.intp), down.astype(np.intp)
    for i, scale in enumerate(scales):
        index, u, v = _on_pixels(fit, sample, scale * sample.points)
        moved = index + shifts[0][:, None, None] + (shifts[1] * fit.shape[2])[:, None]
        height, width = fit.shape[1] - 2 * _RIM, fit.shape[2] - 2 * _RIM
        seen = [
            ((at + shift[:, None] >= 0) & (at + shift[:, None] < size)).astype(np.float32)
            for at, shift, size in ((u, shifts[0], width), (v, shifts[1], height))
        ]
        cube[i] = fit.reshape(-1).take(moved).sum(axis=2) / np.maximum(
            seen[0] @ seen[1].T, _FEWEST
        )
    return cube


def _on_pixels(
    fit: NDArray[np.float32], sample: _Sample, points: Array
) -> tuple[NDArray[np.intp], NDArray[np.intp], NDArray[np.intp]]:
    """Return where points are in a fit that has a rim of zeros, and their pixels, each [N]."""
    _, height, width = fit.shape
    middle = np.array([width - 1, height - 1]) / 2 - _RIM
    u, v = np.rint(points + middle).astype(np.intp).T
    inner = _RIM // 2  # what is further out stays on zeros wherever it is shifted
    row = np.clip(v + _RIM, inner, height - 1 - inner)
    column = np.clip(u + _RIM, inner, width - 1 - inner)
    return (sample.direction * height + row) * width + column, u, v


def _between(curve: Array, best: int) -> float:
    """Return where the peak is, in samples from the best: the top of a parabola through five."""
    reach = min(2, best, len(curve) - 1 - best)
    if reach == 0:
        return 0.0
    near = np.arange(-reach, reach + 1)
    bend, slope, _ = np.polyfit(near, curve[best - reach : best + reach + 1], 2)
    return float(np.clip(-0.5 * slope / min(bend, -1e-9), -1, 1))


def _jackknife(rows: Array, estimate: Callable[[Array], Array]) -> Array:
    """Return an estimate and its sigmas, by leaving out blocks of time."""
    blocks = np.array_split(np.arange(len(rows)), _BLOCKS)
    without = np.array([estimate(np.delete(rows, block, axis=0)) for block in blocks])
    spread = ((without - without.mean(axis=0)) ** 2).sum(axis=0)
    sigma = np.sqrt((_BLOCKS - 1) / _BLOCKS * spread)
    return np.concatenate([estimate(rows), sigma])


def _evenly(indices: Sequence[int], most: int) -> list[int]:
    chosen = np.linspace(0, len(indices) - 1, min(len(indices), most)).astype(int)
    return [indices[i] for i in chosen]
