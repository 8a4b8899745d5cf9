"""The Gaussian map: parameters, belief and optimiser state, which grow and shrink together."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import TypeVar

import numpy as np
from numpy.typing import NDArray

from bdgs_ros.belief.filter import logit
from bdgs_ros.belief.fusion import BeliefTracker
from bdgs_ros.belief.likelihood import Features
from bdgs_ros.core.config import BeliefConfig
from bdgs_ros.core.types import Pose
from bdgs_ros.mapping.groups import Groups
from bdgs_ros.mapping.harmonics import resized
from bdgs_ros.mapping.parameters import PARAMETERS, HostParameters, Parameters, ViewShading
from bdgs_ros.mapping.rasterize import Gaussians
from bdgs_ros.mapping.rotations import multiply, quats_from_axes

Array = NDArray[np.float32]
Scalar = TypeVar('Scalar', np.float32, np.int32, np.int64)

_RECORDS = (
    'keyframe_index',
    'observations',
    'contribution',
    'checks',
    'confirmations',
    'streak',
    'violations',
    'surface',
    'serial',
)

_SURFACES = 1 << 16  # after so many, numbers begin again: nobody remembers the first ones


@dataclass(frozen=True)
class NewGaussians:
    """Gaussians to be added, M of them."""

    means: Array  # [M, 3] metres in world
    scales: Array  # [M] or [M, 3] metres: round, or along each axis
    colors: Array  # [M, 3] RGB in [0, 1]
    belief: Array  # [M] P(dynamic)
    quats: Array | None = None  # [M, 4] wxyz, axes to world; None: along those of world


class GaussianMap:
    """
    All Gaussians of the map with everything that is remembered about each.

    `parameters` holds the optimised arrays and their moments, on a card once something there has
    worked on them; `keyframe_index` the keyframe that brought each Gaussian, [N] int32;
    `observations` how often it was seen, [N] int32. `contribution`, `checks` and `confirmations`
    are what pruning remembers (`bdgs_ros.mapping.prune`), not saved, as are `streak` and
    `violations`: keyframes in a row that measured a Gaussian where it is, or looked through it;
    `surface`, on which depth-connected surface of which keyframe it was last seen, 0 before.
    `serial`, [N] int64, is a number that no other Gaussian of this map ever has or had, from 0 in
    order of birth, by which it can be followed while others come and go; not saved.
    """

    def __init__(self, config: BeliefConfig, degree: int = 0) -> None:
        self.parameters: Parameters = HostParameters(degree)
        self.belief = BeliefTracker(config)
        self.keyframe_index = np.zeros(0, np.int32)
        self.observations = np.zeros(0, np.int32)
        self.contribution = np.zeros(0, np.float32)
        self.checks = np.zeros(0, np.int32)
        self.confirmations = np.zeros(0, np.int32)
        self.streak = np.zeros(0, np.int32)
        self.violations = np.zeros(0, np.int32)
        self.surface = np.zeros(0, np.int32)
        self._surfaces = 0
        self.serial = np.zeros(0, np.int64)
        self._born = 0

    def __len__(self) -> int:
        """Return the number of Gaussians."""
        return len(self.keyframe_index)

    @property
    def means(self) -> Array:
        """Centres in world, metres, [N, 3]."""
        return self.parameters['means']

    @property
    def quats(self) -> Array:
        """Rotations, wxyz, not necessarily of unit length, [N, 4]."""
        return self.parameters['quats']

    @property
    def log_scales(self) -> Array:
        """Natural logarithms of the axes' standard deviations in metres, [N, 3]."""
        return self.parameters['log_scales']

    @property
    def logit_opacities(self) -> Array:
        """Opacities before the sigmoid, [N]."""
        return self.parameters['logit_opacities']

    @property
    def colors(self) -> Array:
        """RGB, nominally in [0, 1], [N, 3]."""
        return self.parameters['colors']

    @property
    def harmonics(self) -> Array:
        """View-dependent colour, [N, 3 K] in the order of `Shading`; K is 0 without."""
        return self.parameters['harmonics']

    @property
    def p_dynamic(self) -> Array:
        """The smoothed posterior of Eq. 10, [N]."""
        return self.belief.smoothed

    @property
    def states(self) -> NDArray[np.uint8]:
        """The decision of Eq. 6 for each Gaussian, [N]."""
        return self.belief.states

    def visible_mask(self) -> NDArray[np.bool_]:
        """Return M_g of Eq. 11, [N]: True where a Gaussian is rendered."""
        return ~self.belief.hidden

    def as_gaussians(
        self, shading: ViewShading | None = None, active: NDArray[np.bool_] | None = None
    ) -> Gaussians:
        """Return the arrays as the rasteriser takes them; only shaded colours are not shared."""
        arrays = self.parameters.rasterised()
        if shading is not None:
            drawn = np.ones(len(self), bool) if active is None else active
            arrays['colors'] = shading.colors(arrays['colors'], drawn)
        return Gaussians(**arrays, p_dynamic=self.p_dynamic)

    def shading(self, T_camera_world: NDArray[np.float64], threads: int) -> ViewShading | None:
        """Return how a camera sees the colours; None where they are the same from everywhere."""
        return self.parameters.shading(T_camera_world, threads)

    def resize_colors(self, degree: int) -> None:
        """Give the view-dependent colour another degree; what it is optimised with starts anew."""
        self.parameters.reset('harmonics', resized(self.harmonics, degree))

    def append(self, new: NewGaussians, opacity: float, keyframe_index: int) -> None:
        """Add Gaussians that came with keyframe number `keyframe_index`."""
        count = len(new.means)
        added = {
            'means': new.means,
            'quats': _unturned(count) if new.quats is None else new.quats,
            'log_scales': _three(np.log(new.scales)),
            'logit_opacities': np.full(count, logit(np.array([opacity], np.float32))[0]),
            'colors': new.colors,
            'harmonics': np.zeros((count, self.harmonics.shape[1])),
        }
        self.parameters.append(added)
        self.belief.append(new.belief)
        self.keyframe_index = _join(self.keyframe_index, np.full(count, keyframe_index, np.int32))
        none = np.zeros(count, np.int32)
        self.observations = _join(self.observations, none)
        self.contribution = _join(self.contribution, np.ones(count, np.float32))
        self.checks = _join(self.checks, none)
        self.confirmations = _join(self.confirmations, none)
        self.streak = _join(self.streak, none)
        self.violations = _join(self.violations, none)
        self.surface = _join(self.surface, none)
        self.serial = _join(self.serial, self._new_serials(count))

    def _new_serials(self, count: int) -> NDArray[np.int64]:
        self._born += count
        return np.arange(self._born - count, self._born, dtype=np.int64)

    def copy(self, rows: NDArray[np.int64]) -> None:
        """Add a copy of some Gaussians at the end, with optimiser state of its own."""
        self.parameters.copy(rows)
        self.belief.append(self.belief.belief[rows], self.belief.smoothed[rows])
        for name in _RECORDS:
            record = getattr(self, name)
            setattr(self, name, _join(record, record[rows]))
        self.serial[len(self) - len(rows) :] = self._new_serials(len(rows))

    def note(self, features: Features) -> None:
        """Count what a keyframe showed: who was seen, in place or through, and how often now."""
        self.observations += features.visible
        agrees, through = features.agrees, features.seen_through
        self.streak = np.where(through, 0, self.streak + agrees).astype(np.int32)
        self.violations = np.where(agrees, 0, self.violations + through).astype(np.int32)
        numbered = features.surface + self._surfaces
        self.surface = np.where(features.surface > 0, numbered, self.surface).astype(np.int32)
        self._surfaces += int(features.surface.max(initial=0))
        self._surfaces %= _SURFACES

    def keep(self, mask: NDArray[np.bool_]) -> None:
        """Drop the Gaussians where `mask`, shape (N,), is False."""
        if mask.all():
            return
        rows = np.flatnonzero(mask)  # numpy takes rows four times as fast as it masks them
        self.parameters.take(rows)
        self.belief.keep(mask)
        for name in _RECORDS:
            setattr(self, name, getattr(self, name)[mask])

    def pool(self, groups: Groups, parameters: dict[str, Array]) -> None:
        """
        Replace groups of Gaussians by one each.

        Parameters
        ----------
        groups : Groups
            N Gaussians in M groups.
        parameters : dict of str to ndarray
            What the groups become, by the names in `PARAMETERS`, [M, ...] each.

        """
        self.parameters.pool(parameters, groups.leader)
        self.belief.pool(groups.mean)
        self.keyframe_index = groups.least(self.keyframe_index)
        self.observations = groups.most(self.observations)
        self.contribution = groups.most(self.contribution)
        self.checks = groups.most(self.checks)
        self.confirmations = groups.most(self.confirmations)
        self.streak = groups.least(self.streak)
        self.violations = groups.least(self.violations)
        self.surface = self.surface[groups.leader]
        self.serial = self.serial[groups.leader]

    def deform(self, transforms: Mapping[int, Pose]) -> None:
        """
        Move Gaussians with the keyframes that brought them, as after a loop closure.

        Means and orientations turn with their keyframe; shapes stay, and so does view-dependent
        colour: a loop closure turns by little.

        Parameters
        ----------
        transforms : mapping of int to ndarray, shape (4, 4)
            `T_new_old` in world by keyframe index: `p_new = T_new_old @ p_old`. Gaussians of
            keyframes that are not named stay where they are.

        """
        index, inverse = np.unique(self.keyframe_index, return_inverse=True)
        identity = np.eye(4)
        T = np.array([transforms.get(int(i), identity) for i in index]).reshape(-1, 4, 4)
        turn = quats_from_axes(T[:, :3, :3].astype(np.float32))[inverse.reshape(-1)]
        T = T[inverse.reshape(-1)]
        means = np.einsum('nij,nj->ni', T[:, :3, :3], self.means) + T[:, :3, 3]
        self.parameters['means'] = np.ascontiguousarray(means, np.float32)
        self.parameters['quats'] = multiply(turn, self.quats)

    def megabytes(self) -> float:
        """Return the size of the parameters and beliefs in memory, without optimiser state."""
        arrays = [*(self.parameters[name] for name in PARAMETERS), self.belief.belief]
        return sum(a.nbytes for a in [*arrays, self.keyframe_index]) / 1e6


def _unturned(count: int) -> Array:
    return np.tile(np.array([1, 0, 0, 0], np.float32), (count, 1))


def _three(scales: Array) -> Array:
    return scales if scales.ndim == 2 else np.repeat(scales[:, None], 3, axis=1)


def _join(a: NDArray[Scalar], b: NDArray[Scalar]) -> NDArray[Scalar]:
    return np.ascontiguousarray(np.concatenate([a, b]))
