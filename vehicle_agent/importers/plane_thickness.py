"""How thick upright surfaces are where scans overlap, and whether one way to lay the scans makes them thinner."""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.vehicle_agent.importers.voxels import block_keys, covariances_of, voxel_keys, voxels_of

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

VOXEL_M: Final = 0.5
LEAST_POINTS: Final = 30
LEAST_SCANS: Final = 4
UPRIGHT: Final = 0.5
"""Normals steeper than this (their part along z) are the ground, which no motion along it distorts."""
BLOCK_VOXELS: Final = 10
LEAST_BLOCKS: Final = 10
"""Voxels of one facade become thick or thin together: blocks of 5 m count as measurements, voxels within do not."""


@dataclass(frozen=True, slots=True, eq=False)
class Thickness:
    """Of V upright voxels: their keys (V,), sorted, and one sigma of their points across the surface (V,)."""

    key: I64
    sigma_m: F64

    @property
    def mean_m(self) -> float:
        """Geometric mean; NaN without voxels."""
        return float(np.exp(np.log(self.sigma_m).mean())) if len(self.sigma_m) else float("nan")


@dataclass(frozen=True, slots=True)
class Comparison:
    """Mean of the logarithms of thickness before over thickness after (positive: thinner after), its sigma, voxels."""

    thinner: float
    sigma: float
    voxels: int

    @property
    def percent(self) -> float:
        """By how much thinner."""
        return 100.0 * float(1.0 - np.exp(-self.thinner))

    def by(self, at_least: float, sigmas: float) -> bool:
        """Whether it is thinner by that much (a logarithm), and by so many sigmas."""
        return self.thinner > max(at_least, sigmas * self.sigma)


def thickness_of(clouds: Sequence[F64]) -> Thickness:
    """Of scans (N, 3) each, all in one frame whose z points upwards."""
    points = np.concatenate(clouds)
    scan = np.repeat(np.arange(len(clouds)), [len(cloud) for cloud in clouds])
    voxel, count = voxels_of(points, VOXEL_M)
    seen = np.unique(voxel * len(clouds) + scan) // len(clouds)
    kept = (count >= LEAST_POINTS) & (np.bincount(seen, minlength=len(count)) >= LEAST_SCANS)
    cov = covariances_of(points, voxel, count)[1][kept]
    keys = np.zeros(len(count), np.int64)
    keys[voxel] = voxel_keys(points, VOXEL_M)
    values, vectors = np.linalg.eigh(cov)
    upright = np.abs(vectors[:, 2, 0]) < UPRIGHT
    return Thickness(keys[kept][upright], np.sqrt(np.maximum(values[upright, 0], 1e-6)))


def compared(before: Thickness, after: Thickness) -> Comparison:
    """Over the voxels that both have; sigma from how far blocks of them differ (cluster-robust)."""
    key, i, j = np.intersect1d(before.key, after.key, assume_unique=True, return_indices=True)
    ratio = np.log(before.sigma_m[i] / after.sigma_m[j])
    block = np.unique(block_keys(key, BLOCK_VOXELS), return_inverse=True)[1]
    blocks = int(block.max(initial=-1)) + 1
    if blocks < LEAST_BLOCKS:
        return Comparison(0.0, float("inf"), len(key))
    left = np.bincount(block, ratio - ratio.mean())
    sigma = np.sqrt((left**2).sum() * blocks / (blocks - 1)) / len(key)
    return Comparison(float(ratio.mean()), float(sigma), len(key))
