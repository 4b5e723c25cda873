"""Objects of motion segmentation: voxels over the ground, what belongs together, and the points of what moves."""

import math

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, I32, I64
from gnd.gnd_map.jit import bare, kernel
from gnd.vehicle_agent.segment.ground_kernels import GroundGrid

U8 = NDArray[np.uint8]

GROUND, LOW, OUTSIDE = -1, -2, -3
"""What a point is that belongs to no voxel; low points lie between ground and objects."""
MOST_REACH = 8
"""Voxels between the heights of two that are joined, at most."""
_LIMIT = 1 << 20
_HASH = np.uint64(0x9E3779B97F4A7C15)


@bare
def _key(i: int, j: int, k: int) -> int:
    return ((i + _LIMIT) << 42) | ((j + _LIMIT) << 21) | (k + _LIMIT)


@bare
def _slot(keys: I64, key: int) -> int:
    """Where `key` is in the table, or the empty place where it belongs."""
    mask = np.uint64(len(keys) - 1)
    at = (np.uint64(key) * _HASH) >> np.uint64(32)
    at &= mask
    while keys[at] != key and keys[at] != -1:
        at = (at + np.uint64(1)) & mask
    return int(at)


@kernel
def find_objects(
    points: F32, origins: F32, ground: F32, grid: GroundGrid, ground_m: float, feet_m: float, voxel_m: float,
    range_min_m: float, range_max_m: float, keys: I64, values: I32,
) -> tuple[I32, I32, I32]:  # fmt: skip
    """Sort the points into ground, low ones and voxels of objects.

    Args:
        points: (N, 3) float32 ends of the rays.
        origins: (N, 3) float32 their starts.
        ground: (nx, ny) of `ground_heights`.
        grid: its place.
        ground_m: height over the ground where objects begin.
        feet_m: height over the ground where low points begin.
        voxel_m: size of voxels.
        range_min_m: nearer points are `OUTSIDE`.
        range_max_m: farther ones too.
        keys: empty hash table, all -1: a power of two at least twice N.
        values: of the same length.

    Returns:
        voxel of each point (N,) int32, or GROUND, LOW, OUTSIDE; one point of each voxel (V,) int32; its indices (V, 3).
    """
    voxel_of = np.empty(len(points), np.int32)
    first = np.empty(len(points), np.int32)
    index = np.empty((len(points), 3), np.int32)
    count = 0
    near2, far2 = range_min_m * range_min_m, range_max_m * range_max_m
    for n in range(len(points)):
        x, y, z = points[n, 0], points[n, 1], points[n, 2]
        dx, dy, dz = x - origins[n, 0], y - origins[n, 1], z - origins[n, 2]
        r2 = dx * dx + dy * dy + dz * dz
        gi, gj = math.floor((x - grid.x0) / grid.cell_m), math.floor((y - grid.y0) / grid.cell_m)
        if r2 < near2 or r2 > far2 or gi < 0 or gj < 0 or gi >= grid.nx or gj >= grid.ny:
            voxel_of[n] = OUTSIDE
            continue
        height = z - ground[gi, gj]
        if height < ground_m:
            voxel_of[n] = GROUND if height < feet_m else LOW
            continue
        i, j, k = math.floor(x / voxel_m), math.floor(y / voxel_m), math.floor(z / voxel_m)
        key = _key(i, j, k)
        at = _slot(keys, key)
        if keys[at] == -1:
            keys[at], values[at] = key, count
            first[count] = n
            index[count] = i, j, k
            count += 1
        voxel_of[n] = values[at]
    return voxel_of, first[:count].copy(), index[:count].copy()


@bare
def _root(parent: I32, n: int) -> int:
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


@bare
def _join(parent: I32, a: int, b: int) -> None:
    """The root with the smaller number stays."""
    a, b = _root(parent, a), _root(parent, b)
    if a != b:
        parent[max(a, b)] = min(a, b)


@bare
def _join_above(index: I32, n: int, reach: int, keys: I64, values: I32, parent: I32) -> None:
    """Join voxel `n` with the nine above it, else with the next one straight above: layers leave gaps."""
    found = False
    for column in range(9):
        at = _slot(keys, _key(index[n, 0] + column // 3 - 1, index[n, 1] + column % 3 - 1, index[n, 2] + 1))
        if keys[at] != -1:
            _join(parent, n, values[at])
            found = True
    for up in range(2, reach + 1):
        if found:
            break
        at = _slot(keys, _key(index[n, 0], index[n, 1], index[n, 2] + up))
        if keys[at] != -1:
            _join(parent, n, values[at])
            found = True


@kernel
def components(index: I32, reach: U8, chosen: NDArray[np.bool_], keys: I64, values: I32) -> I32:
    """(V,) int32: number of the component of each chosen voxel, -1 for the others.

    Voxels that touch (26-neighbourhood) are joined, and those with at most `reach` (V,) voxels between their heights.
    Components are numbered in the order of their first voxels. `keys` and `values` are an empty hash table.
    """
    n_voxels = len(index)
    parent = np.arange(n_voxels).astype(np.int32)
    for n in range(n_voxels):
        if chosen[n]:
            key = _key(index[n, 0], index[n, 1], index[n, 2])
            at = _slot(keys, key)
            keys[at], values[at] = key, n
    for n in range(n_voxels):
        if not chosen[n]:
            continue
        for column in range(5, 9):  # half of the neighbours at the same height: the others look here
            i, j = index[n, 0] + column // 3 - 1, index[n, 1] + column % 3 - 1
            at = _slot(keys, _key(i, j, index[n, 2]))
            if keys[at] != -1:
                _join(parent, n, values[at])
        _join_above(index, n, reach[n], keys, values, parent)
    return _numbered(parent, chosen)


@bare
def _reached(at: int, keys: I64, values: I32, label: I32, waiting: I32, depth: int, number: int) -> tuple[bool, int]:
    """Whether there is a voxel at a place of the table; one without a number gets it, and waits."""
    if keys[at] == -1:
        return False, depth
    n = values[at]
    if label[n] < 0:
        label[n] = number
        waiting[depth] = n
        depth += 1
    return True, depth


@bare
def _has_above(i: int, j: int, k: int, keys: I64) -> bool:
    """Whether one of the nine voxels above is there."""
    found = False
    for column in range(9):
        found = found or keys[_slot(keys, _key(i + column // 3 - 1, j + column % 3 - 1, k + 1))] != -1
    return bool(found)


@bare
def _wait_around(
    index: I32, n: int, reach: U8, keys: I64, values: I32, label: I32, waiting: I32, depth: int, number: int
) -> int:
    """Let the voxels wait that are joined with `n`, the same ones as in `components`; gives how many wait."""
    i, j, k = index[n, 0], index[n, 1], index[n, 2]
    above, below = False, False
    for column in range(9):
        a, b = i + column // 3 - 1, j + column % 3 - 1
        if column != 4:
            _, depth = _reached(_slot(keys, _key(a, b, k)), keys, values, label, waiting, depth, number)
        found, depth = _reached(_slot(keys, _key(a, b, k + 1)), keys, values, label, waiting, depth, number)
        above = above or found
        found, depth = _reached(_slot(keys, _key(a, b, k - 1)), keys, values, label, waiting, depth, number)
        below = below or (found and column == 4)
    for up in range(2, reach[n] + 1):
        if above:
            break
        above, depth = _reached(_slot(keys, _key(i, j, k + up)), keys, values, label, waiting, depth, number)
    for down in range(2, MOST_REACH + 1):  # who looks up from below, and finds nothing nearer, finds this one
        if below:
            break
        at = _slot(keys, _key(i, j, k - down))
        below = bool(keys[at] != -1)
        if below and reach[values[at]] >= down and not _has_above(i, j, k - down, keys):
            _, depth = _reached(at, keys, values, label, waiting, depth, number)
    return depth


@bare
def components_of(
    index: I32, reach: U8, seeds: NDArray[np.bool_], keys: I64, values: I32, label: I32, waiting: I32
) -> None:
    """Fill `label` (V,) with the number of the component of each voxel that is joined with a seed, -1 for the others:
    what `components` gives of all voxels, only that no time is spent on components without a seed.

    Args:
        index: (V, 3) int32 of the voxels, each once.
        reach: (V,) as of `components`, at most `MOST_REACH`.
        seeds: (V,) bool. Components are numbered in the order of their first seeds.
        keys: empty hash table for all voxels.
        values: of the same length.
        label: (V,) int32, filled.
        waiting: (V,) int32, room.
    """
    for n in range(len(index)):
        label[n] = -1
        key = _key(index[n, 0], index[n, 1], index[n, 2])
        at = _slot(keys, key)
        keys[at], values[at] = key, n
    number = 0
    for seed in range(len(index)):
        if not seeds[seed] or label[seed] >= 0:
            continue
        label[seed] = number
        waiting[0], depth = seed, 1
        while depth > 0:
            depth -= 1
            depth = _wait_around(index, waiting[depth], reach, keys, values, label, waiting, depth, number)
        number += 1


@kernel
def _numbered(parent: I32, chosen: NDArray[np.bool_]) -> I32:
    """Components numbered from 0 in the order of their roots, which come first; -1 for voxels not chosen."""
    label = np.full(len(parent), -1, np.int32)
    count = 0
    for n in range(len(parent)):
        if chosen[n]:
            root = _root(parent, n)
            if root == n:
                label[n] = count
                count += 1
            else:
                label[n] = label[root]
    return label


@kernel
def moving_points(points: F32, voxel_of: I32, index: I32, moves: NDArray[np.bool_], voxel_m: float,
                  keys: I64, values: I32) -> NDArray[np.bool_]:  # fmt: skip
    """(N,) bool: points of moving voxels, and low points up to two voxels below one.

    `keys` and `values` are an empty hash table.
    """
    for n in range(len(index)):
        if moves[n]:
            at = _slot(keys, _key(index[n, 0], index[n, 1], index[n, 2]))
            keys[at] = _key(index[n, 0], index[n, 1], index[n, 2])
            values[at] = n
    result = np.zeros(len(points), np.bool_)
    for n in range(len(points)):
        if voxel_of[n] >= 0:
            result[n] = moves[voxel_of[n]]
        elif voxel_of[n] == LOW:
            i, j = math.floor(points[n, 0] / voxel_m), math.floor(points[n, 1] / voxel_m)
            k = math.floor(points[n, 2] / voxel_m)
            for up in range(3):
                if keys[_slot(keys, _key(i, j, k + up))] != -1:
                    result[n] = True
                    break
    return result
