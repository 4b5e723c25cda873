"""Gaussians of tiles as ellipsoids in one map frame, each with its class: what the pictures show."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.truth import Truth
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile import diff
from gnd.gnd_map.tile_id import TileId

FloatArray = NDArray[np.float64]
Tiles = Mapping[TileId, Gaussians]


@dataclass(frozen=True, slots=True, eq=False)
class Ellipsoids:
    """N Gaussians with their classes.

    Attributes:
        mean_m: float64 (N, 3), map frame.
        cov_m2: float64 (N, 3, 3), map frame.
        change_class: uint8 (N,), `ChangeClass`.
    """

    mean_m: FloatArray
    cov_m2: FloatArray
    change_class: NDArray[np.uint8]

    def __len__(self) -> int:
        return len(self.mean_m)

    @staticmethod
    def joined(parts: "list[Ellipsoids]") -> "Ellipsoids":
        """Return all ellipsoids of several sets."""
        if not parts:
            return Ellipsoids(np.empty((0, 3)), np.empty((0, 3, 3)), np.empty(0, np.uint8))
        columns = zip(*((p.mean_m, p.cov_m2, p.change_class) for p in parts), strict=True)
        mean, cov, change_class = (np.concatenate(column) for column in columns)
        return Ellipsoids(mean, cov, change_class)


def ellipsoids_of_tile(
    frame: LocalFrame, tile: TileId, gaussians: Gaussians, change_class: NDArray[np.uint8]
) -> Ellipsoids:
    """Return the Gaussians of a tile in the map frame `frame`, with classes uint8 (N,)."""
    grid = GridFrame.around(frame, [tile])
    centre = grid.centre_map_m(grid.grid_of_voxel(tile, gaussians.voxel_id))
    R_map_tile = frame.R_ecef_enu.T @ LocalFrame.of_tile(tile).R_ecef_enu
    cov = R_map_tile @ gaussians.full_cov() @ R_map_tile.T
    return Ellipsoids(centre + gaussians.mean_m.astype(np.float64) @ R_map_tile.T, cov, change_class)


def ellipsoids_of_maps(frame: LocalFrame, base: Tiles, final: Tiles | None = None) -> Ellipsoids:
    """Return what became of a base map: kept, new, modified Gaussians as they are now, deleted ones as they were.

    With `final` left out, the base map itself, all of it normal.
    """
    final = base if final is None else final
    parts = []
    for tile in sorted(set(base) | set(final)):
        old, new = base.get(tile, Gaussians.empty()), final.get(tile, Gaussians.empty())
        delta = diff(old, new)
        change_class = np.full(len(new), int(ChangeClass.NORMAL), dtype=np.uint8)
        put = np.isin(new.voxel_id, delta.put.voxel_id)
        known = np.isin(new.voxel_id, old.voxel_id)
        change_class[put & known], change_class[put & ~known] = ChangeClass.MODIFIED, ChangeClass.NEW
        parts.append(ellipsoids_of_tile(frame, tile, new, change_class))
        gone = old.select(delta.removed)
        parts.append(ellipsoids_of_tile(frame, tile, gone, np.full(len(gone), int(ChangeClass.DELETED), np.uint8)))
    return Ellipsoids.joined(parts)


def ellipsoids_of_truth(truth: Truth) -> Ellipsoids:
    """Return the true classes: deleted Gaussians as they were before, all others as they stand after."""
    parts = []
    for tile in sorted(set(truth.before) | set(truth.after)):
        low, high = np.searchsorted(truth.morton, [tile.morton, tile.morton + 1])
        voxel_id, change_class = truth.voxel_id[low:high], truth.change_class[low:high]
        gone = truth.before.get(tile, Gaussians.empty()).select(voxel_id[change_class == ChangeClass.DELETED])
        stands = truth.after.get(tile, Gaussians.empty())
        both = concat([gone, stands.take(~np.isin(stands.voxel_id, gone.voxel_id))])
        at = np.searchsorted(voxel_id, both.voxel_id)
        parts.append(ellipsoids_of_tile(truth.frame, tile, both, change_class[at]))
    return Ellipsoids.joined(parts)
