"""The shift test in plain numpy, the twin of `gnd.cloud_merger.shift`: with a k-d tree and arrays of pairs."""

from dataclasses import dataclass, replace
from math import cos, sin
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnd.cloud_merger.shift import (
    SHIFT_DISPLACED_M,
    SHIFT_FITS,
    SHIFT_LEAST_GAUSSIANS,
    SHIFT_MAX_M,
    SHIFT_MAX_RAD,
    CommonShift,
)
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.similarity import similarity
from gnd.schemas.changes import TileChange

F64 = NDArray[np.float64]
Mask = NDArray[np.bool_]

MAX_GAUSSIANS: Final = 400  # of a report that are looked at, every second, third, ... where there are more
_NEIGHBOURS: Final = 12  # base Gaussians that one is compared with
_REACH_M: Final = 1.6  # beyond the largest shift
_STEP_M: Final = 0.05  # of the search
_ROUNDS: Final = 6
_HUBER_M: Final = 0.05
_FLAT: Final = 0.5  # of 0 (a ball) to 1 (a plane)
_PARALLEL: Final = 0.95  # cosine
_LEVEL: Final = 0.95  # cosine with the vertical
_BESIDE_M: Final = 1.0  # Gaussians of one surface lie so near to each other
_FAR_PER_M: Final = 0.05


@dataclass(frozen=True, slots=True, eq=False)
class Surfaces:
    """Gaussians in the tile's frame: places (N, 3), covariances (N, 6), normals (N, 3), how flat (N,) 0 … 1."""

    place_m: F64
    cov_m2: F64
    normal: F64
    flat: F64

    @classmethod
    def of(cls, grid: VoxelGrid, gaussians: Gaussians) -> "Surfaces":
        place = grid.centre_m(gaussians.voxel_id) + gaussians.mean_m.astype(np.float64)
        value, vector = np.linalg.eigh(gaussians.full_cov())
        flat = 1.0 - np.sqrt(np.maximum(value[:, 0], 0.0) / np.maximum(value[:, 1], 1e-9))
        return cls(place.reshape(-1, 3), gaussians.cov_m2.astype(np.float64), vector[:, :, 0], flat)

    @property
    def is_upright(self) -> Mask:
        """(N,) walls and the like."""
        return np.asarray((self.flat > _FLAT) & (np.abs(self.normal[:, 2]) < 0.5))

    @property
    def is_level(self) -> Mask:
        """(N,) roads and the like."""
        return np.asarray((self.flat > _FLAT) & (np.abs(self.normal[:, 2]) > _LEVEL))

    def raised(self, up_m: float) -> "Surfaces":
        """The same so much higher."""
        return replace(self, place_m=self.place_m + np.array([0.0, 0.0, up_m]))

    def take(self, index: NDArray[np.int64] | Mask) -> "Surfaces":
        return Surfaces(self.place_m[index], self.cov_m2[index], self.normal[index], self.flat[index])


def plain_shift_of(change: TileChange, base: Gaussians) -> CommonShift:
    """Test whether a small shift explains what a report says about a tile.

    Args:
        change: the report's part about the tile. Gaussians that were not asked for take no part.
        base: the tile's Gaussians that the vehicle compared with.
    """
    grid = VoxelGrid.of(change.tile)
    there = change.changed.take(change.changed.exists)
    if len(there) < SHIFT_LEAST_GAUSSIANS or len(base) < SHIFT_LEAST_GAUSSIANS:
        return CommonShift(False, len(there))
    surfaces, known = Surfaces.of(grid, _thinned(there)), Surfaces.of(grid, base)
    tree = cKDTree(known.place_m)
    strange = surfaces.take(~fits(surfaces, known, tree, np.zeros(3)))
    if len(strange.place_m) < SHIFT_LEAST_GAUSSIANS:
        return CommonShift(False, len(strange.place_m))
    is_seen, is_changed = (np.isin(base.voxel_id, ids) for ids in (change.observed, change.changed.voxel_id))
    begin = searched(strange, known.take(is_seen & ~is_changed), known, tree)
    motion = _refined(begin, strange, known, tree)
    fit = float(fits(strange, known, tree, motion).mean())
    others = [fits(strange, known, tree, other).mean() for other in _elsewhere(motion)]
    chance = float(np.mean(others))
    unchanged = _unchanged(known.take(is_seen), is_changed[is_seen], motion)
    found = CommonShift(False, len(strange.place_m), fit, chance, unchanged, *motion.tolist())
    upwards = found if found.meets() else _raised(strange, known, tree, is_seen, is_changed)
    return next((replace(one, is_explained=True) for one in (found, upwards) if one.meets()), found)


def _raised(strange: Surfaces, known: Surfaces, tree: cKDTree, is_seen: Mask, is_changed: Mask) -> CommonShift:
    """The shift up or down that most level planes agree on, and what it explains."""
    level, ground = strange.take(strange.is_level), known.take(known.is_level)
    if len(level.place_m) < SHIFT_LEAST_GAUSSIANS or not len(ground.place_m):
        return CommonShift(False, len(strange.place_m))
    near = cKDTree(ground.place_m[:, :2]).query_ball_point(level.place_m[:, :2], _BESIDE_M)
    steps = np.arange(-SHIFT_MAX_M, SHIFT_MAX_M + _STEP_M / 2, _STEP_M)
    votes = np.zeros(len(steps))
    for place, others in zip(level.place_m, near, strict=True):
        up_m = ground.place_m[others, 2] - place[2]
        votes += (np.abs(up_m[:, None] - steps) < _STEP_M).any(axis=0)
    best = float(steps[np.lexsort((np.abs(steps), -votes))[0]])
    fit, chance = (float(fits(strange.raised(up_m), known, tree, np.zeros(3)).mean()) for up_m in (best, -best))
    displaced = is_seen & known.is_level & (abs(best) > SHIFT_DISPLACED_M)
    unchanged = float((~is_changed)[displaced].mean()) if displaced.any() else 1.0
    return CommonShift(False, len(strange.place_m), fit, chance, unchanged, up_m=best)


def _thinned(gaussians: Gaussians) -> Gaussians:
    return gaussians.take(np.arange(0, len(gaussians), -(-len(gaussians) // MAX_GAUSSIANS)))


def moved(place_m: F64, motion: F64) -> F64:
    """(N, 3) places after a motion (east, north, turn)."""
    c, s = cos(motion[2]), sin(motion[2])
    x, y, z = place_m.T
    return np.stack([c * x - s * y + motion[0], s * x + c * y + motion[1], z], axis=1)


def fits(surfaces: Surfaces, known: Surfaces, tree: cKDTree, motion: F64) -> Mask:
    """(N,) whether a surface, moved, is like one of the base Gaussians around it.

    Along a surface its mean lies where the voxel has cut it, so only what the means differ by along the base's normal
    counts; the turn of at most a degree is left out of the covariances.
    """
    place = moved(surfaces.place_m, motion)
    row, other = _pairs(place, tree)
    step = place[row] - known.place_m[other]
    normal = known.normal[other]
    along = np.einsum("ni,ni->n", step, normal)[:, None] * normal
    step = np.where((known.flat[other] > _FLAT)[:, None], along, step)
    yes = np.ones(len(row), bool)
    alike = similarity(yes, np.zeros_like(step), known.cov_m2[other], yes, step, surfaces.cov_m2[row])
    return np.bincount(row, weights=alike >= SHIFT_FITS, minlength=len(place)) > 0


def _pairs(place: F64, tree: cKDTree) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Each place with the base Gaussians nearest to it, within a metre: rows, base rows."""
    distance, at = tree.query(place, k=_NEIGHBOURS, distance_upper_bound=_BESIDE_M)
    row, column = np.nonzero(np.isfinite(distance))
    return row, at[row, column]


def searched(surfaces: Surfaces, unchanged: Surfaces, known: Surfaces, tree: cKDTree) -> F64:
    """The shift (east, north, 0) that most upright planes agree on.

    Each pair of parallel planes votes for the shifts that lay one into the other, each surface that is reported
    unchanged against those that would displace it: along a straight street nothing else would tell how far. Of shifts
    that are as good the smallest.
    """
    axis = np.arange(-SHIFT_MAX_M, SHIFT_MAX_M + _STEP_M / 2, _STEP_M)
    steps = np.stack([values.ravel() for values in np.meshgrid(axis, axis)])
    upright = surfaces.take(surfaces.is_upright)
    votes = np.zeros(steps.shape[1])
    for k, near in enumerate(tree.query_ball_point(upright.place_m, _REACH_M)):
        other = known.take(np.array(sorted(near), np.int64))
        other = other.take((other.flat > _FLAT) & (np.abs(other.normal @ upright.normal[k]) > _PARALLEL))
        apart = other.place_m - upright.place_m[k]
        off = np.einsum("ni,ni->n", apart, other.normal)[:, None] - (
            other.normal[:, :1] * steps[0] + other.normal[:, 1:2] * steps[1]
        )
        beside = np.hypot(apart[:, :1] - steps[0], apart[:, 1:2] - steps[1]) < _BESIDE_M
        votes += ((np.abs(off) < _STEP_M) & beside & (np.abs(apart[:, 2:]) < _BESIDE_M)).any(axis=0)
    still = unchanged.take(unchanged.is_upright)
    against = (np.abs(still.normal[:, :1] * steps[0] + still.normal[:, 1:2] * steps[1]) > SHIFT_DISPLACED_M).sum(axis=0)
    score = votes / max(len(upright.place_m), 1) - against / max(len(still.place_m), 1)
    score -= _FAR_PER_M * np.hypot(*steps)
    best = np.lexsort((steps[1], steps[0], -score))[0]
    return np.array([*steps[:, best], 0.0])


def _refined(begin: F64, surfaces: Surfaces, known: Surfaces, tree: cKDTree) -> F64:
    """The motion after a few rounds of robust point-to-plane least squares, within the limits.

    One more measurement says that it is where it began: what no surface constrains, along a straight wall, stays there.
    """
    motion, prior = begin, np.diag([1.0, 1.0, (_HUBER_M / SHIFT_MAX_RAD) ** 2])
    for _ in range(_ROUNDS):
        place = moved(surfaces.place_m, motion)
        row, other, off = _nearest_planes(place, surfaces, known, tree)
        if len(row) < SHIFT_LEAST_GAUSSIANS // 2:
            break
        normal, arm = known.normal[other], place[row]
        jacobian = np.stack([normal[:, 0], normal[:, 1], normal[:, 1] * arm[:, 0] - normal[:, 0] * arm[:, 1]], axis=1)
        weight = np.minimum(1.0, _HUBER_M / np.maximum(np.abs(off), 1e-9))
        matrix = jacobian.T @ (weight[:, None] * jacobian) + prior
        motion = motion + np.linalg.solve(matrix, -jacobian.T @ (weight * off) - prior @ (motion - begin))
    limit = np.array([SHIFT_MAX_M, SHIFT_MAX_M, SHIFT_MAX_RAD])
    return np.asarray(np.clip(motion, -limit, limit))


def _nearest_planes(
    place: F64, surfaces: Surfaces, known: Surfaces, tree: cKDTree
) -> tuple[NDArray[np.int64], NDArray[np.int64], F64]:
    """Of each place the parallel plane nearest along its normal: rows, base rows, signed distances."""
    row, other = _pairs(place, tree)
    parallel = np.abs(np.einsum("ni,ni->n", surfaces.normal[row], known.normal[other])) > _PARALLEL
    parallel &= (known.flat[other] > _FLAT) & (surfaces.flat[row] > _FLAT)
    row, other = row[parallel], other[parallel]
    off = np.einsum("ni,ni->n", place[row] - known.place_m[other], known.normal[other])
    near = np.abs(off) < 0.3
    row, other, off = row[near], other[near], off[near]
    order = np.lexsort((other, np.abs(off), row))
    first = order[np.unique(row[order], return_index=True)[1]]
    return row[first], other[first], off[first]


def _elsewhere(motion: F64) -> list[F64]:
    """The same step towards the three other sides, turned the other way."""
    x, y, turn = motion.tolist()
    return [np.array([-y, x, -turn]), np.array([-x, -y, -turn]), np.array([y, -x, -turn])]


def _unchanged(seen: Surfaces, is_changed: Mask, motion: F64) -> float:
    """Of the observed surfaces that the motion would have displaced, the share reported unchanged; 0 of none."""
    step = moved(seen.place_m, motion) - seen.place_m
    displaced = (np.abs(np.einsum("ni,ni->n", step, seen.normal)) > SHIFT_DISPLACED_M) & (seen.flat > _FLAT)
    return float((~is_changed)[displaced].mean()) if displaced.any() else 0.0
