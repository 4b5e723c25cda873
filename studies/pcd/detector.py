"""One drive against a point-cloud map: evidence about every map point, and new points where the map has none."""

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64, I32, I64, points_3d
from gnd.gnd_map.errors import ShapeError
from gnd.gnd_map.evidence import ChangeState, masses, states
from studies.pcd.index import PcdIndex, index_of
from studies.pcd.kernel import CELLS, EMPTY, SIDE, PcdCounts, Rules, cast_rays, support_sums
from studies.pcd.points import (
    AHEAD_M,
    BESIDE_M,
    BEYOND_M,
    MASSES,
    MIN_PASS_POINTS,
    MIN_PASSES,
    NEAR_M,
    NEW_MASSES,
    NEW_SUPPORT_CELLS,
    PLANAR_RATIO,
    RANGE_M,
    SUPPORT_CELLS,
    PcdMap,
)  # fmt: skip
from studies.pcd.report import PcdReport

_FIRST_ROWS = 1 << 12


class PcdDetector:
    """Ray casting on map points, each with its own evidence (the paper's [44])."""

    def __init__(self, base: PcdMap) -> None:
        self.base = base
        self.index = index_of(base, PLANAR_RATIO)
        self._rules = Rules(NEAR_M, BEYOND_M, BESIDE_M, AHEAD_M, *RANGE_M)
        self._used = 0
        self._counts = _no_counts(self.index)

    def add_scan(self, points_map_m: F64, origins_map_m: F64, moving: NDArray[np.bool_] | None = None) -> None:
        """Count the rays of one scan.

        Args:
            points_map_m: (N, 3) float64 hits, map frame.
            origins_map_m: (N, 3) the sensor at each point, or (3,) for all.
            moving: (N,) bool, points on moving objects: their rays pass, their ends count for nothing.

        Raises:
            ShapeError: a wrong shape or a value that is not finite; nothing is counted then.
        """
        points = points_3d("points_map_m", points_map_m)
        origins = points_3d("origins_map_m", np.atleast_2d(origins_map_m))
        moves = np.zeros(len(points), np.bool_) if moving is None else np.ascontiguousarray(moving, np.bool_)
        if len(origins) not in (1, len(points)) or moves.shape != (len(points),):
            raise ShapeError(f"{len(points)} points, {len(origins)} origins, moving of shape {moves.shape}")
        if not len(points):
            return
        A, b = self.index.window_affine(0.5 * (origins[0] + origins[-1]))
        near, near_o, done = points - self.index.anchor_m, origins - self.index.anchor_m, 0
        while done < len(points):
            if self._used >= len(self._counts.new_block):
                self._counts = _grown(self._counts)
            done, self._used = cast_rays(
                near, near_o, A, b, self.index.base, self._counts, self._used, self._rules, moves, done
            )

    def finish(self) -> PcdReport:
        """What the drive has found out: deleted map points, new points, and the blocks that it observed."""
        deleted = self._deleted_cells()
        return PcdReport(
            new_points=self._new_points(),
            deleted_index=np.flatnonzero(deleted[self.index.cell_of_point]).astype(np.int32),
            observed=self._observed(deleted),
            map_size=len(self.base),
        )

    def _deleted_cells(self) -> NDArray[np.bool_]:
        """(U,) map cells whose evidence, with that of the cells around, says "changed"."""
        c = self._counts
        at, zero = self.index, np.zeros(len(self.index.cells), np.int32)
        hits, passes = support_sums(
            at.base, at.state, at.cells, c.map_hits, c.map_passes, SUPPORT_CELLS, MIN_PASS_POINTS
        )
        touched = np.flatnonzero(passes >= max(MIN_PASS_POINTS, 1))
        some = zero[touched]
        state = states(masses(hits[touched], some, some, passes[touched], MASSES))
        deleted = np.zeros(len(zero), np.bool_)
        deleted[touched[state == ChangeState.CHANGED]] = True
        return deleted

    def _new_points(self) -> F32:
        """(K, 3) float32 centroids, map frame, of the new cells whose evidence says "changed"."""
        c, used = self._counts, self._used
        row, cell = np.nonzero(c.new_hits[:used])
        corner = self.index.corners_of(c.new_block[row])
        at = corner + np.stack(np.unravel_index(cell, (SIDE,) * 3), axis=1)
        hits = c.new_hits[row, cell]
        support = box_sums(at, hits, NEW_SUPPORT_CELLS)
        zero = np.zeros(len(hits), np.int64)
        state = states(masses(c.new_passes[row, cell], zero, zero, support, NEW_MASSES))
        new = state == ChangeState.CHANGED
        fraction = c.new_sum[row, cell][new].astype(np.float64) / hits[new, None]
        return self.index.points_at(at[new] + fraction).astype(np.float32)

    def _observed(self, deleted: NDArray[np.bool_]) -> I32:
        """Sorted numbers of the blocks that the drive can speak about: seen, or with cells that it calls deleted."""
        c, base = self._counts, self.index.base
        seen = np.add.reduceat((c.map_hits > 0) | (c.map_passes > 0) | deleted, base.start, dtype=np.int32) > 0
        of_map = np.flatnonzero((c.state >= 0) & (c.state < len(base.start)))
        empty = np.flatnonzero(EMPTY - c.state >= MIN_PASSES)
        parts = of_map[seen[c.state[of_map]]], empty, c.new_block[: self._used]
        return np.unique(np.concatenate(parts)).astype(np.int32)


def _no_counts(index: PcdIndex) -> PcdCounts:
    rows, cells = len(index.base.start), len(index.cells)
    return PcdCounts(
        state=index.state.copy(),
        map_hits=np.zeros(cells, np.int32),
        map_passes=np.zeros(cells, np.int32),
        new_of=np.full(rows, -1, np.int32),
        new_hits=np.zeros((_FIRST_ROWS, CELLS), np.int32),
        new_passes=np.zeros((_FIRST_ROWS, CELLS), np.int32),
        new_sum=np.zeros((_FIRST_ROWS, CELLS, 3), np.float32),
        new_block=np.zeros(_FIRST_ROWS, np.int32),
    )


def _grown(c: PcdCounts) -> PcdCounts:
    """Room for twice as many new blocks."""
    names = ("new_hits", "new_passes", "new_sum", "new_block")
    return c._replace(**{name: np.concatenate([getattr(c, name), np.zeros_like(getattr(c, name))]) for name in names})


def box_sums(at: I64, values: I32, reach: int) -> I64:
    """(K,) sums of `values` over the listed cells (K, 3) within `reach` cells of each."""
    if not len(at):
        return np.zeros(0, np.int64)
    low = at.min(axis=0) - reach
    shape = at.max(axis=0) + reach + 1 - low
    key = np.ravel_multi_index(tuple((at - low).T), tuple(shape.tolist()))
    order = np.argsort(key)
    ordered, total = key[order], np.zeros(len(at), np.int64)
    steps = range(-reach, reach + 1)
    for dx, dy, dz in ((x, y, z) for x in steps for y in steps for z in steps):
        wanted = key + (dx * shape[1] + dy) * shape[2] + dz
        found = np.minimum(np.searchsorted(ordered, wanted), len(at) - 1)
        total += np.where(ordered[found] == wanted, values[order[found]], 0)
    return total
