"""
How far is an estimated trajectory from the true one: ATE and RPE.

Protocol, everywhere in this package: every estimated pose (all frames, not keyframes alone) is
paired with the ground-truth pose nearest in time within 20 ms; ATE after rigid alignment without
scale. Held against evo in `test/unit/test_eval_trajectory.py`.

References
----------
.. [1] B. K. P. Horn, "Closed-form solution of absolute orientation using unit quaternions",
   JOSA A 4(4), 1987.
.. [2] J. Sturm et al., "A benchmark for the evaluation of RGB-D SLAM systems", IROS 2012.

"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.spatial.transform import Rotation

from bdgs_ros.core import se3
from bdgs_ros.core.errors import EvaluationError
from bdgs_ros.core.types import Pose, Trajectory
from bdgs_ros.eval.metric import Metric

Array = NDArray[np.float64]
Index = NDArray[np.int64]

MAX_DIFFERENCE_S = 0.02
_MIN_PAIRS = 3


@dataclass(frozen=True)
class ErrorStatistics:
    """Statistics of non-negative errors; `std` is that of the population."""

    rmse: float
    mean: float
    median: float
    std: float
    min: float
    max: float

    @classmethod
    def of(cls, errors: Array) -> ErrorStatistics:
        """Summarise errors, shape (N,)."""
        return cls(
            rmse=float(np.sqrt(np.mean(errors**2))),
            mean=float(np.mean(errors)),
            median=float(np.median(errors)),
            std=float(np.std(errors)),
            min=float(np.min(errors)),
            max=float(np.max(errors)),
        )

    def metrics(self, prefix: str, scale: float, unit: str) -> list[Metric]:
        """Return the six numbers, multiplied by `scale`, as `<prefix>_rmse` and so on."""
        return [Metric(f'{prefix}_{k}', v * scale, unit) for k, v in vars(self).items()]


@dataclass(frozen=True)
class AteResult:
    """Absolute trajectory error of all estimated frames."""

    statistics: ErrorStatistics
    """Metres."""
    errors_m: Array
    """Shape (P,), of each pair."""
    stamps_ns: Index
    """Shape (P,), of the estimated pose of each pair."""
    T_gt_est: Pose
    """The alignment: maps the estimate's world to that of the ground truth."""
    frames: int
    frames_expected: int

    @property
    def pairs(self) -> int:
        """How many poses had a ground-truth pose near enough."""
        return len(self.errors_m)

    @property
    def coverage_percent(self) -> float:
        """Frames with a pose over frames expected."""
        return 100.0 * self.frames / self.frames_expected

    def metrics(self) -> list[Metric]:
        """Return all numbers, errors in cm."""
        return [
            *self.statistics.metrics('ate', 100.0, 'cm'),
            Metric('coverage', self.coverage_percent, '%'),
            Metric('frames', self.frames),
            Metric('pairs', self.pairs),
        ]


@dataclass(frozen=True)
class RpeResult:
    """Relative pose error over a fixed step."""

    translation: ErrorStatistics
    """Metres per step."""
    rotation: ErrorStatistics
    """Degrees per step."""
    pairs: int
    step: str

    def metrics(self, suffix: str) -> list[Metric]:
        """Return the numbers as `rpe_translation_<suffix>_rmse` and so on, in cm and degrees."""
        return [
            *self.translation.metrics(f'rpe_translation_{suffix}', 100.0, f'cm per {self.step}'),
            *self.rotation.metrics(f'rpe_rotation_{suffix}', 1.0, f'deg per {self.step}'),
        ]


def associate(
    gt: Trajectory, est: Trajectory, max_difference_s: float = MAX_DIFFERENCE_S
) -> tuple[Index, Index]:
    """
    Pair every estimated pose with the ground-truth pose nearest in time.

    A ground-truth pose may serve two estimated ones, so that a fast camera with slow ground truth
    is scored on all its frames.

    Returns
    -------
    gt_index, est_index : ndarray, shape (P,), int64
        Rows of the two trajectories.

    Raises
    ------
    EvaluationError
        If a trajectory is empty or out of order, or fewer than three poses find a partner.

    """
    for name, trajectory in (('ground truth', gt), ('estimate', est)):
        _check_order(name, trajectory)
    right = np.clip(np.searchsorted(gt.stamps_ns, est.stamps_ns), 1, max(len(gt) - 1, 1))
    right = np.minimum(right, len(gt) - 1)
    left = np.maximum(right - 1, 0)
    to_left = np.abs(est.stamps_ns - gt.stamps_ns[left])
    to_right = np.abs(gt.stamps_ns[right] - est.stamps_ns)
    nearest = np.where(to_left <= to_right, left, right)
    difference_ns = np.minimum(to_left, to_right)
    est_index = np.flatnonzero(difference_ns <= round(max_difference_s * 1e9))
    if len(est_index) < _MIN_PAIRS:
        raise EvaluationError(_no_pairs(gt, est, len(est_index), max_difference_s))
    return nearest[est_index].astype(np.int64), est_index.astype(np.int64)


def _check_order(name: str, trajectory: Trajectory) -> None:
    if len(trajectory) == 0:
        raise EvaluationError(f'the {name} has no poses')
    back = np.flatnonzero(np.diff(trajectory.stamps_ns) < 0)
    if len(back):
        row = int(back[0]) + 1
        raise EvaluationError(
            f'the {name} goes back in time at pose {row} of {len(trajectory)} '
            f'(stamp {trajectory.stamps_ns[row] * 1e-9:.6f} s); sort it by stamp'
        )


def _no_pairs(gt: Trajectory, est: Trajectory, pairs: int, max_difference_s: float) -> str:
    span = '{:.3f} to {:.3f} s'
    return (
        f'{pairs} of {len(est)} estimated poses have a ground-truth pose within '
        f'{max_difference_s * 1e3:g} ms, but {_MIN_PAIRS} are needed; estimate spans '
        f'{span.format(*est.stamps_ns[[0, -1]] * 1e-9)}, ground truth '
        f'{span.format(*gt.stamps_ns[[0, -1]] * 1e-9)}; check that they belong together, or '
        'raise --max-difference'
    )


def align(points_gt: Array, points_est: Array) -> Pose:
    """
    Find the rigid motion that best maps estimated points onto true ones [1]_.

    Minimises sum ||gt_i - (R est_i + t)||^2. Symbols: est is Horn's "left", gt his "right".

    Parameters
    ----------
    points_gt, points_est : ndarray, shape (N, 3)
        Corresponding points in metres. Collinear points leave the turn about their line free;
        one of the best rotations is returned.

    Returns
    -------
    T_gt_est : ndarray, shape (4, 4)

    """
    center_gt, center_est = points_gt.mean(axis=0), points_est.mean(axis=0)  # section 2.C
    S = (points_est - center_est).T @ (points_gt - center_gt)  # M of section 3.A: S_ab, a est
    delta = np.array([S[1, 2] - S[2, 1], S[2, 0] - S[0, 2], S[0, 1] - S[1, 0]])
    N = np.empty((4, 4))  # section 3.A, the symmetric matrix N
    N[0, 0] = np.trace(S)
    N[0, 1:] = N[1:, 0] = delta
    N[1:, 1:] = S + S.T - np.trace(S) * np.eye(3)
    _, vectors = np.linalg.eigh(N)
    quat_wxyz = vectors[:, -1]  # section 3.B: eigenvector of the most positive eigenvalue
    rotation = Rotation.from_quat(np.roll(quat_wxyz, -1)).as_matrix()
    translation = center_gt - rotation @ center_est  # section 2.C with scale 1
    return se3.from_rotation_translation(rotation, translation)


def ate(
    gt: Trajectory,
    est: Trajectory,
    max_difference_s: float = MAX_DIFFERENCE_S,
    frames_expected: int | None = None,
) -> AteResult:
    """
    Measure the absolute trajectory error of all estimated frames [2]_.

    Parameters
    ----------
    gt, est : Trajectory
        Each in its own world frame.
    max_difference_s : float
        Pairs further apart in time are not compared.
    frames_expected : int, optional
        How many frames should have a pose. By default the number that fits in the ground truth's
        span at the estimate's median period.

    Raises
    ------
    EvaluationError
        If fewer than three poses can be compared, or more poses came than frames were expected.

    """
    gt_index, est_index = associate(gt, est, max_difference_s)
    points_gt, points_est = gt.positions[gt_index], est.positions[est_index]
    T_gt_est = align(points_gt, points_est)
    aligned = points_est @ T_gt_est[:3, :3].T + T_gt_est[:3, 3]
    errors_m = np.linalg.norm(points_gt - aligned, axis=1)
    expected = _frames_in_span(gt, est) if frames_expected is None else frames_expected
    if expected < len(est):
        raise EvaluationError(
            f'{len(est)} poses were estimated, but only {expected} frames expected; '
            'is the number of frames right?'
        )
    return AteResult(
        statistics=ErrorStatistics.of(errors_m),
        errors_m=errors_m,
        stamps_ns=est.stamps_ns[est_index],
        T_gt_est=T_gt_est,
        frames=len(est),
        frames_expected=expected,
    )


def _frames_in_span(gt: Trajectory, est: Trajectory) -> int:
    period_ns = float(np.median(np.diff(est.stamps_ns)))
    if period_ns <= 0.0:
        return len(est)
    span_ns = int(gt.stamps_ns[-1] - gt.stamps_ns[0])
    return max(len(est), int(span_ns / period_ns + 0.5) + 1)


def rpe_frames(
    gt: Trajectory, est: Trajectory, step: int = 1, max_difference_s: float = MAX_DIFFERENCE_S
) -> RpeResult:
    """
    Measure the relative pose error over a number of frames, over all pairs (i, i + step) [2]_.

    Raises
    ------
    EvaluationError
        If there are not more than `step` poses to compare.

    """
    gt_index, est_index = associate(gt, est, max_difference_s)
    starts = np.arange(len(est_index) - step)
    if len(starts) == 0:
        raise EvaluationError(
            f'{len(est_index)} compared poses are too few for a step of {step} frames'
        )
    name = 'frame' if step == 1 else f'{step} frames'
    return _rpe(gt.matrices[gt_index], est.matrices[est_index], starts, starts + step, name)


def rpe_seconds(
    gt: Trajectory,
    est: Trajectory,
    step_s: float = 1.0,
    max_difference_s: float = MAX_DIFFERENCE_S,
) -> RpeResult:
    """
    Measure the relative pose error over a time: the drift per second [2]_.

    Every pose is paired with the one nearest to `step_s` later, if that is within
    `max_difference_s`, so gaps in the estimate are left out.

    Raises
    ------
    EvaluationError
        If no two compared poses are that far apart.

    """
    gt_index, est_index = associate(gt, est, max_difference_s)
    stamps = est.stamps_ns[est_index]
    target = stamps + round(step_s * 1e9)
    right = np.clip(np.searchsorted(stamps, target), 1, len(stamps) - 1)
    ends = np.where(target - stamps[right - 1] <= stamps[right] - target, right - 1, right)
    starts = np.flatnonzero(np.abs(stamps[ends] - target) <= round(max_difference_s * 1e9))
    if len(starts) == 0:
        raise EvaluationError(
            f'no two of {len(stamps)} compared poses are {step_s:g} s apart; they span '
            f'{(stamps[-1] - stamps[0]) * 1e-9:.3f} s'
        )
    name = 's' if step_s == 1.0 else f'{step_s:g} s'
    return _rpe(gt.matrices[gt_index], est.matrices[est_index], starts, ends[starts], name)


def _rpe(gt: Array, est: Array, starts: Index, ends: Index, step: str) -> RpeResult:
    """Compare motions: E_i = (Q_i^-1 Q_j)^-1 (P_i^-1 P_j), Eq. (1) of [2]_; Q gt, P est."""
    motion_gt = np.linalg.inv(gt[starts]) @ gt[ends]
    motion_est = np.linalg.inv(est[starts]) @ est[ends]
    E = np.linalg.inv(motion_gt) @ motion_est
    translation = np.linalg.norm(E[:, :3, 3], axis=1)
    rotation_deg = np.degrees(Rotation.from_matrix(E[:, :3, :3]).magnitude())
    return RpeResult(
        ErrorStatistics.of(translation), ErrorStatistics.of(rotation_deg), len(starts), step
    )


def transformed(T_a_b: Pose, trajectory: Trajectory) -> Array:
    """Return the positions of a trajectory in b, seen in a, shape (N, 3)."""
    return np.asarray(trajectory.positions @ T_a_b[:3, :3].T + T_a_b[:3, 3])
