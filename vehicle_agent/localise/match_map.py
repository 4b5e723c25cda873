"""What registration reads of the map: the dense window of voxels, and for each Gaussian its mean and information."""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from gnd.gnd_map.arrays import F64
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.kernels import tapered_information

# Variance along an axis of a voxel that a surface fills: 1/12 m² for a whole metre filled evenly, less because voxels
# are smaller than that and points never lie quite evenly. 0.035 ... 0.083 m² measured the same on KITTI, RADIATE and
# simulated streets; at 0.083 a corridor's evenness seemed to constrain the place along it.
UNIFORM_VOXEL_M2 = 0.06
LINEAR_M = 60.0  # the grid is taken as affine this far around a point (error below a millimetre)


@dataclass(frozen=True, slots=True, eq=False)
class MatchMap:
    """A map window made ready for registration, in one ENU map frame.

    index: (nx, ny, nz) int32: row of a Gaussian, -1 where the map is empty, below -1 where it is not known.
    A, b: (3, 3), (3,): window coordinates of a map point p are A @ p + b; its voxel is their floor.
    mean_m: (M, 3). information: (M, 6) xx,xy,xz,yy,yz,zz, 1/m². In a direction in which a surface fills its voxel, a
    Gaussian shows where the voxel is, not where the surface is; hence only the information beyond that of an evenly
    filled voxel counts (docs/decisions/0030-localisation.md).
    """

    index: NDArray[np.int32]
    A: F64
    b: F64
    mean_m: F64
    information: F64

    @classmethod
    def of(
        cls, index: NDArray[np.int32], A: ArrayLike, b: ArrayLike, mean_m: ArrayLike, cov_m2: ArrayLike, noise_m: float
    ) -> "MatchMap":
        """From plain arrays: `mean_m` (M, 3) and `cov_m2` (M, 6) in the map frame; `noise_m` one sigma of a point."""
        information = information_of(np.asarray(cov_m2, np.float64).reshape(-1, 6), noise_m)
        return cls(
            index=np.ascontiguousarray(index, dtype=np.int32),
            A=np.ascontiguousarray(A, dtype=np.float64),
            b=np.ascontiguousarray(b, dtype=np.float64),
            mean_m=np.ascontiguousarray(mean_m, dtype=np.float64).reshape(-1, 3),
            information=information,
        )

    def __len__(self) -> int:
        """Number of Gaussians."""
        return len(self.mean_m)


def information_of(cov_m2: F64, noise_m: float) -> F64:
    """(N, 6) the information of Gaussians with covariances (N, 6); `noise_m` one sigma of a point."""
    cov = np.ascontiguousarray(cov_m2)
    information = np.empty_like(cov)
    tapered_information(cov, noise_m**2, UNIFORM_VOXEL_M2, information)
    return information


class MatchMapCache:
    """The `MatchMap` of a `LocalMap`, made again when the map has changed; its grid linearised where the vehicle is.

    What is made stays with the map and goes with it. Several caches of one map share all but the linearisation.
    """

    def __init__(self, local_map: LocalMap, noise_m: float) -> None:
        self.local_map = local_map
        self.noise_m = noise_m
        self._near_m = np.full(3, np.inf)

    def near(self, p_map_m: F64) -> MatchMap:
        """The map with its grid linearised within `LINEAR_M` of `p_map_m` (3,)."""
        made: MatchMap | None = self.local_map.derived.get(self)
        if made is None or not float(np.abs(p_map_m - self._near_m).max()) < LINEAR_M / 3:
            made = self._make(p_map_m)
        return made

    def _make(self, p_map_m: F64) -> MatchMap:
        held, shared = self.local_map, ("match map", self.noise_m)
        A, b = held.grid_frame.affine(p_map_m)
        A, b = np.ascontiguousarray(A), b - held.window_origin_g  # kernels are compiled for one layout
        like: MatchMap | None = held.derived.get(shared)
        if like is None:
            information = held.of_gaussians(shared, lambda cov_m2: information_of(cov_m2, self.noise_m))
            like = MatchMap(held.index, A, b, held.mean_map_m, information)
        made = MatchMap(like.index, A, b, like.mean_m, like.information)
        held.derived[shared] = held.derived[self] = made
        self._near_m = np.array(p_map_m, dtype=np.float64)
        return made
