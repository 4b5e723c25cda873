"""Which changes of a tile are leaves that came or went: loose Gaussians in the crown of a tree whose trunk stayed.

Leaves come and go twice a year and change no map. A tree that is planted or felled comes or goes with its trunk. So a
change follows the season where a slim trunk stands unchanged near by, where what came or went is loose as leaves are
(no surface), hangs over the ground, and lies among Gaussians that are loose, too: twigs that stayed, or more leaves.
"""

from dataclasses import dataclass
from functools import partial
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I32, I64, are_in
from gnd.gnd_map.beside import count_beside
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.over_ground import flat_places_m, ground_m, places_m

Mask = NDArray[np.bool_]

GROUND_REACH_M: Final = 2.5
GROUND_BELOW_M: Final = 8.0
LOOSE: Final = 0.3
"""The thinnest spread of leaves is at least this share of the next; of a surface it is less."""
HANG_M: Final = 1.3
"""Crowns begin at least so high over the ground."""
TRUNK_SIGMA_M: Final = (0.16, 0.2)
"""The horizontal spread of a trunk is at most, the upright one at least this."""
TRUNK_M: Final = (0.2, 3.2)
"""A trunk is seen between these heights, in two voxels of one column at least, with one neighbour at most."""
CROWN_REACH_M: Final = 2.6
CROWN_CORE_M: Final = 2.2
"""So far around a trunk, and over `CORE_M`, at least `CORE_VOXELS` are counted; `CORE_LOOSE` of them are loose."""
CORE_M: Final = 1.8
CORE_VOXELS: Final = 10
CORE_LOOSE: Final = 0.7
CORE_CHANGED: Final = 5
"""A crown of which fewer loose voxels changed has not changed with the season."""
TWIGS: Final = 2
"""So many twigs stayed beside what came or went, not fewer than surfaces; or ..."""
LEAVES: Final = 4
SURFACES: Final = 0.1
"""... beside what came are so many twigs and leaves, and at most this share of surfaces."""

BOUNDS: Final[dict[str, float]] = {
    "ground_reach_m": GROUND_REACH_M,
    "ground_below_m": GROUND_BELOW_M,
    "loose": LOOSE,
    "hang_m": HANG_M,
    "trunk_across_m": TRUNK_SIGMA_M[0],
    "trunk_upright_m": TRUNK_SIGMA_M[1],
    "trunk_low_m": TRUNK_M[0],
    "trunk_high_m": TRUNK_M[1],
    "crown_reach_m": CROWN_REACH_M,
    "crown_core_m": CROWN_CORE_M,
    "core_m": CORE_M,
    "core_voxels": CORE_VOXELS,
    "core_loose": CORE_LOOSE,
    "core_changed": CORE_CHANGED,
    "twigs": TWIGS,
    "leaves": LEAVES,
    "surfaces": SURFACES,
}
"""By name: a map depends on all of them."""


@dataclass(frozen=True, slots=True, eq=False)
class _Region:
    """Some Gaussians of a tile: index (N, 3), place_m (N, 3), height_m (N,) of mean and `low_m` of lower end over the
    ground (NaN: not known), spread_m (N, 3) ascending, across_m (N,) the larger horizontal spread, upright_m (N,).
    """

    index: I64
    place_m: F64
    height_m: F64
    low_m: F64
    is_loose: Mask
    across_m: F64
    upright_m: F64

    @classmethod
    def of(cls, grid: VoxelGrid, gaussians: Gaussians, flat_m: F64) -> "_Region":
        place = places_m(grid, gaussians)
        cov = gaussians.full_cov().astype(np.float64)
        spread = np.sqrt(np.maximum(np.linalg.eigvalsh(cov), 0.0))
        across = np.sqrt(np.maximum(np.linalg.eigvalsh(cov[:, :2, :2])[:, 1], 0.0))
        upright = np.sqrt(np.maximum(cov[:, 2, 2], 0.0))
        height = place[:, 2] - ground_m(place, flat_m, GROUND_REACH_M, GROUND_BELOW_M)
        loose = spread[:, 0] >= LOOSE * spread[:, 1]
        index = np.stack(grid.unravel(gaussians.voxel_id), axis=1)
        return cls(index, place, height, height - 1.7 * upright, loose, across, upright)

    def take(self, rows: Mask) -> "_Region":
        """Some of them."""
        index, place, height, low = self.index[rows], self.place_m[rows], self.height_m[rows], self.low_m[rows]
        return _Region(index, place, height, low, self.is_loose[rows], self.across_m[rows], self.upright_m[rows])

    @property
    def hangs(self) -> Mask:
        return np.asarray(self.low_m > HANG_M)


_MAPPED: Final[ByObject[tuple[F64, _Region]]] = ByObject(256)
"""Of a tile's map: what is flat, and all of it; the merges of a window ask about the same one."""


def _mapped(grid: VoxelGrid, before: Gaussians) -> tuple[F64, _Region]:
    flat = flat_places_m(grid, before)
    return flat, _Region.of(grid, before, flat)


def follows_season(grid: VoxelGrid, before: Gaussians, removed: I32, put: Gaussians) -> I32:
    """The voxels of a tile whose change is that of leaves.

    Args:
        grid: the tile's.
        before: (M,) Gaussians of the map.
        removed: (R,) sorted ids of those that went.
        put: (P,) Gaussians that came, or took the place of others.

    Returns:
        Sorted ids, some of `removed` and `put`. Where the map has no ground or no trunk: none.
    """
    changed_ids = np.concatenate([removed, put.voxel_id])
    if not len(changed_ids):
        return np.zeros(0, np.int32)
    flat, mapped = _MAPPED.of(before, partial(_mapped, grid, before), grid.tile)
    if not len(flat):
        return np.zeros(0, np.int32)
    went, came = mapped.take(are_in(before.voxel_id, removed)), _Region.of(grid, put, flat)
    index = np.concatenate([went.index, came.index])
    place = np.concatenate([went.place_m, came.place_m])
    loose = np.concatenate([went.is_loose, came.is_loose])
    maybe = loose & np.concatenate([went.hangs, came.hangs])
    if not maybe.any():
        return np.zeros(0, np.int32)
    kept = mapped.take(~are_in(before.voxel_id, np.sort(changed_ids)))
    trunk_m = _trunks_m(kept, before, grid, place, np.concatenate([went.height_m, came.height_m]), loose)
    maybe &= _near(place, trunk_m)
    is_twig = kept.is_loose & kept.hangs & ~_is_slim(kept) & _near(kept.place_m, trunk_m)
    twigs = count_beside(index, kept.index[is_twig])
    leaves = twigs + count_beside(index, index[maybe]) - maybe
    surfaces = count_beside(index, kept.index[~kept.is_loose]) + count_beside(index, index[~loose])
    is_new = np.arange(len(index)) >= len(removed)
    among_twigs = (twigs >= TWIGS) & (surfaces <= twigs)
    among_leaves = (is_new | (twigs > 0)) & (leaves >= LEAVES) & (surfaces <= SURFACES * leaves)
    return np.sort(changed_ids[maybe & (among_twigs | among_leaves)])


def _is_slim(part: _Region) -> Mask:
    return np.asarray((part.across_m < TRUNK_SIGMA_M[0]) & (part.upright_m > TRUNK_SIGMA_M[1]))


def _trunks_m(kept: _Region, before: Gaussians, grid: VoxelGrid, place: F64, height: F64, loose: Mask) -> F64:
    """(T, 2) where trunks stand that did not change, under crowns of which something did.

    Args:
        kept: what did not change.
        before: the whole map.
        grid: the tile's.
        place: (C, 3) of what changed, m.
        height: (C,) its height over the ground.
        loose: (C,) whether it is loose.
    """
    is_low = (kept.height_m > TRUNK_M[0]) & (kept.height_m < TRUNK_M[1])
    post = np.flatnonzero(_is_slim(kept) & is_low)
    all_index = np.stack(grid.unravel(before.voxel_id), axis=1)
    floors = all_index * np.array([1, 1, 2])  # what lies above or below is no neighbour
    post = post[count_beside(kept.index[post] * np.array([1, 1, 2]), floors) <= 2]  # itself, and one more
    columns, which, number = np.unique(kept.index[post, :2], axis=0, return_inverse=True, return_counts=True)
    trunks = [kept.place_m[post[which == k], :2].mean(axis=0) for k in range(len(columns)) if number[k] >= 2]
    around = np.concatenate([kept.place_m[:, :2], place[:, :2]])
    is_high = np.concatenate([kept.height_m, height]) > CORE_M
    is_loose = np.concatenate([kept.is_loose, loose])
    is_changed = np.arange(len(around)) >= len(kept.index)
    found = []
    for trunk in trunks:
        core = is_high & (np.hypot(*(around - trunk).T) < CROWN_CORE_M)
        is_crown = core.sum() >= CORE_VOXELS and is_loose[core].mean() >= CORE_LOOSE
        if is_crown and (core & is_loose & is_changed).sum() >= CORE_CHANGED:
            found.append(trunk)
    return np.array(found, np.float64).reshape(-1, 2)


def _near(place_m: F64, trunk_m: F64) -> Mask:
    apart = place_m[:, None, :2] - trunk_m[None]
    return np.asarray((np.hypot(apart[..., 0], apart[..., 1]) < CROWN_REACH_M).any(axis=1))
