"""Plots of trajectories: path from above, and error over time."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.core.files import write_aside
from bdgs_ros.core.types import Trajectory
from bdgs_ros.eval.trajectory import AteResult, transformed

# A validated pair for colour-blind readers; truth is drawn in ink, dashed.
_ESTIMATE = '#2a78d6'
_TRUTH = '#52514e'
_INK = '#0b0b0b'
_GRID = '#e4e3df'
_LINES = (_ESTIMATE, '#c2410c', '#52514e', '#7c3aed')
_STYLES = 'o-', 's--', '^:', 'v-.'
_AXES = 'xyz'


def plot_trajectory(
    path: Path,
    est: Trajectory,
    gt: Trajectory | None = None,
    ate: AteResult | None = None,
    title: str = '',
) -> None:
    """
    Draw the estimated path, over the true one where known, and the error of each frame.

    The view is along the axis in which the path extends least. With truth the estimate is drawn
    after the alignment of `ate`.

    Parameters
    ----------
    path : Path
        A .png, .pdf or .svg file.
    est : Trajectory
        In its own world frame.
    gt : Trajectory, optional
        The truth; together with `ate`.
    ate : AteResult, optional
        The comparison of the two.
    title : str
        Written above the plot.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    compared = gt is not None and ate is not None
    figure = Figure(figsize=(10, 4.2) if compared else (5.2, 4.2), layout='constrained')
    FigureCanvasAgg(figure)
    columns = figure.subplots(1, 2 if compared else 1, squeeze=False)[0]
    if gt is not None and ate is not None:
        inside = _near(gt, est)
        _draw_path(columns[0], transformed(ate.T_gt_est, est), gt.positions[inside])
        _draw_error(columns[1], ate)
    else:
        _draw_path(columns[0], est.positions, None)
    if title:
        figure.suptitle(title, color=_INK, fontsize=11)
    write_aside(path, lambda aside: figure.savefig(aside, dpi=130))


def plot_reliability(path: Path, within: Mapping[str, Mapping[int, float]]) -> None:
    """
    Draw which share of poses is in ellipsoids that a share of honest ones is in.

    Parameters
    ----------
    path : Path
        A .png, .pdf or .svg file.
    within : mapping of str to mapping of int to float
        For each recording, the share found by the share that is honest, both in percent.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(6.4, 4.2), layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    axes.plot([0, 100], [0, 100], color='0.6', lw=1, label='honest')
    for i, (name, shares) in enumerate(within.items()):
        style, color = _STYLES[i // len(_LINES) % len(_STYLES)], _LINES[i % len(_LINES)]
        axes.plot(list(shares), list(shares.values()), style, color=color, ms=4, label=name)
    axes.set(xlabel='said [% of poses]', ylabel='found [%]', xlim=(40, 100), ylim=(0, 101))
    axes.set_title('above the line: modest; below: further off than was said', fontsize=9)
    axes.legend(frameon=False, fontsize=7, loc='center left', bbox_to_anchor=(1, 0.5))
    _tidy(axes)
    write_aside(path, lambda aside: figure.savefig(aside, dpi=130))


def plot_errors(path: Path, results: Mapping[str, AteResult], title: str = '') -> None:
    """
    Draw the error of every frame over time, of several trajectories of one recording.

    Parameters
    ----------
    path : Path
        A .png, .pdf or .svg file.
    results : mapping of str to AteResult
        By the name of each trajectory; four at most.
    title : str
        Written above the plot.

    """
    from matplotlib.backends.backend_agg import FigureCanvasAgg
    from matplotlib.figure import Figure

    figure = Figure(figsize=(8, 3.4), layout='constrained')
    FigureCanvasAgg(figure)
    axes = figure.subplots()
    start_ns = min(int(result.stamps_ns[0]) for result in results.values())
    for color, (name, result) in zip(_LINES, results.items(), strict=False):
        seconds = (result.stamps_ns - start_ns) * 1e-9
        label = f'{name}: RMSE {100.0 * result.statistics.rmse:.2f} cm'
        axes.plot(seconds, 100.0 * result.errors_m, color=color, lw=1.4, label=label)
    axes.set(xlabel='time [s]', ylabel='error [cm]', title=title, ylim=(0, None))
    axes.legend(frameon=False, fontsize=9)
    _tidy(axes)
    write_aside(path, lambda aside: figure.savefig(aside, dpi=130))


def _near(gt: Trajectory, est: Trajectory) -> NDArray[np.bool_]:
    """Keep the truth of the time that was estimated, with a second to either side."""
    stamps, margin = gt.stamps_ns, 10**9
    near = (stamps >= est.stamps_ns[0] - margin) & (stamps <= est.stamps_ns[-1] + margin)
    return np.asarray(near)


def _draw_path(axes: Any, est: NDArray[np.float64], gt: NDArray[np.float64] | None) -> None:
    reference = est if gt is None else gt
    extent = np.ptp(reference, axis=0)
    a, b = sorted(np.argsort(extent)[1:])
    if gt is not None:
        axes.plot(gt[:, a], gt[:, b], color=_TRUTH, lw=1.6, ls='--', label='ground truth')
    axes.plot(est[:, a], est[:, b], color=_ESTIMATE, lw=1.6, label='estimate')
    axes.plot(*est[0, [a, b]], 'o', color=_ESTIMATE, ms=7, mec='white', mew=1.5, label='start')
    axes.set(xlabel=f'{_AXES[a]} [m]', ylabel=f'{_AXES[b]} [m]', title='path')
    axes.set_aspect('equal', adjustable='datalim')
    axes.legend(frameon=False, fontsize=9)
    _tidy(axes)


def _draw_error(axes: Any, ate: AteResult) -> None:
    seconds = (ate.stamps_ns - ate.stamps_ns[0]) * 1e-9
    rmse_cm = 100.0 * ate.statistics.rmse
    axes.plot(seconds, 100.0 * ate.errors_m, color=_ESTIMATE, lw=1.4)
    axes.axhline(rmse_cm, color=_TRUTH, lw=1.0, ls='--')
    title = f'error of every frame; dashed: RMSE {rmse_cm:.2f} cm'
    axes.set(xlabel='time [s]', ylabel='error [cm]', title=title, ylim=(0, None))
    _tidy(axes)


def _tidy(axes: Any) -> None:
    axes.grid(color=_GRID, lw=0.8)
    axes.set_axisbelow(True)
    axes.tick_params(colors=_TRUTH, labelsize=9)
    axes.title.set_fontsize(10)
    for side in ('top', 'right'):
        axes.spines[side].set_visible(False)
