"""A street corner that a vehicle with wrong poses measures elsewhere, for the tests of the shift test."""

from math import cos, sin

import numpy as np
from merger_world import TILE, sha_of

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.gaussian import Gaussians, concat
from gnd.gnd_map.grid import GridFrame, VoxelGrid
from gnd.gnd_map.similarity import similarity
from gnd.schemas.changes import TileChange

WALLS = ((0, 6.0), (1, 7.0), (1, -5.0))
_TURN = 0.37  # the walls do not run along the grid


def street(seed, walls=WALLS, noise_m=0.01):
    """(N, 3) points in the tile's frame: ground, and walls as (axis, offset)."""
    rng = np.random.default_rng(seed)
    parts = [np.column_stack([rng.uniform(-12, 12, (90_000, 2)), rng.normal(0.3, noise_m, 90_000)])]
    for axis, offset_m in walls:
        along, height = rng.uniform(-9, 9, 30_000), rng.uniform(0.3, 5.0, 30_000)
        off = rng.normal(offset_m, noise_m, 30_000)
        parts.append(np.column_stack([off, along, height] if axis == 0 else [along, off, height]))
    return displaced(np.concatenate(parts), 0.0, 0.0, _TURN)


def displaced(points, east_m, north_m, turn_rad=0.0):
    """The points as a vehicle maps them whose poses are off by that."""
    c, s = cos(turn_rad), sin(turn_rad)
    return points @ np.array([[c, -s, 0], [s, c, 0], [0, 0, 1]]).T + [east_m, north_m, 0]


def mapped(points):
    """The Gaussians of the tile."""
    frame = VoxelGrid.of(TILE).frame
    accumulator = VoxelAccumulator(GridFrame.around(frame, [TILE]))
    accumulator.add(points)
    return accumulator.finish()[TILE]


def seen_as(base, points):
    """What a vehicle says that measures these points: every voxel of base or world is observed."""
    world = mapped(points)
    both = np.union1d(base.voxel_id, world.voxel_id).astype(np.int32)
    was, now = _filled(base, both), _filled(world, both)
    alike = similarity(was.exists, was.mean_m, was.cov_m2, now.exists, now.mean_m, now.cov_m2)
    changed = now.take(alike < 0.5)
    there = np.isin(changed.voxel_id, base.voxel_id)
    gone = np.where(there, ChangeClass.DELETED, ChangeClass.EMPTY)
    classes = np.where(changed.exists, np.where(there, ChangeClass.MODIFIED, ChangeClass.NEW), gone)
    evidence = np.zeros((len(changed), 4), np.int32)
    return TileChange(TILE, 1, sha_of(base), both, changed, classes.astype(np.uint8), evidence, 0.02, 0.001)


def _filled(gaussians, voxel_id):
    missing = np.setdiff1d(voxel_id, gaussians.voxel_id)
    return concat([gaussians, Gaussians.nothing_at(missing)])
