"""The Gaussian map as a PointCloud2 that rviz and other tools can read."""

from __future__ import annotations

from typing import Protocol

import numpy as np
from numpy.typing import NDArray
from sensor_msgs.msg import PointCloud2, PointField
from std_msgs.msg import Header

from bdgs_ros.bridge.conversions import T_MAP_WORLD

STATIC, UNCERTAIN, DYNAMIC = 0, 1, 2

_DTYPE = np.dtype(
    [
        ('x', '<f4'),
        ('y', '<f4'),
        ('z', '<f4'),
        ('rgb', '<f4'),
        ('opacity', '<f4'),
        ('scale', '<f4'),
        ('p_dynamic', '<f4'),
        ('label', 'u1'),
    ]
)


class Gaussians(Protocol):
    """What the cloud needs of a map."""

    @property
    def means(self) -> NDArray[np.float32]:
        """Positions in metres, shape (N, 3)."""

    @property
    def colors(self) -> NDArray[np.float32]:
        """RGB in [0, 1], shape (N, 3)."""

    @property
    def log_scales(self) -> NDArray[np.float32]:
        """Natural logarithm of metres, shape (N, 3)."""

    @property
    def logit_opacities(self) -> NDArray[np.float32]:
        """Shape (N,)."""

    @property
    def p_dynamic(self) -> NDArray[np.float32]:
        """The belief, shape (N,)."""

    def __len__(self) -> int:
        """Return the number of Gaussians."""


def cloud_from_map(gaussians: Gaussians, margin: float, head: Header) -> PointCloud2:
    """
    Encode a map.

    Parameters
    ----------
    gaussians : Gaussians
        `means` in core's world; the cloud is in `map`.
    margin : float
        delta of Eq. 6: the label is dynamic above 0.5 + delta and static below 0.5 - delta.
    head : Header
        Stamp and frame id of the cloud.

    Returns
    -------
    cloud : PointCloud2
        Fields x y z [m], rgb (packed as rviz wants it), opacity [0, 1], scale (the geometric
        mean of the three, in m), p_dynamic [0, 1], label (0 static, 1 uncertain, 2 dynamic).

    """
    points = np.zeros(len(gaussians), _DTYPE)
    in_map = np.asarray(gaussians.means, np.float64) @ T_MAP_WORLD[:3, :3].T
    points['x'], points['y'], points['z'] = in_map.T
    points['rgb'] = _pack(np.asarray(gaussians.colors))
    points['opacity'] = 1.0 / (1.0 + np.exp(-np.asarray(gaussians.logit_opacities)))
    points['scale'] = np.exp(np.asarray(gaussians.log_scales).mean(axis=1))
    belief = np.asarray(gaussians.p_dynamic)
    points['p_dynamic'] = belief
    points['label'] = np.select(
        [belief > 0.5 + margin, belief < 0.5 - margin], [DYNAMIC, STATIC], UNCERTAIN
    )
    return _message(points, head)


def _pack(colors: NDArray[np.float32]) -> NDArray[np.float32]:
    levels = np.clip(colors * 255 + 0.5, 0, 255).astype(np.uint32)
    packed = levels[:, 0] << 16 | levels[:, 1] << 8 | levels[:, 2]
    return np.asarray(packed.astype(np.uint32).view(np.float32))


def _message(points: NDArray[np.void], head: Header) -> PointCloud2:
    fields = [
        PointField(
            name=name,
            offset=entry[1],
            datatype=PointField.UINT8 if name == 'label' else PointField.FLOAT32,
            count=1,
        )
        for name, entry in (_DTYPE.fields or {}).items()
    ]
    cloud = PointCloud2(
        header=head,
        height=1,
        width=len(points),
        fields=fields,
        is_bigendian=False,
        point_step=_DTYPE.itemsize,
        row_step=_DTYPE.itemsize * len(points),
        is_dense=True,
    )
    cloud.data = points.tobytes()
    return cloud
