"""The voxels of a point cloud that an update has changed, as two Gaussians and the points between them."""

from collections.abc import Mapping
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId
from gnd.vehicle_agent.detect.shape_change import ShapeModel
from studies.pcd.merge import merge_pcd
from studies.pcd.points import PcdMap, gnd_of
from studies.pcd.report import PcdReport

Tiles = Mapping[TileId, Gaussians]
I32 = NDArray[np.int32]


@dataclass(frozen=True, slots=True, eq=False)
class ChangedShapes:
    """The K voxels of a tile with Gaussians before and after that are not the same to the bit.

    Attributes:
        was, now: the two Gaussians, K each.
        stayed, came, went: int32 (K,) points: to a cloud they are what BI, BO and PI are to rays.
    """

    was: Gaussians
    now: Gaussians
    stayed: I32
    came: I32
    went: I32


def changed_shapes(base: PcdMap, report: PcdReport, grid_frame: GridFrame) -> dict[TileId, ChangedShapes]:
    """Return what the update by one drive changes, by tile.

    Args:
        base: the cloud before.
        report: of the drive.
        grid_frame: of the voxels.
    """
    deleted = np.zeros(len(base), np.bool_)
    deleted[report.deleted_index] = True
    kept = gnd_of(PcdMap(base.points_m[~deleted], base.frame), grid_frame, n_min_cells=1)
    before, after = gnd_of(base, grid_frame), gnd_of(merge_pcd(base, [report]), grid_frame)
    none = Gaussians.empty()
    return {t: _compared(before[t], after[t], kept.get(t, none)) for t in sorted(set(before) & set(after))}


def _compared(before: Gaussians, after: Gaussians, kept: Gaussians) -> ChangedShapes:
    """What changed in one tile; `kept` holds what stayed, however few points."""
    _, i, j = np.intersect1d(before.voxel_id, after.voxel_id, assume_unique=True, return_indices=True)
    was, now = before.take(i), after.take(j)
    differ = (was.mean_m != now.mean_m).any(axis=1) | (was.count != now.count)
    was, now = was.take(differ), now.take(differ)
    stayed = _counts_at(kept, was.voxel_id)
    return ChangedShapes(was, now, stayed, (now.count - stayed).clip(0), (was.count - stayed).clip(0))


def _counts_at(gaussians: Gaussians, voxel_id: I32) -> I32:
    """(K,) points in voxels, 0 where there are none."""
    if not len(gaussians):
        return np.zeros(len(voxel_id), np.int32)
    at = np.minimum(np.searchsorted(gaussians.voxel_id, voxel_id), len(gaussians) - 1)
    return np.where(gaussians.voxel_id[at] == voxel_id, gaussians.count[at], 0).astype(np.int32)


@lru_cache(maxsize=1)
def cloud_model() -> ShapeModel:
    """Return the model that was fitted for the baseline (`shape_change.json` beside this file)."""
    return ShapeModel.from_json((files("studies.pcd") / "shape_change.json").read_text(encoding="utf-8"))
