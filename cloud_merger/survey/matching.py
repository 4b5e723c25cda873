"""One cloud of Gaussians laid onto another: point-to-Gaussian normal distributions transform, annealed and robust.

After Biber and Strasser (2003) and Magnusson's P2D-NDT: the means of the one are moved onto the nearest Gaussians of
the other, of which only directions count in which they are thin. The vehicle's own registration looks up voxels of a
map; here cells of half a metre lie anyhow to each other, so that the nearest mean is sought instead.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from scipy.spatial import cKDTree

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.se3 import T_from_R_t, exp_so3, transform

NOISE_M: Final = 0.03
"""One sigma of a mean along the normal of its surface."""
THIN_M: Final = 0.07
"""A Gaussian tells of a surface when its smallest standard deviation is below this."""
_UNIFORM: Final = 1.0 / 12.0
_SCALES: Final = {"near": (6.0, 3.0), "wide": (20.0, 10.0, 5.0, 3.0)}
_ITERATIONS: Final = 12
_MAX_SOURCE: Final = 2000
_CORRELATION: Final = 30.0
"""So many means share one error."""
FLOOR_M, FLOOR_RAD = 0.03, 2.5e-4
"""The least sigma of a match along and about each axis. Along an even street a match leans by some centimetres towards
where the cells lie; chains of closures between two drives would add that up against odometry that is better."""
MIN_MATCHED: Final = 150
_STOP_M, _STOP_RAD = 3e-4, 1e-5


@dataclass(frozen=True, slots=True, eq=False)
class Surface:
    """Gaussians made ready to be matched: means (N, 3), information (N, 3, 3), a tree of the means, cell size."""

    mean_m: F64
    information: F64
    tree: cKDTree
    cell_m: float

    def __len__(self) -> int:
        return len(self.mean_m)

    @classmethod
    def of(cls, mean_m: F64, cov_m2: F64, cell_m: float) -> "Surface":
        """Those of the Gaussians (N, 3), (N, 3, 3) of cells of `cell_m` that tell of a surface."""
        values, axes = np.linalg.eigh(cov_m2)
        thin = np.flatnonzero(values[:, 0] < THIN_M**2)
        noise = NOISE_M**2
        weight = 1.0 / (np.maximum(values[thin], 0.0) + noise) - 1.0 / (_UNIFORM * cell_m**2 * 0.7 + noise)
        information = np.einsum("nij,nj,nkj->nik", axes[thin], np.maximum(weight, 0.0), axes[thin])
        means = np.ascontiguousarray(mean_m[thin])
        return cls(means, information, cKDTree(means if len(means) else np.empty((0, 3))), cell_m)


@dataclass(frozen=True, slots=True, eq=False)
class SurfaceMatch:
    """How one surface lies on another.

    Attributes:
        T_target_source: (4, 4).
        covariance: (6, 6) of a small motion of the source, rotation [rad] before translation [m].
        fit: 1 - mean robust cost of the matched means, 0 ... 1.
        overlap: share of the source's means that have one of the target nearby.
        matched: how many.
    """

    T_target_source: F64
    covariance: F64
    fit: float
    overlap: float
    matched: int


def match_surfaces(source: Surface, target: Surface, T_start: F64, *, wide: bool = False) -> SurfaceMatch | None:
    """Lay `source` onto `target` from T_start (4, 4), which is off by some 10 cm, or `wide` by a metre and 3 degrees.

    None: fewer than `MIN_MATCHED` means have a counterpart.
    """
    points = source.mean_m[:: max(1, len(source) // _MAX_SOURCE)]
    if len(points) < MIN_MATCHED or len(target) < MIN_MATCHED:
        return None
    T = np.array(T_start, np.float64)
    for scale in _SCALES["wide" if wide else "near"]:
        for _ in range(_ITERATIONS):
            found = _linearised(points, T, target, scale)
            if found is None:
                return None
            step = -np.linalg.solve(found.H + 1e-6 * np.trace(found.H) / 6 * np.eye(6), found.g)
            T = T @ T_from_R_t(exp_so3(step[:3]), step[3:])
            if np.abs(step[3:]).max() < _STOP_M and np.abs(step[:3]).max() < _STOP_RAD:
                break
    found = _linearised(points, T, target, scale)
    if found is None:
        return None
    floor = np.diag([FLOOR_RAD**2] * 3 + [FLOOR_M**2] * 3)
    covariance = _CORRELATION * np.linalg.inv(found.H + 1e-9 * np.trace(found.H) * np.eye(6)) + floor
    return SurfaceMatch(T, (covariance + covariance.T) / 2, found.fit, found.matched / len(points), found.matched)


@dataclass(frozen=True, slots=True, eq=False)
class _Normal:
    """Normal equations (6, 6), (6,), and how well it fits."""

    H: F64
    g: F64
    fit: float
    matched: int


def _linearised(points: F64, T: F64, target: Surface, scale: float) -> _Normal | None:
    moved = transform(T, points)
    reach_m = target.cell_m + min(scale * NOISE_M, 0.5 * target.cell_m)
    _, row = target.tree.query(moved, distance_upper_bound=reach_m)
    near = np.flatnonzero(row < len(target))
    if len(near) < MIN_MATCHED:
        return None
    omega, e = target.information[row[near]], moved[near] - target.mean_m[row[near]]
    squared = np.einsum("ni,nij,nj->n", e, omega, e)
    c2 = scale**2
    weight = (c2 / (c2 + squared)) ** 2  # Geman-McClure
    J = np.zeros((len(near), 3, 6))
    x, y, z = points[near].T
    J[:, 0, 1], J[:, 0, 2], J[:, 1, 0], J[:, 1, 2], J[:, 2, 0], J[:, 2, 1] = z, -y, -z, x, y, -x
    J[:, 0, 3] = J[:, 1, 4] = J[:, 2, 5] = 1.0
    J = T[:3, :3] @ J
    weighted = weight[:, None, None] * omega @ J
    H = np.einsum("nai,naj->ij", J, weighted)
    g = np.einsum("nai,na->i", weighted, e)
    return _Normal(H, g, float(1.0 - (squared / (c2 + squared)).mean()), len(near))
