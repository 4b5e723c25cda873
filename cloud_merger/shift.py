"""Could the changes that a report claims be an error of the vehicle's poses? A test on its Gaussians alone.

A vehicle whose poses are off by a few decimetres measures the unchanged world beside itself: walls seem to have moved,
all by the same step. So the measured Gaussians of a report are laid back onto the base that it was compared with, by
one small rigid motion over the ground (east, north, turn): a coarse search by votes of pairs of planes, then a robust
point-to-plane fit (Chen and Medioni 1992; weights of Huber). The changes are explained by it where

1. most of the Gaussians that fit nothing before fit afterwards (`gnd.gnd_map.similarity`), many more than by the same
   motion in other directions, which is what chance gives, and
2. the rest of the tile agrees: of the surfaces that such a motion would displace, most are not reported as unchanged.

Where no motion over the ground explains them, one up or down is tried, by votes of level planes and under the same
conditions: a LiDAR that hangs lower than its vehicle believes raises every road.

A pure function of a report and its base.
"""

from dataclasses import dataclass, replace
from functools import cached_property, lru_cache
from typing import Final

import numpy as np

from gnd.cloud_merger import shift_kernels as kernels
from gnd.cloud_merger.shift_kernels import Buckets, Mask, Planes
from gnd.cloud_merger.statements import find
from gnd.gnd_map.arrays import F64, I64
from gnd.gnd_map.by_object import ByObject
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.schemas.changes import TileChange

SHIFT_MAX_M: Final = 1.0
"""Largest shift that is looked for, on each axis."""
SHIFT_MAX_RAD: Final = 0.0175
"""Largest turn."""
SHIFT_LEAST_GAUSSIANS: Final = 12
"""So many measured Gaussians that fit nothing must be there, or the test says nothing."""
SHIFT_FITS: Final = 0.5
"""Similarity at which a Gaussian fits the base."""
SHIFT_EXPLAINED_SHARE: Final = 0.65
"""Of these Gaussians so many must fit after the shift, ..."""
SHIFT_BEYOND_CHANCE: Final = 0.3
"""... and so many more than after shifts of that size in other directions."""
SHIFT_DISPLACED_M: Final = 0.12
"""A surface that the shift moves by so much along its normal would have been found changed."""
SHIFT_REFUTED_SHARE: Final = 0.5
"""Where more of these surfaces are reported unchanged, it was no shift."""

MAX_GAUSSIANS: Final = 400  # of a report that are looked at, every second, third, ... where there are more
_LEVEL: Final = 0.95  # cosine with the vertical
_FAR_PER_M: Final = 0.05
_STILL: Final = np.zeros(3)


@dataclass(frozen=True, slots=True)
class CommonShift:
    """What the test found; the motion lays the measurements onto the base: the vehicle's poses are off by its inverse.

    Attributes:
        is_explained: the changes are no changes.
        gaussians: measured Gaussians that fitted nothing before.
        fit: of these, share that fits after the shift.
        chance: the same of shifts of that size in other directions.
        unchanged: of the surfaces that the shift would have displaced, share that the report says is as in the base.
        east_m, north_m: the shift at the tile's centre.
        turn_rad: counter-clockwise seen from above, about the tile's centre.
        up_m: the shift upwards; not together with the others.
    """

    is_explained: bool
    gaussians: int
    fit: float = 0.0
    chance: float = 0.0
    unchanged: float = 1.0
    east_m: float = 0.0
    north_m: float = 0.0
    turn_rad: float = 0.0
    up_m: float = 0.0

    def meets(self) -> bool:
        """Whether it explains the changes: most fit, many more than by chance, and the rest of the tile agrees."""
        return (
            self.fit >= SHIFT_EXPLAINED_SHARE
            and self.fit - self.chance >= SHIFT_BEYOND_CHANCE
            and self.unchanged <= SHIFT_REFUTED_SHARE
        )

    @property
    def length_m(self) -> float:
        """How far the shift is."""
        return float(np.sqrt(self.east_m**2 + self.north_m**2 + self.up_m**2))


@dataclass(frozen=True, eq=False)
class _Surfaces:
    """Gaussians in the tile's frame: places (N, 3), covariances (N, 6), normals (N, 3), how flat (N,) 0 … 1."""

    place_m: F64
    cov_m2: F64
    normal: F64
    flat: F64

    @classmethod
    def of(cls, grid: VoxelGrid, gaussians: Gaussians, rows: I64 | slice = slice(None)) -> "_Surfaces":
        place = grid.centre_m(gaussians.voxel_id[rows]) + gaussians.mean_m[rows].astype(np.float64)
        cov = gaussians.cov_m2[rows].astype(np.float64)
        return cls(place.reshape(-1, 3), cov, *kernels.normals(cov))

    def __len__(self) -> int:
        return len(self.flat)

    @property
    def planes(self) -> Planes:
        """What the kernels take."""
        return self.place_m, self.cov_m2, self.normal, self.flat

    @cached_property
    def buckets(self) -> Buckets:
        """By which the kernels find those near a place."""
        return kernels.buckets_of(self.place_m)

    @cached_property
    def is_upright(self) -> Mask:
        """(N,) walls and the like."""
        return np.asarray((self.flat > kernels.FLAT) & (np.abs(self.normal[:, 2]) < 0.5))

    @cached_property
    def is_level(self) -> Mask:
        """(N,) roads and the like."""
        return np.asarray((self.flat > kernels.FLAT) & (np.abs(self.normal[:, 2]) > _LEVEL))

    @cached_property
    def level(self) -> "_Surfaces":
        """The level ones alone."""
        return self.take(self.is_level)

    def take(self, mask: Mask) -> "_Surfaces":
        index = np.flatnonzero(mask)
        return _Surfaces(self.place_m[index], self.cov_m2[index], self.normal[index], self.flat[index])


_KNOWN: Final[ByObject[_Surfaces]] = ByObject(256)
"""Surfaces of the bases looked at last: the reports of a street refer to few versions."""


def shift_of(change: TileChange, base: Gaussians) -> CommonShift:
    """Test whether a small shift explains what a report says about a tile.

    Args:
        change: the report's part about the tile. Gaussians that were not asked for take no part.
        base: the tile's Gaussians that the vehicle compared with.
    """
    n = int(change.changed.exists.sum())
    if n < SHIFT_LEAST_GAUSSIANS or len(base) < SHIFT_LEAST_GAUSSIANS:
        return CommonShift(False, n)
    surfaces = _Surfaces.of(VoxelGrid.of(change.tile), change.changed, _thinned(change.changed))
    known = _KNOWN.of(base, lambda: _Surfaces.of(VoxelGrid.of(change.tile), base), change.tile)
    strange = surfaces.take(~_fits(surfaces, known, _STILL))
    if len(strange) < SHIFT_LEAST_GAUSSIANS:
        return CommonShift(False, len(strange))
    is_seen, is_changed = (find(ids, base.voxel_id) >= 0 for ids in (change.observed, change.changed.voxel_id))
    begin = _searched(strange, known, is_seen & ~is_changed)
    motion = _refined(begin, strange, known)
    fit = float(_fits(strange, known, motion).mean())
    others = [_fits(strange, known, other).mean() for other in _elsewhere(motion)]
    chance = float(np.mean(others))
    unchanged = kernels.unchanged_share(known.planes, is_seen, is_changed, motion, SHIFT_DISPLACED_M)
    found = CommonShift(False, len(strange), fit, chance, unchanged, *motion.tolist())
    upwards = found if found.meets() else _raised(strange, known, is_seen, is_changed)
    return next((replace(one, is_explained=True) for one in (found, upwards) if one.meets()), found)


def _raised(strange: _Surfaces, known: _Surfaces, is_seen: Mask, is_changed: Mask) -> CommonShift:
    """The shift up or down that most level planes agree on, and what it explains; nothing where the tile refutes it."""
    level, ground, no = strange.level, known.level, CommonShift(False, len(strange))
    if len(level) < SHIFT_LEAST_GAUSSIANS or not len(ground):
        return no
    steps = _axis(SHIFT_MAX_M)
    votes = kernels.votes_up(level.place_m, ground.place_m, ground.buckets, steps)
    best = float(steps[np.lexsort((np.abs(steps), -votes))[0]])
    displaced = is_seen & known.is_level & (abs(best) > SHIFT_DISPLACED_M)
    unchanged = float((~is_changed)[displaced].mean()) if displaced.any() else 1.0
    if unchanged > SHIFT_REFUTED_SHARE:
        return no
    fit, chance = (float(_fits(strange, known, _STILL, up_m).mean()) for up_m in (best, -best))
    return replace(no, fit=fit, chance=chance, unchanged=unchanged, up_m=best)


def _thinned(gaussians: Gaussians) -> I64:
    """Rows of those that are measured, `MAX_GAUSSIANS` at most."""
    there = np.flatnonzero(gaussians.exists)
    return there[:: -(-len(there) // MAX_GAUSSIANS)]


def _fits(surfaces: _Surfaces, known: _Surfaces, motion: F64, up_m: float = 0.0) -> Mask:
    """(N,) whether a surface, moved, is like one of the base Gaussians around it.

    Along a surface its mean lies where the voxel has cut it, so only what the means differ by along the base's normal
    counts; the turn of at most a degree is left out of the covariances.
    """
    return kernels.fitting(surfaces.planes, known.planes, known.buckets, motion, up_m, SHIFT_FITS)


def _axis(max_m: float) -> F64:
    """The shifts along one axis that are looked at."""
    return np.arange(-max_m, max_m + kernels.STEP_M / 2, kernels.STEP_M)


@lru_cache(maxsize=16)
def _steps(max_m: float) -> tuple[F64, F64, F64]:
    """East and north of all shifts, and what their length takes off their scores."""
    east, north = (values.ravel() for values in np.meshgrid(_axis(max_m), _axis(max_m)))
    return east, north, _FAR_PER_M * np.hypot(east, north)


def _searched(surfaces: _Surfaces, known: _Surfaces, is_unchanged: Mask) -> F64:
    """The shift (east, north, 0) that most upright planes agree on.

    Each pair of parallel planes votes for the shifts that lay one into the other, each surface that is reported
    unchanged against those that would displace it: along a straight street nothing else would tell how far. Of shifts
    that are as good the smallest.
    """
    upright = surfaces.take(surfaces.is_upright)
    votes = kernels.votes_of(upright.planes, known.planes, known.buckets, _axis(SHIFT_MAX_M))
    east, north, far = _steps(SHIFT_MAX_M)
    pro = votes / max(len(upright), 1)
    x, y, _ = np.ascontiguousarray(known.normal[is_unchanged & known.is_upright].T)
    best = kernels.best_shift(pro, far, east, north, x, y, SHIFT_DISPLACED_M)
    return np.array([east[best], north[best], 0.0])


def _refined(begin: F64, surfaces: _Surfaces, known: _Surfaces) -> F64:
    """The motion after a few rounds of robust point-to-plane least squares, within the limits.

    One more measurement says that it is where it began: what no surface constrains, along a straight wall, stays there.
    """
    prior = np.array([1.0, 1.0, (kernels.HUBER_M / SHIFT_MAX_RAD) ** 2])
    least = SHIFT_LEAST_GAUSSIANS // 2
    motion = kernels.refined(begin, surfaces.planes, known.planes, known.buckets, prior, least)
    limit = np.array([SHIFT_MAX_M, SHIFT_MAX_M, SHIFT_MAX_RAD])
    return np.asarray(np.clip(motion, -limit, limit))


def _elsewhere(motion: F64) -> list[F64]:
    """The same step towards the three other sides, turned the other way."""
    x, y, turn = motion.tolist()
    return [np.array([-y, x, -turn]), np.array([-x, -y, -turn]), np.array([y, -x, -turn])]
