"""A tile that is wrong: all that it holds, moved sideways."""

import numpy as np

from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile


def shifted(tile: Tile, east_m: float, north_m: float, lattice: str = "standard") -> Tile:
    """The next version of a tile with every Gaussian moved; of those that meet in a voxel the one with more points
    stays, and what leaves the tile is gone.
    """
    grid, held = VoxelGrid.of(tile.tile_id), tile.gaussians
    there = grid.centre_m(held.voxel_id) + held.mean_m + np.array([east_m, north_m, 0.0])
    lat, lon, height = grid.frame.geodetic_from_enu(there)
    (south, west), (north, east) = tile.tile_id.south_west_rad, tile.tile_id.north_east_rad
    inside = np.flatnonzero((lat >= south) & (lat < north) & (lon >= west) & (lon < east))
    voxel_id = grid.voxel_of(lat[inside], lon[inside], height[inside])
    mean_m = (there[inside] - grid.centre_m(voxel_id)).astype(np.float32)
    order = np.lexsort((-held.count[inside], voxel_id))
    first = order[np.unique(voxel_id[order], return_index=True)[1]]
    rows = inside[first]
    moved = Gaussians(voxel_id[first], held.count[rows], held.cells[rows], mean_m[first], held.cov_m2[rows])
    return Tile(tile.tile_id, tile.version + 1, snap(moved, LATTICES[lattice]))
