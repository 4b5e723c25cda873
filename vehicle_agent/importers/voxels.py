"""Points by cubes of space: what estimators of importers need of it."""

import numpy as np
from numpy.typing import NDArray

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

_SPAN = 1 << 20


def voxels_of(points_m: F64, side_m: float) -> tuple[I64, I64]:
    """Voxel of each point (N,), counted from 0 over those that hold any, and how many points each voxel holds (V,)."""
    voxel, count = np.unique(voxel_keys(points_m, side_m), return_inverse=True, return_counts=True)[1:]
    return voxel.astype(np.int64), count.astype(np.int64)


def voxel_keys(points_m: F64, side_m: float) -> I64:
    """(N,) one number for each voxel, the same in every call."""
    cell = np.floor(points_m / side_m).astype(np.int64) + _SPAN // 2
    return np.asarray((cell[:, 0] * _SPAN + cell[:, 1]) * _SPAN + cell[:, 2])


def block_keys(keys: I64, voxels: int) -> I64:
    """(N,) one number for each column of so many by so many voxels, over all heights, of voxels with these keys."""
    x, y = keys // _SPAN // _SPAN, keys // _SPAN % _SPAN
    return np.asarray(x // voxels * _SPAN + y // voxels)


def covariances_of(points_m: F64, voxel: I64, count: I64) -> tuple[F64, F64]:
    """(V, 3) means and (V, 3, 3) covariances of points (N, 3) in voxels (N,) of so many points (V,)."""
    n = len(count)
    mean = np.stack([np.bincount(voxel, column, n) for column in points_m.T], axis=1) / count[:, None]
    centred = points_m - mean[voxel]
    cov = np.empty((n, 3, 3))
    for i in range(3):
        for j in range(i + 1):
            cov[:, i, j] = cov[:, j, i] = np.bincount(voxel, centred[:, i] * centred[:, j], n) / count
    return mean, cov
