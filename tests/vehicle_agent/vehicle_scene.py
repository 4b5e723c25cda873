"""A small real place for the vehicle's tests: ground and walls near the tiles of Figure 2, and rays from a sensor."""

import numpy as np

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId

FIGURE_2 = tuple(TileId(morton) for morton in (497353963152, 497353963153, 497353963154, 497353963155))
FRAME = LocalFrame.of_tile(FIGURE_2[0])
GRID_FRAME = GridFrame.around(FRAME, FIGURE_2)
HEIGHT_M = 30.0  # of the walls' feet over the ellipsoid; the ground lies in the floor below
GROUND_M = HEIGHT_M - 0.2
SENSOR = np.array([0.0, 0.0, GROUND_M + 1.9])


def ground(half_m: float = 24.0, step_m: float = 0.1) -> np.ndarray:
    axis = np.arange(-half_m, half_m, step_m)
    x, y = np.meshgrid(axis, axis)
    return np.stack([x.ravel(), y.ravel(), np.full(x.size, GROUND_M)], axis=1)


def wall(x_m: float, y0_m: float = -8.0, y1_m: float = 8.0, height_m: float = 4.0, step_m: float = 0.1) -> np.ndarray:
    y, z = np.meshgrid(np.arange(y0_m, y1_m, step_m), HEIGHT_M + np.arange(0.0, height_m, step_m))
    return np.stack([np.full(y.size, x_m), y.ravel(), z.ravel()], axis=1)


def tiles_of(points_map_m: np.ndarray, version: int = 1) -> dict[TileId, Tile]:
    accumulator = VoxelAccumulator(GRID_FRAME)
    accumulator.add(points_map_m)
    return {tile_id: Tile(tile_id, version, g) for tile_id, g in accumulator.finish().items()}


def published(points_map_m: np.ndarray) -> dict[TileId, Tile]:
    """Tiles as the store publishes them: on the lattice `standard`."""
    lattice = LATTICES["standard"]
    return {t: Tile(t, 1, snap(tile.gaussians, lattice)) for t, tile in tiles_of(points_map_m).items()}


def look(walls: list[tuple[float, float, float, float]], rng: np.random.Generator, n: int = 40_000) -> np.ndarray:
    """Hits of rays from SENSOR in all directions on the ground and on walls (x, y0, y1, height), 2 cm of noise."""
    azimuth, elevation = rng.uniform(-np.pi, np.pi, n), rng.uniform(-0.5, 0.25, n)
    d = np.stack([np.cos(elevation) * np.cos(azimuth), np.cos(elevation) * np.sin(azimuth), np.sin(elevation)], axis=1)
    with np.errstate(divide="ignore"):
        t = (GROUND_M - SENSOR[2]) / d[:, 2]
        t = np.where((t > 0) & (t < 34), t, np.inf)
        for x, y0, y1, height in walls:
            t_wall = (x - SENSOR[0]) / d[:, 0]
            y, z = SENSOR[1] + t_wall * d[:, 1], SENSOR[2] + t_wall * d[:, 2] - HEIGHT_M
            t = np.where((t_wall > 0) & (t_wall < t) & (y >= y0) & (y < y1) & (z >= -0.2) & (z < height), t_wall, t)
    hit = np.isfinite(t)
    return SENSOR + (t[hit] + rng.normal(0, 0.02, hit.sum()))[:, None] * d[hit]
