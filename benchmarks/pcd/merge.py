"""The cloud's side of the point-cloud framework: votes of many drives for new and against old points."""

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from benchmarks.pcd.errors import PcdError
from benchmarks.pcd.index import PcdIndex, index_of
from benchmarks.pcd.parameters import PcdDetectParameters, PcdMergeParameters
from benchmarks.pcd.points import PcdMap, cells_of, without
from benchmarks.pcd.report import PcdReport
from gnd_map.arrays import F32, F64, I32, I64


def merge_pcd(base: PcdMap, reports: Sequence[PcdReport], parameters: PcdMergeParameters | None = None) -> PcdMap:
    """The map after the changes on which more than ξ of the observers agree; the order of reports does not matter.

    Raises:
        PcdError: a report refers to another map.
    """
    parameters = parameters or PcdMergeParameters()
    for report in reports:
        if report.map_size != len(base):
            raise PcdError(f"a report refers to a map of {report.map_size} points, this one has {len(base)}")
    if not reports:
        return base
    index = index_of(base, PcdDetectParameters().planar_ratio)
    seen = _Observers(index, reports)
    return without(base, _deleted(base, index, seen, reports, parameters), _new(index, seen, reports, parameters))


class _Observers:
    """How many reports observed each block."""

    def __init__(self, index: PcdIndex, reports: Sequence[PcdReport]) -> None:
        self._count = np.zeros(len(index.state), np.int32)
        for report in reports:
            self._count[report.observed] += 1

    def of(self, blocks: I64) -> I32:
        return np.asarray(np.where(blocks >= 0, self._count[blocks], 0), np.int32)


def _deleted(
    base: PcdMap, index: PcdIndex, seen: _Observers, reports: Sequence[PcdReport], p: PcdMergeParameters
) -> NDArray[np.bool_]:
    votes = np.zeros(len(base), np.int32)
    for report in reports:
        votes[report.deleted_index] += 1
    blocks = index.blocks_of(index.cells.astype(np.int64))[index.cell_of_point]
    return np.asarray(votes > p.xi * np.maximum(seen.of(blocks), votes))


def _new(index: PcdIndex, seen: _Observers, reports: Sequence[PcdReport], p: PcdMergeParameters) -> F32:
    clouds = [report.new_points.astype(np.float64) for report in reports]
    cells = [cells_of(cloud, index.grid_frame) - index.origin_c for cloud in clouds]
    key, first, which = np.unique(np.concatenate([_keys(c) for c in cells]), return_index=True, return_inverse=True)
    if not len(key):
        return np.empty((0, 3), np.float32)
    votes = np.zeros(len(key), np.int32)
    for one in cells:
        votes += np.isin(key, _spread(one, p.reach_cells))
    blocks = index.blocks_of(np.concatenate(cells)[first])
    accepted = votes > p.xi * np.maximum(seen.of(blocks), votes)
    return _means(np.concatenate(clouds), which, len(key))[accepted]


def _keys(cells: I64) -> I64:
    return np.asarray(((cells[:, 0] + 8) << 42) | ((cells[:, 1] + 8) << 21) | (cells[:, 2] + 8))


def _spread(cells: I64, reach: int) -> I64:
    """Keys of all cells within `reach` of the given ones."""
    steps = range(-reach, reach + 1)
    keys = [_keys(cells + np.array([x, y, z])) for x in steps for y in steps for z in steps]
    return np.unique(np.concatenate(keys))


def _means(points: F64, which: I64, n: int) -> F32:
    count = np.bincount(which, minlength=n)
    sums = np.stack([np.bincount(which, weights=points[:, a], minlength=n) for a in range(3)], axis=1)
    return (sums / count[:, None]).astype(np.float32)
