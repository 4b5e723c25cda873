"""Reports about a point cloud merged, and scored as Gaussians."""

from collections.abc import Mapping, Sequence

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.evaluate import Evaluation, evaluate_maps
from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.arrays import F32, F64, I32, I64
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.jit import kernel
from gnd.gnd_map.similarity import similarity
from gnd.gnd_map.tile_id import TileId
from studies.pcd.index import PcdIndex, index_of
from studies.pcd.points import (
    PLANAR_RATIO,
    REACH_CELLS,
    SIMILAR,
    XI,
    PcdError,
    PcdMap,
    cell_keys,
    cells_of,
    key_cells,
    without,
)
from studies.pcd.report import PcdReport


def merge_pcd(base: PcdMap, reports: Sequence[PcdReport]) -> PcdMap:
    """The map after the changes on which more than ξ of the observers agree; the order of reports does not matter.

    Raises:
        PcdError: a report refers to another map.
    """
    for report in reports:
        if report.map_size != len(base):
            raise PcdError(f"a report refers to a map of {report.map_size} points, this one has {len(base)}")
    if not reports:
        return base
    index = index_of(base, PLANAR_RATIO)
    seen = _Observers(index, reports)
    return without(base, _deleted(base, index, seen, reports), _new(index, seen, reports))


class _Observers:
    """How many reports observed each block."""

    def __init__(self, index: PcdIndex, reports: Sequence[PcdReport]) -> None:
        self._count = np.zeros(len(index.state), np.int32)
        for report in reports:
            self._count[report.observed] += 1

    def of(self, blocks: I64) -> I32:
        return np.asarray(np.where(blocks >= 0, self._count[blocks], 0), np.int32)


def _deleted(base: PcdMap, index: PcdIndex, seen: _Observers, reports: Sequence[PcdReport]) -> NDArray[np.bool_]:
    votes = np.zeros(len(base), np.int32)
    for report in reports:
        votes[report.deleted_index] += 1
    blocks = index.blocks_of(index.cells.astype(np.int64))[index.cell_of_point]
    return np.asarray(votes > XI * np.maximum(seen.of(blocks), votes))


def _new(index: PcdIndex, seen: _Observers, reports: Sequence[PcdReport]) -> F32:
    """Centroids of the new cells for which enough reports have a new point in or beside the cell."""
    clouds = [report.new_points.astype(np.float64) for report in reports]
    cells = [cells_of(cloud, index.grid_frame) for cloud in clouds]
    key, which = np.unique(cell_keys(np.concatenate(cells), index.grid_frame), return_inverse=True)
    owner = np.repeat(np.arange(len(reports)), [len(c) for c in cells])
    reported = np.zeros((len(key), -(-len(reports) // 64)), np.uint64)
    np.bitwise_or.at(reported, (which, owner // 64), np.uint64(1) << (owner % 64).astype(np.uint64))
    votes = count_votes(key, reported, REACH_CELLS)
    blocks = index.blocks_of(key_cells(key, index.grid_frame) - index.origin_c)
    accepted = votes > XI * np.maximum(seen.of(blocks), votes)
    return _means(np.concatenate(clouds), which, len(key))[accepted]


def _means(points: F64, which: I64, n: int) -> F32:
    """(n, 3) float32 means of points (N, 3) by group."""
    count = np.bincount(which, minlength=n)
    sums = [np.bincount(which, weights=points[:, a], minlength=n) for a in range(3)]
    return (np.stack(sums, axis=1) / count[:, None]).astype(np.float32)


@kernel
def count_votes(keys: I64, reported: NDArray[np.uint64], reach: int) -> I32:
    """(C,) int32: how many reports have a point within `reach` cells of each cell.

    `keys` (C,) sorted cell keys; `reported` (C, W): bit r of word w is set where report 64 w + r has a point.
    """
    votes = np.zeros(len(keys), np.int32)
    word = np.empty(reported.shape[1], np.uint64)
    for c in range(len(keys)):
        word[:] = 0
        for dx in range(-reach, reach + 1):
            for dy in range(-reach, reach + 1):
                middle = keys[c] + (np.int64(dx) << 42) + (np.int64(dy) << 21)
                at = np.searchsorted(keys, middle - reach)
                while at < len(keys) and keys[at] <= middle + reach:
                    for w in range(len(word)):
                        word[w] |= reported[at, w]
                    at += 1
        for w in range(len(word)):
            bits = word[w]
            while bits != np.uint64(0):
                bits &= bits - np.uint64(1)
                votes[c] += 1
    return votes


Tiles = Mapping[TileId, Gaussians]


def settled(before: Tiles, after: Tiles, similar: float = SIMILAR) -> dict[TileId, Gaussians]:
    """`after` with the Gaussians of `before` where the two are at least `similar`.

    A few changed points alter a Gaussian by a hair; the paper compares normal distributions, and a voxel counts as
    modified there only when they differ. Points that nothing was said about stay to the bit, so the threshold can be
    higher than the GND framework's 0.5, which must allow for measurement noise in unchanged voxels; and it must be,
    because old points that a new surface hides stay in the cloud.
    """
    return {t: _settled(before.get(t, Gaussians.empty()), g, similar) for t, g in after.items()}


def _settled(old: Gaussians, new: Gaussians, similar: float) -> Gaussians:
    _, i, j = np.intersect1d(old.voxel_id, new.voxel_id, assume_unique=True, return_indices=True)
    a, b = old.take(i), new.take(j)
    alike = similarity(a.exists, a.mean_m, a.cov_m2, b.exists, b.mean_m, b.cov_m2) >= similar
    changed = np.ones(len(new), np.bool_)
    changed[j[alike]] = False
    return concat([new.take(changed), a.take(alike)])


def evaluate_gnd(truth: Truth, before: Tiles, after: Tiles, similar: float = SIMILAR) -> Evaluation:
    """F1 of the Gaussians `after` an update of the Gaussians `before`, both converted from point clouds."""
    return evaluate_maps(truth, before, settled(before, after, similar))
