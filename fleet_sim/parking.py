"""Where voxels of a world lie: on parking, where a car may be taken for a change of the map, and near its lanes."""

from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.fleet_sim.cars import LANE_M
from gnd.fleet_sim.truth import Truth, TruthRules, near
from gnd.fleet_sim.world import World
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import TileId

_HALF_M: Final = 1.6
"""A car is about 1.9 m wide and stands up to 0.3 m off the middle of its lane; voxels reach 0.5 m farther."""
_BAY_M: Final = 3.2
_LOW_M: Final = 0.0
_HIGH_M: Final = 3.0


def on_parking(world: World, truth: Truth) -> NDArray[np.bool_]:
    """Return which voxels of the truth, bool (V,), a car on a parking lane or in a bay may reach."""
    found = np.zeros(len(truth), dtype=np.bool_)
    for morton in np.unique(truth.morton).tolist():
        tile = TileId(int(morton))
        low, high = np.searchsorted(truth.morton, [morton, morton + 1])
        found[low:high] = _on_parking(world, centres_street_m(world, tile, truth.voxel_id[low:high]))
    return found


def centres_street_m(world: World, tile: TileId, voxel_id: NDArray[np.int32]) -> NDArray[np.float64]:
    """Return the centres (K, 3) of voxels (K,) of a tile, street frame [m]."""
    grid = GridFrame.around(world.frame, [tile])
    return world.street_of_map(grid.centre_map_m(grid.grid_of_voxel(tile, voxel_id)))


def near_lanes(world: World, tile: TileId, voxel_id: NDArray[np.int32]) -> NDArray[np.bool_]:
    """Return which voxels (K,) of a tile are near enough to the lanes to be observable, bool (K,)."""
    return near(world, centres_street_m(world, tile, voxel_id), TruthRules())


def _on_parking(world: World, centre_street: NDArray[np.float64]) -> NDArray[np.bool_]:
    """Whether points (N, 3) of the street frame lie where a parked car may be."""
    across, above = np.abs(centre_street[:, 1]), centre_street[:, 2] - world.relief_m(centre_street[:, 0])
    where = np.abs(across - (world.kerb_m - LANE_M)) <= _HALF_M if world.kerb_parking else np.zeros(len(across), bool)
    for bay in world.bays:
        where |= np.hypot(centre_street[:, 0] - bay.x_m, centre_street[:, 1] - bay.y_m) <= _BAY_M
    return np.asarray(where & (above >= _LOW_M) & (above <= _HIGH_M))
