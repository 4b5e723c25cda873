"""Doubled surfaces by construction: one wall, two walls at known distances, things that are no walls, and a plain twin
of the kernel."""

import numpy as np
import pytest

from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.tile_id import covering_circle
from gnd.vehicle_agent.map_build.double_layers import (
    COLUMNS,
    DOUBLE_SHARE,
    LEAST_APART,
    MOST_APART,
    SINGLE_SHARE,
    THICK,
    find_double_layers,
    layers,
)

FRAME = LocalFrame(np.radians(37.5597), np.radians(127.0365), 30.0)


def occupied(points: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Points in the grid's own metres into sub-cells; the walls lie along the grid's axes."""
    grid = GridFrame.around(FRAME, covering_circle(FRAME.lat_rad, FRAME.lon_rad, 60.0))
    accumulator = VoxelAccumulator(grid)
    origin = np.floor(grid.grid_of(np.zeros((1, 3)))[0])
    accumulator.add_grid(np.ascontiguousarray(points + origin))
    return accumulator.occupied()


def wall(x: float, rng: np.random.Generator, n: int = 40_000, noise: float = 0.015) -> np.ndarray:
    y, z = rng.uniform(0, 12, n), rng.uniform(0, 4, n)
    return np.stack([x + noise * rng.standard_normal(n), y, z], axis=1)


@pytest.mark.parametrize("axis", [0, 1, 2])
@pytest.mark.parametrize("apart_m", [0.3, 0.5, 0.8, 0.97])
@pytest.mark.parametrize("x", [3.15, 3.62, 3.93])
def test_two_walls_are_seen_at_their_distance_wherever_they_lie_in_their_voxels(axis, apart_m, x) -> None:
    rng = np.random.default_rng(1)
    both = np.concatenate([wall(x, rng), wall(x + apart_m, rng)])
    found = find_double_layers(*occupied(np.roll(both, axis, axis=1)), (axis,))
    assert found.doubled >= 0.8 * 48
    assert abs(np.median(found.apart_m) - apart_m) <= 0.11


@pytest.mark.parametrize("x", [3.15, 3.62, 3.999])
def test_one_wall_is_one_surface(x: float) -> None:
    found = find_double_layers(*occupied(wall(x, np.random.default_rng(2))), (0, 1, 2))
    assert found.doubled == 0
    assert found.surfaces >= 48


def test_a_slanted_wall_leaves_and_a_fence_are_not_doubled() -> None:
    rng = np.random.default_rng(3)
    n = 40_000
    y, z = rng.uniform(0, 12, n), rng.uniform(0, 4, n)
    slanted = np.stack([3 + 0.5 * y + 0.01 * rng.standard_normal(n), y, z], axis=1)
    leaves = rng.uniform([3, 0, 0], [6, 12, 4], (8_000, 3))
    for points in (slanted, leaves):
        found = find_double_layers(*occupied(points), (0, 1))
        assert found.doubled <= 2
    posts = wall(3.5, rng, 4_000)
    posts = posts[(posts[:, 1] % 1.0) < 0.1]
    assert find_double_layers(*occupied(np.concatenate([posts, wall(4.1, rng)])), (0,)).doubled == 0


def test_of_two_walls_only_those_that_overlap_are_doubled() -> None:
    rng = np.random.default_rng(4)
    front = wall(3.4, rng)
    found = find_double_layers(*occupied(np.concatenate([front[front[:, 1] < 6], wall(3.9, rng)])), (0,))
    assert 20 <= found.doubled <= 28


def test_nothing_is_no_surface() -> None:
    found = find_double_layers(np.empty((0, 3), np.int32), np.empty((0, 16), np.uint64), (0,))
    assert (found.surfaces, found.doubled, found.per_thousand) == (0, 0, 0.0)


def plain_layers(bits: np.ndarray, beyond: np.ndarray, axis: int) -> np.ndarray:
    """The kernel in plain words: cubes of booleans, runs by differences."""
    spots = np.arange(1000)
    cubes = ((bits[:, spots >> 6] >> (spots & 63).astype(np.uint64)) & np.uint64(1)).astype(bool)
    cubes = cubes.reshape(-1, 10, 10, 10).transpose(0, 3, 2, 1)  # x, y, z
    result = []
    for m, cube in enumerate(cubes):
        after = cubes[beyond[m]] if beyond[m] >= 0 else np.zeros_like(cube)
        column = np.moveaxis(np.concatenate([cube, after], axis=axis), axis, -1).reshape(100, 20)
        states = []
        for line in column:
            edges = np.flatnonzero(np.diff(np.r_[0, line.astype(int), 0]))
            runs = [(a, b - 1) for a, b in zip(edges[::2], edges[1::2], strict=True)]
            if not runs or runs[0][0] >= 10:
                continue
            near = [r for r in runs if sum(r) - sum(runs[0]) <= 2 * MOST_APART]
            gap = (sum(near[1]) - sum(near[0]) + 1) // 2 if len(near) == 2 else 0
            if any(b - a >= THICK for a, b in near) or len(near) > 2 or (len(near) == 2 and gap < LEAST_APART):
                states.append(-1)
            else:
                states.append(gap)
        states = np.array(states)
        gaps = range(LEAST_APART, MOST_APART + 1)
        counts = [int(((states >= max(g - 1, LEAST_APART)) & (states <= g + 1)).sum()) for g in gaps]
        if len(states) < COLUMNS:
            result.append(0)
        elif max(counts) >= DOUBLE_SHARE * len(states):
            result.append(1 + LEAST_APART + int(np.argmax(counts)))
        else:
            result.append(int((states == 0).sum() + max(counts) >= SINGLE_SHARE * len(states)))
    return np.array(result)


@pytest.mark.parametrize("axis", [0, 1, 2])
def test_the_kernel_agrees_with_its_plain_twin(axis: int) -> None:
    rng = np.random.default_rng(5)
    clouds = [
        wall(3.2, rng, 20_000),
        wall(3.7, rng, 9000),
        wall(4.4, rng, 9000),
        rng.uniform(0, 8, (6000, 3)),
        wall(6.5, rng, 1500, 0.1),
    ]
    _, bits = occupied(np.roll(np.concatenate(clouds), axis, axis=1))
    beyond = rng.integers(-1, len(bits), len(bits))
    found = layers(bits, beyond, axis)
    assert np.array_equal(found, plain_layers(bits, beyond, axis))
    assert len(set(found.tolist())) > 3
