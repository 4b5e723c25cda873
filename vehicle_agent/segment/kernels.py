"""The kernels of motion segmentation: ground, voxels, range images, rays that pass, components.

Points are float32 relative to their scan's centre (mean position of the sensor), map axes, so z is up. One file: numba
notices changes of a kernel's own module only.
"""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd_map.arrays import F32, F64, I32
from gnd_map.jit import kernel

I64 = NDArray[np.int64]
U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]

CM = 100.0
FAR_CM = 32767
"""Largest range that a cell can hold; also the mask of its range bits."""
GROUND_BIT = 32768
BINS = 180
"""Of azimuth, for the place of the moving sensor."""
PIT_M = 0.3
REACH_CELLS = 5
"""How far the ground is carried on where something stands on it."""
GROUND, LOW, OUTSIDE = -1, -2, -3
"""What a point is that belongs to no voxel; low points lie between ground and objects."""
_LIMIT = 1 << 20
_HASH = np.uint64(0x9E3779B97F4A7C15)


class Grid(NamedTuple):
    """Squares of the ground, corner at (x0, y0)."""

    x0: float
    y0: float
    cell_m: float
    nx: int
    ny: int


class Optics(NamedTuple):
    """A range image's scale: columns of azimuth, rows of the tangent of elevation."""

    columns: int
    rows: int
    tan_low: float
    tan_step: float


class Judge(NamedTuple):
    """What a vote needs of the parameters."""

    reach_across_m: float
    reach_up_m: float
    margin_m: float
    margin_share: float
    gap_tan: float
    enough: int
    """Weight of "static" votes, none against them, after which a point is asked about no more."""


@kernel
def _turn(y: float, x: float) -> float:
    """atan2(y, x) as a share of a full turn, 0 ... 1, to 1e-6 (Hastings' polynomial of degree 11)."""
    a, b = abs(x), abs(y)
    high, low = max(a, b), min(a, b)
    q = low / high if high > 0.0 else 0.0
    s = q * q
    angle = (
        ((((-0.0117212 * s + 0.05265332) * s - 0.11643287) * s + 0.19354346) * s - 0.33262347) * s + 0.99997726
    ) * q
    if b > a:
        angle = 0.5 * math.pi - angle
    if x < 0.0:
        angle = math.pi - angle
    if y < 0.0:
        angle = -angle
    turn = angle / (2.0 * math.pi)
    return turn + 1.0 if turn < 0.0 else turn


# --- ground ---------------------------------------------------------------------------------------------------------


@kernel
def lowest_heights(points: F32, grid: Grid, near_m: float) -> F32:
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


@kernel
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


@kernel
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
def ground_heights(memory: F32, grid: Grid, slope: float, road: F64, road_slope: float, near_m: float) -> F32:
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


# --- voxels ---------------------------------------------------------------------------------------------------------


@kernel
def _key(i: int, j: int, k: int) -> int:
    return ((i + _LIMIT) << 42) | ((j + _LIMIT) << 21) | (k + _LIMIT)


@kernel
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
    points: F32, origins: F32, ground: F32, grid: Grid, ground_m: float, feet_m: float, voxel_m: float,
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


# --- range images -----------------------------------------------------------------------------------------------------


@kernel
def elevation_span(points: F32, origins: F32, R: F64) -> tuple[float, float]:
    """Lowest and highest tangent of elevation of the rays."""
    low, high = np.inf, -np.inf
    for n in range(len(points)):
        x, y, z = points[n, 0] - origins[n, 0], points[n, 1] - origins[n, 1], points[n, 2] - origins[n, 2]
        u, v = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z, R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        t = (R[2, 0] * x + R[2, 1] * y + R[2, 2] * z) / (math.sqrt(u * u + v * v) + 1e-9)
        if abs(t) < 1.5:
            low, high = min(low, t), max(high, t)
    return low, high


@kernel
def draw_image(points: F32, origins: F32, voxel_of: I32, R: F64, optics: Optics, spread_m: float) -> tuple[U16, F32]:
    """The range image of a scan.

    Args:
        points: (N, 3) float32 ends of the rays.
        origins: (N, 3) float32 their starts.
        voxel_of: (N,) int32 of `find_objects`; tells the ground.
        R: (3, 3) map axes to the sensor's.
        optics: the image's scale.
        spread_m: a bin of azimuth where the sensor moved farther (start and end of a sweep meet) gets no origin.

    Returns:
        (columns, rows) uint16: nearest range, cm, 0 where no ray went, `GROUND_BIT` set where it met the ground;
        (BINS, 3) float32: the sensor's place by azimuth, NaN where not known.
    """
    image = np.zeros((optics.columns, optics.rows), np.uint16)
    total, count = np.zeros((BINS, 3)), np.zeros(BINS, np.int64)
    low, high = np.full((BINS, 3), np.inf), np.full((BINS, 3), -np.inf)
    for n in range(len(points)):
        ox, oy, oz = origins[n, 0], origins[n, 1], origins[n, 2]
        x, y, z = points[n, 0] - ox, points[n, 1] - oy, points[n, 2] - oz
        u, v = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z, R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        w = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        flat = math.sqrt(u * u + v * v)
        row = math.floor((w / (flat + 1e-9) - optics.tan_low) / optics.tan_step)
        if row < 0 or row >= optics.rows:
            continue
        turn = _turn(v, u)
        column, bin_ = min(int(turn * optics.columns), optics.columns - 1), min(int(turn * BINS), BINS - 1)
        cm = max(1, min(int(math.sqrt(flat * flat + w * w) * CM), FAR_CM))
        seen = int(image[column, row])
        if seen == 0 or cm < (seen & FAR_CM):
            image[column, row] = cm | GROUND_BIT if voxel_of[n] == GROUND or voxel_of[n] == LOW else cm
        count[bin_] += 1
        for a, o in enumerate((ox, oy, oz)):
            total[bin_, a] += o
            low[bin_, a], high[bin_, a] = min(low[bin_, a], o), max(high[bin_, a], o)
    places = np.full((BINS, 3), np.float32(np.nan))
    for b in range(BINS):
        if count[b] and np.max(high[b] - low[b]) <= spread_m:
            places[b] = total[b] / count[b]
    return image, places


@kernel
def layer_gap(image: U16, share: float) -> int:
    """Rows from one ray to the next above it in the same column, not exceeded in `share` of the cases."""
    columns, rows = image.shape
    count = np.zeros(rows + 1, np.int64)
    for column in range(columns):
        before = -1
        for row in range(rows):
            if image[column, row]:
                if before >= 0:
                    count[row - before] += 1
                before = row
    total, gap = count.sum() * share, 0
    so_far = 0
    while gap < rows and so_far < total:
        gap += 1
        so_far += count[gap]
    return max(gap, 1)


@kernel
def _look(
    image: U16, column: int, across: int, low: int, high: int, near_cm: float, far_cm: float
) -> tuple[bool, bool, bool]:
    """Whether rays of a window of rows `low` to `high` go beyond `far_cm`, end before `near_cm`, end between.

    Ground between the two counts as beyond: it lies below what is looked for, and can be seen.
    """
    beyond, nearer, same = False, False, False
    columns, rows = image.shape
    for c in range(column - across, column + across + 1):
        for q in range(max(0, low), min(rows, high + 1)):
            seen = int(image[c % columns, q])
            if seen == 0:
                continue
            cm = seen & FAR_CM
            if cm > far_cm:
                beyond = True
            elif seen & GROUND_BIT:
                beyond = beyond or cm >= near_cm
            elif cm < near_cm:
                nearer = True
            else:
                return beyond, nearer, True
    return beyond, nearer, same


@kernel
def vote(  # noqa: C901  (one loop over the window)
    points: F32,
    offset_m: F64,
    image: U16,
    places: F32,
    R: F64,
    optics: Optics,
    judge: Judge,
    weight: int,
    passed: U8,
    met: U8,
) -> None:
    """Let one scan vote on points of another: `passed` or `met` of a point goes up, or neither.

    Args:
        points: (V, 3) float32 relative to their own scan's centre.
        offset_m: (3,) that centre relative to the centre of the image's scan.
        image: ranges of the voting scan.
        places: its sensor by azimuth.
        R: (3, 3) map axes to its sensor's.
        optics: its scale.
        judge: distances that decide.
        weight: how much a return at the same place says.
        passed: (V,) uint8, changed: number of votes for "moving".
        met: (V,) uint8, changed: weights of the votes for "static".
    """
    column_rad = 2.0 * math.pi / optics.columns
    for n in range(len(points)):
        if passed[n] == 0 and met[n] >= judge.enough:
            continue
        x, y, z = points[n, 0] + offset_m[0], points[n, 1] + offset_m[1], points[n, 2] + offset_m[2]
        u, v = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z, R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        place = places[min(int(_turn(v, u) * BINS), BINS - 1)]
        if math.isnan(place[0]):
            continue
        x, y, z = x - place[0], y - place[1], z - place[2]
        u, v = R[0, 0] * x + R[0, 1] * y + R[0, 2] * z, R[1, 0] * x + R[1, 1] * y + R[1, 2] * z
        w = R[2, 0] * x + R[2, 1] * y + R[2, 2] * z
        flat = math.sqrt(u * u + v * v)
        r = math.sqrt(flat * flat + w * w)
        if r < 1.0:
            continue
        row = math.floor((w / flat - optics.tan_low) / optics.tan_step)
        column = min(int(_turn(v, u) * optics.columns), optics.columns - 1)
        across = min(6, max(1, math.ceil(judge.reach_across_m / (flat * column_rad))))
        up = min(16, max(1, math.ceil(judge.reach_up_m / (flat * optics.tan_step))))
        extended = min(16, max(up, math.ceil(judge.gap_tan / optics.tan_step)))
        margin_cm = CM * (judge.margin_m + judge.margin_share * r)
        near_cm, far_cm = CM * r - margin_cm, CM * r + margin_cm
        if 0 <= row < optics.rows:
            seen = int(image[column, row])
            if seen < GROUND_BIT and near_cm <= seen <= far_cm:  # most often: it stands there
                met[n] = min(255, met[n] + weight)
                continue
        above, nearer, same = _look(image, column, across, row, row + up, near_cm, far_cm)
        below, nearer_below, same_below = _look(image, column, across, row - up, row - 1, near_cm, far_cm)
        if same or same_below:
            met[n] = min(255, met[n] + weight)
            continue
        if nearer or nearer_below:
            continue
        if not above or not below:
            exact, _, _ = _look(image, column, across, row, row, near_cm, far_cm)
            above, below = above or exact, below or exact
        for q in range(row + up + 1, row + extended + 1):
            if above or nearer or same:
                break
            above, nearer, same = _look(image, column, across, q, q, near_cm, far_cm)
        for q in range(row - up - 1, row - extended - 1, -1):
            if below or nearer_below or same_below:
                break
            below, nearer_below, same_below = _look(image, column, across, q, q, near_cm, far_cm)
        if above and below:
            passed[n] = min(255, passed[n] + 1)


# --- objects ----------------------------------------------------------------------------------------------------------


@kernel
def _root(parent: I32, n: int) -> int:
    while parent[n] != n:
        parent[n] = parent[parent[n]]
        n = parent[n]
    return n


@kernel
def _join(parent: I32, a: int, b: int) -> None:
    """The root with the smaller number stays."""
    a, b = _root(parent, a), _root(parent, b)
    if a != b:
        parent[max(a, b)] = min(a, b)


@kernel
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
