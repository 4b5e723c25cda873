"""The ground of motion segmentation: heights of squares, remembered from scan to scan.

Points are float32 relative to their scan's centre (mean position of the sensor), map axes, so z is up. Each file of
kernels stands alone: numba notices changes of a kernel's own module only.
"""

import math
from typing import NamedTuple

import numpy as np

from gnd.gnd_map.arrays import F32, F64
from gnd.gnd_map.jit import bare, kernel

PIT_M = 0.3
REACH_CELLS = 5
"""How far the ground is carried on where something stands on it."""


class GroundGrid(NamedTuple):
    """Squares of the ground, corner at (x0, y0)."""

    x0: float
    y0: float
    cell_m: float
    nx: int
    ny: int


@kernel
def lowest_heights(points: F32, grid: GroundGrid, near_m: float) -> F32:
    """(nx, ny) height of the second lowest point of each cell (the lowest is sometimes an echo), inf without two.

    Points nearer than `near_m` to the centre are left out: no ray reaches the ground there.
    """
    lowest = np.full((grid.nx, grid.ny), np.float32(np.inf))
    second = np.full((grid.nx, grid.ny), np.float32(np.inf))
    for n in range(len(points)):
        i, j = math.floor((points[n, 0] - grid.x0) / grid.cell_m), math.floor((points[n, 1] - grid.y0) / grid.cell_m)
        far_enough = points[n, 0] ** 2 + points[n, 1] ** 2 >= near_m * near_m
        if 0 <= i < grid.nx and 0 <= j < grid.ny and far_enough:
            z = points[n, 2]
            if z < lowest[i, j]:
                second[i, j] = lowest[i, j]
                lowest[i, j] = z
            elif z < second[i, j]:
                second[i, j] = z
    return second


@bare
def remember_ground(memory: F32, now: F32, step_m: float) -> None:
    """Bring what is seen now into `memory` (nx, ny), changed: quickly where it is lower, slowly where it is higher.

    What is higher by more than `step_m` stands on the ground; what is lower shows that something stood there.
    """
    for i in range(memory.shape[0]):
        for j in range(memory.shape[1]):
            change = now[i, j] - memory[i, j]
            if now[i, j] == np.inf:
                continue
            if memory[i, j] == np.inf:
                memory[i, j] = now[i, j]
            elif change > step_m:
                memory[i, j] += np.float32(0.02) * change
            elif change < -step_m:
                memory[i, j] += np.float32(0.5) * change
            else:
                memory[i, j] += np.float32(0.2) * change


@bare
def _is_pit(memory: F32, i: int, j: int) -> bool:
    """Whether three quarters of the neighbours that are known lie much higher: an echo below the ground."""
    known, higher = 0, 0
    for near in range(9):
        a, b = i + near // 3 - 1, j + near % 3 - 1
        if near != 4 and 0 <= a < memory.shape[0] and 0 <= b < memory.shape[1] and memory[a, b] < np.inf:
            known += 1
            higher += memory[a, b] > memory[i, j] + np.float32(PIT_M)
    return known >= 3 and 4 * higher >= 3 * known


@kernel
def ground_heights(memory: F32, grid: GroundGrid, slope: float, road: F64, road_slope: float, near_m: float) -> F32:
    """(nx, ny) height of the ground everywhere: no higher than what is remembered within `REACH_CELLS` and `slope`.

    `road` (6,): a point of the road under the vehicle and its normal; the ground lies no higher than this plane and
    `road_slope` times the distance, and not lower than `slope` times the distance below (echoes do). Nearer than
    `near_m` no ray reaches the ground: were it steep there, the sensor would see it, so a third of `road_slope` holds.
    """
    plane, distance = np.empty((grid.nx, grid.ny), np.float32), np.empty((grid.nx, grid.ny), np.float32)
    z = np.empty((grid.nx, grid.ny), np.float32)
    for i in range(grid.nx):
        for j in range(grid.ny):
            dx, dy = grid.x0 + (i + 0.5) * grid.cell_m - road[0], grid.y0 + (j + 0.5) * grid.cell_m - road[1]
            distance[i, j] = math.sqrt(dx * dx + dy * dy)
            plane[i, j] = road[2] - (road[3] * dx + road[4] * dy) / road[5]
            low = plane[i, j] - np.float32(slope) * distance[i, j] - np.float32(0.3)
            z[i, j] = memory[i, j] if memory[i, j] > low and not _is_pit(memory, i, j) else np.inf
    for _ in range(REACH_CELLS):
        z = _spread_down(z, np.float32(slope * grid.cell_m))
    unseen = distance < np.float32(near_m)
    return np.minimum(z, plane + np.float32(road_slope) * np.where(unseen, distance / np.float32(3.0), distance))


@kernel
def _spread_down(z: F32, rise: np.float32) -> F32:
    """Each cell no higher than its eight neighbours and what the ground may rise between."""
    nx, ny = z.shape
    corner = np.float32(1.41421356) * rise
    result = z.copy()
    for i in range(1, nx - 1):
        for j in range(1, ny - 1):
            side = min(z[i - 1, j], z[i + 1, j], z[i, j - 1], z[i, j + 1]) + rise
            diagonal = min(z[i - 1, j - 1], z[i + 1, j - 1], z[i - 1, j + 1], z[i + 1, j + 1]) + corner
            result[i, j] = min(z[i, j], side, diagonal)
    return result
