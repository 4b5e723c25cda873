"""Points that stand for Gaussians: their means, or lattices whose mean and covariance are the Gaussian's own.

A localiser that computes mean and covariance of the points of a cell gets back what the map holds. Along its two longer
axes a voxel's points have the spread of a surface patch: evenly spaced, with the Gaussian's variance. Along the
shortest they alternate between -sigma and +sigma where the spacing does not resolve it. With even numbers along the
longer axes all first and second moments are exact.
"""

from functools import lru_cache
from typing import Final, Literal

import numpy as np

from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile

PointsOf = Literal["samples", "means"]
SPACING_M: Final = 0.2
"""Of the points that Autoware's documents ask a map for."""
_POINT_SD_M: Final = 0.01  # a Gaussian that is smaller in all directions is one point
_MOST: Final = 12  # points along an axis


def points_of_tile(tile: Tile, points: PointsOf = "samples", spacing_m: float = SPACING_M) -> F64:
    """(N, 3) points in metres in the tile's frame that stand for its Gaussians, voxel by voxel."""
    gaussians = tile.gaussians
    mean_m = VoxelGrid.of(tile.tile_id).centre_m(gaussians.voxel_id) + gaussians.mean_m
    return mean_m if points == "means" else sample(mean_m, gaussians, spacing_m)[0]


def sample(mean_m: F64, gaussians: Gaussians, spacing_m: float) -> tuple[F64, I64]:
    """Lattices of points around means.

    Args:
        mean_m: (N, 3) means.
        gaussians: N Gaussians, of which the covariances are taken.
        spacing_m: about how far points of a voxel lie apart.

    Returns:
        (P, 3) points and (P,) the row of the Gaussian of each, ascending.
    """
    variance, axes = np.linalg.eigh(gaussians.full_cov())  # ascending
    sd_m = np.sqrt(np.maximum(variance[:, ::-1], 0.0))
    scaled = axes[:, :, ::-1] * sd_m[:, None, :]
    numbers = _numbers(sd_m, spacing_m)
    points, rows = [np.zeros((0, 3))], [np.zeros(0, np.int64)]
    for shape in np.unique(numbers, axis=0).tolist():
        chosen = np.flatnonzero((numbers == shape).all(axis=1))
        lattice = _lattice(*shape)
        offset = np.einsum("pa,nxa->npx", lattice, scaled[chosen])
        points.append((mean_m[chosen, None] + offset).reshape(-1, 3))
        rows.append(np.repeat(chosen, len(lattice)))
    row = np.concatenate(rows)
    order = np.argsort(row, kind="stable")
    return np.concatenate(points)[order], row[order]


def _numbers(sd_m: F64, spacing_m: float) -> I64:
    """(N, 3) points along the axes, longest first; 1: the shortest alternates; (1, 1, 1): a single point."""
    length_m = np.sqrt(12.0) * sd_m  # of a uniform distribution with this deviation
    numbers = np.clip(np.rint(length_m / spacing_m).astype(np.int64), 1, _MOST)
    numbers[:, :2] = 2 * np.maximum(np.rint(length_m[:, :2] / (2.0 * spacing_m)).astype(np.int64), 1)
    numbers[:, :2] = np.minimum(numbers[:, :2], _MOST)
    numbers[sd_m[:, 0] < _POINT_SD_M] = 1
    return np.asarray(numbers)


@lru_cache(maxsize=1024)
def _lattice(first: int, second: int, third: int) -> F64:
    """(P, 3) points with mean 0 and covariance I, along axes of so many points each."""
    if first == 1:
        return np.zeros((1, 3))
    i, j, k = (index.ravel() for index in np.indices((first, second, third)))
    across = 1.0 - 2.0 * ((i + j) % 2) if third == 1 else _even(third)[k]
    return np.stack([_even(first)[i], _even(second)[j], across], axis=1)


def _even(number: int) -> F64:
    """`number` >= 2 evenly spaced values with mean 0 and variance 1."""
    return np.asarray((np.arange(number) - (number - 1) / 2.0) * np.sqrt(12.0 / (number**2 - 1.0)))
