"""The Gaussians of a map in one metric frame, in the form that aligning needs: what each of them constrains."""

from collections.abc import Iterable
from dataclasses import dataclass
from functools import cached_property
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import full_matrices
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile import Tile

_THIN_M2: Final = 0.02
"""Along an axis with less variance (14 cm) a voxel's Gaussian says where a surface lies. Along the others it only says
where the voxel is cut off, which is the same grid in both maps and would draw every shift to zero."""
_OPEN_M2: Final = 1.0
"""Variance of such an axis. Not more: where the normals of a pair differ by 2 degrees, a thousandth of it goes across
the surface; with 1e4 m2 walls 30 cm apart counted as the same."""
_UPRIGHT: Final = 0.5
"""A surface whose normal rises less than this (30 degrees) constrains the horizontal place."""


@dataclass(frozen=True, eq=False)
class GaussianCloud:
    """Gaussians of a map.

    Attributes:
        mean_m: (N, 3) in the frame.
        spread_m2: (N, 3, 3) covariances as they were measured.
        axes: (N, 3, 3) principal axes as columns.
        variance_m2: (N, 3) along them, growing.
    """

    mean_m: F64
    spread_m2: F64
    axes: F64
    variance_m2: F64

    @classmethod
    def of(cls, mean_m: F64, spread_m2: F64) -> "GaussianCloud":
        """From means (N, 3) and covariances (N, 3, 3)."""
        variance, axes = np.linalg.eigh(spread_m2)
        return cls(np.ascontiguousarray(mean_m), spread_m2, axes, np.maximum(variance, 0.0))

    def __len__(self) -> int:
        return len(self.mean_m)

    @property
    def normal(self) -> F64:
        """(N, 3) unit axis of the smallest variance."""
        return self.axes[:, :, 0]

    @cached_property
    def constraint_m2(self) -> F64:
        """(N, 3, 3) covariances of where the surface lies: as measured across it, open along it."""
        opened = np.where(self.variance_m2 < _THIN_M2, self.variance_m2, _OPEN_M2)
        return np.asarray(np.einsum("nij,nj,nkj->nik", self.axes, opened, self.axes))

    @cached_property
    def is_surface(self) -> NDArray[np.bool_]:
        """(N,) whether it constrains anything."""
        return np.asarray(self.variance_m2[:, 0] < _THIN_M2)

    @cached_property
    def is_upright(self) -> NDArray[np.bool_]:
        """(N,) surfaces that constrain the horizontal place: walls, posts, kerbs' sides."""
        return np.asarray(self.is_surface & (np.abs(self.normal[:, 2]) < _UPRIGHT))

    @cached_property
    def is_post(self) -> NDArray[np.bool_]:
        """(N,) thin along two axes: posts, trunks, wires, edges."""
        return np.asarray(self.variance_m2[:, 1] < _THIN_M2)

    def information_along(self, direction: F64, noise_m: float) -> F64:
        """(N,) 0 ... 1: how much of what each surface says is about a unit direction (3,)."""
        information = 1.0 / (np.where(self.variance_m2 < _THIN_M2, self.variance_m2, _OPEN_M2) + noise_m**2)
        along = np.einsum("nij,i->nj", self.axes, direction) ** 2
        return np.asarray((along * information).sum(axis=1) / information.max(axis=1))

    @cached_property
    def is_ground(self) -> NDArray[np.bool_]:
        """(N,) level surfaces: roads, but also roofs and awnings."""
        return np.asarray(self.is_surface & (np.abs(self.normal[:, 2]) > 0.9))

    @cached_property
    def tree(self) -> cKDTree:
        """Of the means of all that constrain anything; `surfaces` are its rows."""
        return cKDTree(self.mean_m[self.surfaces])

    @cached_property
    def surfaces(self) -> NDArray[np.int64]:
        """(M,) rows that constrain anything."""
        return np.flatnonzero(self.is_surface)

    @cached_property
    def plan_tree(self) -> cKDTree:
        """Of the horizontal places of all Gaussians: where the map knows anything at all."""
        return cKDTree(self.mean_m[:, :2])

    def take(self, rows: NDArray[np.generic]) -> "GaussianCloud":
        """Some rows, by number or mask."""
        return GaussianCloud(self.mean_m[rows], self.spread_m2[rows], self.axes[rows], self.variance_m2[rows])

    def moved(self, T: F64) -> "GaussianCloud":
        """All of it moved by T (4, 4)."""
        R = T[:3, :3]
        return GaussianCloud(transform(T, self.mean_m), R @ self.spread_m2 @ R.T, R @ self.axes, self.variance_m2)


def cloud_of_tiles(tiles: Iterable[Tile], frame: LocalFrame) -> GaussianCloud:
    """The Gaussians of tiles in `frame`, metres."""
    means, spreads = [np.empty((0, 3))], [np.empty((0, 3, 3))]
    for tile in tiles:
        held = tile.gaussians.take(tile.gaussians.exists)
        T = frame.T_self_other(LocalFrame.of_tile(tile.tile_id))
        centre_m = VoxelGrid.of(tile.tile_id).centre_m(held.voxel_id)
        means.append(transform(T, centre_m + held.mean_m))
        spreads.append(T[:3, :3] @ full_matrices(held.cov_m2) @ T[:3, :3].T)
    return GaussianCloud.of(np.concatenate(means), np.concatenate(spreads))
