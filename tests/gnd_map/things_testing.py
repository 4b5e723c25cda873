"""Gaussians of things that stand on a street, from points on their surfaces."""

import numpy as np

from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile_id import TileId

TILE = TileId(497353963154)
GRID = VoxelGrid.of(TILE)
GROUND_M = 40.7
STEP_M = 0.06


def box(x, y, length, width, low, top, turned_rad=0.0):
    """(N, 3) points on the upright sides and the top of a box: metres east and north of the tile's corner, up."""
    u, v = np.arange(-length / 2, length / 2, STEP_M), np.arange(-width / 2, width / 2, STEP_M)
    z = np.arange(low, top, STEP_M)
    sides = [np.stack(np.meshgrid(u, [e], z), -1).reshape(-1, 3) for e in (-width / 2, width / 2)]
    sides += [np.stack(np.meshgrid([e], v, z), -1).reshape(-1, 3) for e in (-length / 2, length / 2)]
    points = np.concatenate([*sides, np.stack(np.meshgrid(u, v, [top]), -1).reshape(-1, 3)])
    c, s = np.cos(turned_rad), np.sin(turned_rad)
    points[:, :2] = points[:, :2] @ np.array([[c, s], [-s, c]])
    return points + np.array([x, y, 0.0])


def car(x, y, turned_rad=0.0, *, ground_m=GROUND_M, length=4.4, top=1.5):
    """A car's body and cabin."""
    body = box(x, y, length, 1.8, ground_m + 0.25, ground_m + 0.85, turned_rad)
    return np.concatenate([body, box(x, y, length * 0.55, 1.55, ground_m + 0.85, ground_m + top, turned_rad)])


def street(slope=0.0, level_m=GROUND_M):
    """(N, 3) points of the ground of the whole tile, that rises to the east."""
    x, y = np.meshgrid(np.arange(0.05, GRID.nx * GRID.dx_m, 0.1), np.arange(0.05, GRID.ny * GRID.dy_m, 0.1))
    return np.stack([x, y, level_m + slope * x], -1).reshape(-1, 3)


def gaussians(*points):
    """The Gaussians of points."""
    p = np.concatenate(points)
    ix, iy, floor = np.floor(p[:, 0] / GRID.dx_m), np.floor(p[:, 1] / GRID.dy_m), np.floor(p[:, 2])
    ids, at = np.unique(GRID.voxel_id(ix, iy, floor), return_inverse=True)
    n = np.bincount(at)
    middle = np.stack([(ix + 0.5) * GRID.dx_m, (iy + 0.5) * GRID.dy_m, floor + 0.5], axis=1)
    off = p - middle
    mean = np.stack([np.bincount(at, off[:, k]) / n for k in range(3)], axis=1)
    d = off - mean[at]
    pairs = ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2))
    cov = np.stack([np.bincount(at, d[:, a] * d[:, b]) / n for a, b in pairs], axis=1)
    rich = n >= 10
    cells = np.minimum(n, 200).astype(np.int32)
    cov[:, [0, 3, 5]] = np.maximum(cov[:, [0, 3, 5]], 0.0)
    columns = ids.astype(np.int32), n.astype(np.int32), cells, mean.astype(np.float32), cov.astype(np.float32)
    found = Gaussians(*columns)
    return found.take(np.flatnonzero(rich))


def new_against(before, *points):
    """The Gaussians of points in voxels in which the map holds nothing."""
    found = gaussians(*points)
    return found.take(np.flatnonzero(~np.isin(found.voxel_id, before.voxel_id)))
