"""The kernels of `visibility`: voxels laid out tile by tile, column by column, and fans of lines of sight through them.

One array holds the voxels of all tiles near the way, the floors of a column next to each other. A cell is the row of
the Gaussian that stops lines in it, or, where there is none, a negative number: -1 less the rays that have crossed it.
So a line touches one number a voxel. Rays are counted in integers: their sum does not depend on the order.

All lines of a fan share their azimuth, so they cross the same columns: these are found once a fan.
"""

import math
from typing import Any, Final, NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64, I32, I64
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.jit import bare, bare_inlined, kernel

U8 = NDArray[np.uint8]
U64 = NDArray[np.uint64]
NOTHING: Final = -1
"""A voxel in which nothing stops a line, and which none has crossed."""
NO_SLOT: Final = -1
"""A tile of which the map is not at hand: nothing stops a line there, and nothing is counted."""
MOST_RAYS: Final = 1 << 28
"""Counts end here; a line stands for no more."""
FACES: Final = 6
BELOW: Final = 32
"""Floors under a place's own that lines are followed to; above it one less."""
STOP: Final = 9
"""Values of what stops lines: its mean, and the lower triangle that whitens."""
_NEAR_NEW, _NEAR_CHANGED = 1, 8
_GOLDEN: Final = 40503  # of 65536
_ONE, _ALL, _WORD = np.uint64(1), np.uint64(0xFFFF_FFFF_FFFF_FFFF), np.uint64(64)
MOST_COLUMNS: Final = 512  # that one fan crosses
_NEW, _DELETED = int(ChangeClass.NEW), int(ChangeClass.DELETED)


class SightWindow(NamedTuple):
    """Where the voxels of tiles of one (nx, ny) lie. Window coordinates: voxels from its south-west corner, floors from
    sea level.

    Attributes:
        columns: (nx, ny) of a tile.
        metres: (3,) float64 metres a voxel.
        slot_of: (tiles along x, along y) int32 slot of each tile, or NO_SLOT.
        corner: (T, 2) int32 first column and row of the tile in each slot.
        offset: (T + 1,) int64 first cell of each slot, and their number.
        low: (T,) int32 lowest floor of each slot.
        floors: (T,) int32 how many.
        lowest: of all.
    """

    columns: tuple[int, int]
    metres: F64
    slot_of: I32
    corner: I32
    offset: I64
    low: I32
    floors: I32
    lowest: int


@bare
def _cell(w: SightWindow, slot: int, column: int, floor: int) -> int:
    """Cell of a voxel, -1 where no line comes."""
    if not w.low[slot] <= floor < w.low[slot] + w.floors[slot]:
        return -1
    found: int = w.offset[slot] + column * w.floors[slot] + (floor - w.low[slot])
    return found


@bare
def lay_out(
    w: SightWindow, slot: I32, voxel_id: I32, mean_m: F32, cov_m2: F32, ball_m2: float, noise_m2: float,
    state: I32, filled: U64, stop: F32,
) -> None:  # fmt: skip
    """Put what stops lines into its cells.

    Args:
        w: the window.
        slot: (M,) int32 of each voxel.
        voxel_id: (M,) int32.
        mean_m: (N, 3) float32 from the voxel's centre, N <= M: a ball in the middle of the voxel stands for the rest.
        cov_m2: (N, 6) float32.
        ball_m2: variance of a ball.
        noise_m2: added to the variances of the others.
        state: (cells,) int32, changed: the rows.
        filled: (T * nx * ny, words) uint64, changed: of each column a bit for each floor with a row, from the window's
            lowest on.
        stop: (M, STOP) float32, changed: mean in metres, window coordinates, and the inverse of the Cholesky factor of
            the covariance: xx, yx, yy, zx, zy, zz.
    """
    nx, ny = w.columns
    for row in range(len(voxel_id)):
        raised = voxel_id[row] + nx * ny // 2
        floor = raised // (nx * ny)
        column = raised - floor * nx * ny
        cell = _cell(w, slot[row], column, floor)
        if cell < 0:
            continue
        state[cell] = row
        bit = floor - w.lowest
        filled[slot[row] * nx * ny + column, bit // 64] |= _ONE << np.uint64(bit % 64)
        stop[row, 0] = (w.corner[slot[row], 0] + column % nx + 0.5) * w.metres[0]
        stop[row, 1] = (w.corner[slot[row], 1] + column // nx + 0.5) * w.metres[1]
        stop[row, 2] = (floor + 0.5) * w.metres[2]
        if row >= len(mean_m):
            stop[row, 3] = stop[row, 5] = stop[row, 8] = 1.0 / math.sqrt(ball_m2)
            stop[row, 4] = stop[row, 6] = stop[row, 7] = 0.0
            continue
        for axis in range(3):
            stop[row, axis] += mean_m[row, axis]
        a = math.sqrt(cov_m2[row, 0] + noise_m2)
        b, d = cov_m2[row, 1] / a, cov_m2[row, 2] / a
        c = math.sqrt(max(cov_m2[row, 3] + noise_m2 - b * b, noise_m2))
        e = (cov_m2[row, 4] - d * b) / c
        f = math.sqrt(max(cov_m2[row, 5] + noise_m2 - d * d - e * e, noise_m2))
        stop[row, 3], stop[row, 4], stop[row, 5] = 1.0 / a, -b / (a * c), 1.0 / c
        stop[row, 6], stop[row, 7], stop[row, 8] = (b * e - c * d) / (a * c * f), -e / (c * f), 1.0 / f


@bare
def mark(
    w: SightWindow, slot: I32, voxel_id: I32, change_class: U8, state: I32, filled: U64, near: U8, seen: U64
) -> None:
    """What is flagged has been seen; what is gone stops no line; neighbours across a face are told.

    Args:
        w: the window.
        slot: (F,) int32 of each flagged voxel.
        voxel_id: (F,) int32.
        change_class: (F,) uint8.
        state: (cells,) int32, changed.
        filled: as in `lay_out`, changed.
        near: (cells,) uint8, changed: faces behind which something is new, + 8 · faces behind which something is gone
            or modified.
        seen: (T * nx * ny, words) uint64, changed, as `filled`.
    """
    nx, ny = w.columns
    for row in range(len(voxel_id)):
        raised = voxel_id[row] + nx * ny // 2
        floor = raised // (nx * ny)
        column, bit = raised - floor * nx * ny, floor - w.lowest
        cell = _cell(w, slot[row], column, floor)
        if cell >= 0:
            one = _ONE << np.uint64(bit % 64)
            seen[slot[row] * nx * ny + column, bit // 64] |= one
            if change_class[row] == _DELETED:
                state[cell] = NOTHING
                filled[slot[row] * nx * ny + column, bit // 64] &= ~one
        x, y = w.corner[slot[row], 0] + column % nx, w.corner[slot[row], 1] + column // nx
        for face in range(FACES):
            step = 1 - 2 * (face & 1)
            i, j, k = x + step * (face // 2 == 0), y + step * (face // 2 == 1), floor + step * (face // 2 == 2)
            if not (0 <= i < w.slot_of.shape[0] * nx and 0 <= j < w.slot_of.shape[1] * ny):
                continue
            other = w.slot_of[i // nx, j // ny]
            if other != NO_SLOT:
                cell = _cell(w, other, j % ny * nx + i % nx, k)
                if cell >= 0:
                    near[cell] += _NEAR_NEW if change_class[row] == _NEW else _NEAR_CHANGED


@bare_inlined
def _stops(
    stop: F32, row: int, o: tuple[float, float, float], d: tuple[float, float, float],
    t_in: float, t_out: float, r2: float,
) -> bool:  # fmt: skip
    """Whether the line passes Gaussian `row` within `r2` at its most likely point between t_in and t_out."""
    mx, my, mz = stop[row, 0] - o[0], stop[row, 1] - o[1], stop[row, 2] - o[2]
    yx = stop[row, 3] * d[0]
    yy = stop[row, 4] * d[0] + stop[row, 5] * d[1]
    yz = stop[row, 6] * d[0] + stop[row, 7] * d[1] + stop[row, 8] * d[2]
    zx = stop[row, 3] * mx
    zy = stop[row, 4] * mx + stop[row, 5] * my
    zz = stop[row, 6] * mx + stop[row, 7] * my + stop[row, 8] * mz
    t = min(max((yx * zx + yy * zy + yz * zz) / (yx * yx + yy * yy + yz * yz), t_in), t_out)
    ex, ey, ez = t * yx - zx, t * yy - zy, t * yz - zz
    return bool(ex * ex + ey * ey + ez * ez <= r2)


class SightColumns(NamedTuple):
    """Columns of voxels one after the other: room for those that a fan crosses. Floors are counted from BELOW under the
    place's own.

    Attributes:
        base: (C,) int64 number that, added to a floor, is the column's cell there.
        first: (C,) int64 lowest floor of the column.
        end: (C,) int64 the floor above the highest; as `first` where the map is not at hand.
        filled: (C,) uint64 a bit for each floor that holds something that stops lines.
        leave_m: (C,) float64 horizontal distance at which the fan leaves the column.
    """

    base: I64
    first: I64
    end: I64
    filled: U64
    leave_m: F64

    @classmethod
    def room(cls) -> "SightColumns":
        """For the longest fan."""
        n = MOST_COLUMNS
        base, first, end = (np.empty(n, np.int64) for _ in range(3))
        return cls(base, first, end, np.empty(n, np.uint64), np.empty(n))


@bare
def _cross(
    w: SightWindow, filled: U64, x: float, y: float, bottom: int, d: F64, reach_m: float, crossed: SightColumns
) -> int:
    """Fill in the columns that a fan crosses from (x, y) along the unit vector d (2,), from floor `bottom` on; how
    many.
    """
    nx, ny = w.columns
    i, j = math.floor(x), math.floor(y)
    step_x, step_y = (1 if d[0] > 0.0 else -1), (1 if d[1] > 0.0 else -1)
    dt_x = w.metres[0] / abs(d[0]) if d[0] != 0.0 else np.inf
    dt_y = w.metres[1] / abs(d[1]) if d[1] != 0.0 else np.inf
    t_x = (i + 1 - x if step_x > 0 else x - i) * dt_x if d[0] != 0.0 else np.inf
    t_y = (j + 1 - y if step_y > 0 else y - j) * dt_y if d[1] != 0.0 else np.inf
    tile_x, tile_y = i // nx, j // ny
    i, j = i - tile_x * nx, j - tile_y * ny
    word, shift = (bottom - w.lowest) // 64, np.uint64((bottom - w.lowest) % 64)
    n, t = 0, 0.0
    while t < reach_m and n < MOST_COLUMNS:
        if not (0 <= tile_x < w.slot_of.shape[0] and 0 <= tile_y < w.slot_of.shape[1]):
            break
        slot = w.slot_of[tile_x, tile_y]
        crossed.base[n] = crossed.first[n] = crossed.end[n] = 0
        bits = np.uint64(0)
        if slot != NO_SLOT:
            column, low = j * nx + i, w.low[slot] - bottom
            crossed.base[n] = w.offset[slot] + column * w.floors[slot] - low
            crossed.first[n], crossed.end[n] = low, low + w.floors[slot]
            if 0 <= word < filled.shape[1]:
                bits = filled[slot * nx * ny + column, word] >> shift
            if 0 <= word + 1 < filled.shape[1] and shift > 0:
                bits |= filled[slot * nx * ny + column, word + 1] << (_WORD - shift)
        t = min(t_x, t_y)
        crossed.filled[n], crossed.leave_m[n] = bits, t
        n += 1
        if t_x <= t_y:
            t_x += dt_x
            i += step_x
            if i < 0 or i == nx:
                tile_x, i = tile_x + step_x, (0 if step_x > 0 else nx - 1)
        else:
            t_y += dt_y
            j += step_y
            if j < 0 or j == ny:
                tile_y, j = tile_y + step_y, (0 if step_y > 0 else ny - 1)
    return n


@bare
def cast_fans(  # noqa: C901  (one loop, as in the vehicle's ray kernel)
    w: SightWindow, place: F64, turn: F64, rays: I64, azimuth: F64, slope: F64, lines: int, stop: F32, filled: U64,
    r2: float, range_m: float, reach_m: float, level: float, state: I32, hits: I64, columns: SightColumns, ahead: F64,
) -> None:  # fmt: skip
    """From every place a fan of lines along every azimuth; counts into `state` and `hits`.

    The lines of a fan follow every (S / lines)-th of the slopes. Which is the first goes on from fan to fan by the
    golden section, so that all come to be looked along. A line ends where it leaves the 64 floors about its place.

    Args:
        w: the window.
        place: (P, 3) float64 window coordinates, the last in metres of height.
        turn: (P, 2) float64 cosine and sine of the angle by which the azimuths are turned.
        rays: (P,) int64 rays that each line stands for.
        azimuth: (A, 2) float64 horizontal unit vectors, metric.
        slope: (S,) float64 tangents of elevations, shared out as the sensor's rays are.
        lines: of a fan; divides S.
        stop: (M, STOP) float32 of `lay_out`, as is filled.
        filled: (T * nx * ny, words) uint64.
        r2: squared Mahalanobis distance within which a Gaussian stops a line.
        range_m: nothing is counted in columns that a line enters beyond.
        reach_m: lines end there.
        level: a line that nothing stopped counts if the tangent of its elevation, up or down, is smaller.
        state: (cells,) int32, changed: less the rays of lines that crossed a voxel without Gaussian and met something.
        hits: (M,) int64, changed: rays of the lines that each Gaussian stopped.
        columns: room to work in, as is ahead.
        ahead: (2,) float64.
    """
    base, first, end, full, leave_m = columns
    stride, phase = len(slope) // lines, 0
    for p in range(len(place)):
        bottom, ray = math.floor(place[p, 2]) - BELOW, rays[p]
        ox, oy, oz = place[p, 0] * w.metres[0], place[p, 1] * w.metres[1], place[p, 2] - bottom
        o = ox, oy, place[p, 2]
        for a in range(len(azimuth)):
            ahead[0] = turn[p, 0] * azimuth[a, 0] - turn[p, 1] * azimuth[a, 1]
            ahead[1] = turn[p, 1] * azimuth[a, 0] + turn[p, 0] * azimuth[a, 1]
            n_columns = _cross(w, filled, place[p, 0], place[p, 1], bottom, ahead, reach_m, columns)
            phase = (phase + _GOLDEN) & 0xFFFF
            for line in range((phase * stride) >> 16, len(slope), stride):
                s = slope[line]
                d = ahead[0], ahead[1], s
                step, face = (1, 1) if s > 0.0 else (-1, 0)
                length = math.sqrt(1.0 + s * s)
                range_flat, reach_flat = range_m / length, reach_m / length
                # What stops it: column by column to those that hold something on the floors crossed, floor by floor.
                c, k, t_in, stopped = 0, BELOW, 0.0, False
                while c < n_columns and t_in < reach_flat:
                    z = oz + leave_m[c] * s
                    if not 0.0 <= z < 64.0:
                        break
                    k_out = int(z)
                    if full[c] & (_ALL << np.uint64(min(k, k_out))) & (_ALL >> np.uint64(63 - max(k, k_out))) != 0:
                        t = t_in
                        while t < reach_flat:
                            t_out = leave_m[c] if k == k_out else (k + face - oz) / s
                            if (full[c] >> np.uint64(k)) & _ONE != 0:
                                row = state[base[c] + k]
                                stopped = _stops(stop, row, o, d, t, min(t_out, reach_flat), r2)
                                if stopped and t_in <= range_flat:
                                    hits[row] = min(hits[row] + ray, MOST_RAYS)
                            if stopped or k == k_out:
                                break
                            k, t = k + step, t_out
                        if stopped:
                            break
                    k, t_in, c = k_out, leave_m[c], c + 1
                if not stopped and abs(s) >= level:
                    continue
                # What it crossed on the way there.
                last, last_k = (c, k) if stopped else (c - 1, -1)
                k, t_in = BELOW, 0.0
                for n in range(last + 1):
                    if t_in > range_flat:
                        break
                    k_out = last_k if n == last and stopped else int(oz + leave_m[n] * s)
                    while True:
                        if n == last and k == last_k:
                            break
                        if first[n] <= k < end[n]:
                            cell = base[n] + k
                            count = state[cell]
                            if count < 0:
                                state[cell] = max(count - ray, -MOST_RAYS)
                        if k == k_out:
                            break
                        k += step
                    t_in = leave_m[n]


@bare_inlined
def _lowest_bit(bits: int) -> int:
    """Number of the lowest bit that is set."""
    n = 0
    while (bits >> np.uint64(n)) & np.uint64(0xFF) == 0:
        n += 8
    while (bits >> np.uint64(n)) & _ONE == 0:
        n += 1
    return n


@bare_inlined
def _three_bits(padded: U64, j: int, i: int, bit: int) -> Any:
    """The bits below, at and above a floor, of 0 .. 7."""
    word, at = bit // 64, bit % 64
    if at == 0:
        found = (padded[j, i, word] & np.uint64(3)) << _ONE
        if word > 0:
            found |= padded[j, i, word - 1] >> np.uint64(63)
    else:
        found = (padded[j, i, word] >> np.uint64(at - 1)) & np.uint64(7)
        if at == 63 and word + 1 < padded.shape[2]:
            found |= (padded[j, i, word + 1] & _ONE) << np.uint64(2)
    return found


@bare
def _with_border(w: SightWindow, slot: int, bits: U64, padded: U64, base: I64) -> None:
    """Bits of a slot's columns and of those around it.

    Args:
        w: the window.
        slot: which.
        bits: (T * nx * ny, words) uint64.
        padded: (ny + 2, nx + 2, words) uint64, filled.
        base: (ny + 2, nx + 2) int64, filled: number that, added to a bit's, is the cell.
    """
    nx, ny = w.columns
    tile_x, tile_y = w.corner[slot, 0] // nx, w.corner[slot, 1] // ny
    for j in range(-1, ny + 1):
        for i in range(-1, nx + 1):
            u, v = tile_x + (i == nx) - (i < 0), tile_y + (j == ny) - (j < 0)
            padded[j + 1, i + 1] = 0
            if 0 <= u < w.slot_of.shape[0] and 0 <= v < w.slot_of.shape[1] and w.slot_of[u, v] != NO_SLOT:
                other, column = w.slot_of[u, v], (j + ny) % ny * nx + (i + nx) % nx
                base[j + 1, i + 1] = w.offset[other] + column * w.floors[other] - w.low[other] + w.lowest
                for word in range(bits.shape[1]):
                    padded[j + 1, i + 1, word] = bits[other * nx * ny + column, word]


@kernel
def pool(w: SightWindow, filled: U64, state: I32, hits: I64, pooled: I64) -> None:
    """Mean rays that ended at each Gaussian and at those across its faces and edges.

    Few lines stand for the many rays of a sensor, and what is seen of a surface goes on in the next voxel.

    Args:
        w: the window.
        filled: (T * nx * ny, words) uint64 of `lay_out`.
        state: (cells,) int32 of `cast_fans`.
        hits: (M,) int64 of the same.
        pooled: (M,) int64, changed.
    """
    nx, ny = w.columns
    words = filled.shape[1]
    padded, base = np.empty((ny + 2, nx + 2, words), np.uint64), np.empty((ny + 2, nx + 2), np.int64)
    for slot in range(len(w.low)):
        _with_border(w, slot, filled, padded, base)
        for y in range(1, ny + 1):
            for x in range(1, nx + 1):
                for word in range(words):
                    bits = padded[y, x, word]
                    while bits != 0:
                        bit = word * 64 + _lowest_bit(bits)
                        bits &= bits - _ONE
                        total, n = 0, 0
                        for beside in range(9):
                            j, i = y - 1 + beside // 3, x - 1 + beside % 3
                            near = _three_bits(padded, j, i, bit)
                            if beside in (0, 2, 6, 8):
                                near &= np.uint64(2)  # what lies across a corner is no neighbour
                            for k in range(3):
                                if (near >> np.uint64(k)) & _ONE != 0:
                                    total += hits[state[base[j, i] + bit - 1 + k]]
                                    n += 1
                        pooled[state[base[y, x] + bit]] = total // n


@bare
def read_out(w: SightWindow, state: I32, pooled: I64, near: U8, least_hits: I64, least_passes: I64, seen: U64) -> None:
    """Which voxels enough rays have met.

    Args:
        w: the window.
        state: (cells,) int32 of `cast_fans`.
        pooled: (M,) int64 of `pool`.
        near: (cells,) uint8 of `mark`.
        least_hits: (FACES + 1,) int64 rays that must end at a Gaussian, by the faces behind which something is gone or
            modified.
        least_passes: (FACES + 1,) int64 rays that must cross a voxel without, by the faces behind which something is
            new.
        seen: (T * nx * ny, words) uint64, changed: of each column a bit for each floor, as `filled`.
    """
    columns = w.columns[0] * w.columns[1]
    for slot in range(len(w.low)):
        for column in range(columns):
            at, first = w.offset[slot] + column * w.floors[slot], w.low[slot] - w.lowest
            for k in range(w.floors[slot]):
                row = state[at + k]
                if row == NOTHING:
                    continue
                if row >= 0:
                    enough = pooled[row] >= least_hits[near[at + k] >> 3]
                else:
                    enough = -1 - row >= least_passes[near[at + k] & 7]
                if enough:
                    bit = first + k
                    seen[slot * columns + column, bit // 64] |= _ONE << np.uint64(bit % 64)


@kernel
def fill(w: SightWindow, filled: U64, near: U8, seen: U64, more: U64) -> None:
    """Voxels without Gaussian, not next to a flag, that lie between seen ones: at least four of six across faces. Lines
    are fewer than rays and pass them by.

    Args:
        w: the window.
        filled: (T * nx * ny, words) uint64 of `lay_out`.
        near: (cells,) uint8 of `mark`.
        seen: (T * nx * ny, words) uint64 of `read_out`.
        more: (T * nx * ny, words) uint64, changed: those that come.
    """
    nx, ny = w.columns
    words = seen.shape[1]
    padded, base = np.empty((ny + 2, nx + 2, words), np.uint64), np.empty((ny + 2, nx + 2), np.int64)
    for slot in range(len(w.low)):
        _with_border(w, slot, seen, padded, base)
        for y in range(1, ny + 1):
            for x in range(1, nx + 1):
                column = slot * nx * ny + (y - 1) * nx + x - 1
                for word in range(words):
                    own = padded[y, x, word]
                    up, down = own >> _ONE, own << _ONE
                    if word > 0:
                        down |= padded[y, x, word - 1] >> np.uint64(63)
                    if word + 1 < words:
                        up |= padded[y, x, word + 1] << np.uint64(63)
                    # Six bits a floor added up in all floors at once: ones, twos, and whether it comes to four.
                    ones, twos, fours = up ^ down, up & down, np.uint64(0)
                    for face in range(4):
                        step = 1 - 2 * (face & 1)
                        bits = padded[y, x + step, word] if face < 2 else padded[y + step, x, word]
                        carry = ones & bits
                        ones ^= bits
                        fours |= twos & carry
                        twos ^= carry
                    found = fours & ~own & ~filled[column, word]
                    while found != 0:
                        bit = _lowest_bit(found)
                        found &= found - _ONE
                        k = word * 64 + bit + w.lowest - w.low[slot]
                        if 0 <= k < w.floors[slot] and near[base[y, x] + word * 64 + bit] == 0:
                            more[column, word] |= _ONE << np.uint64(bit)


@kernel
def collect(w: SightWindow, seen: U64, found: I32, ends: I64) -> None:
    """Voxel ids of the bits, ascending, slot by slot.

    Args:
        w: the window.
        seen: (T * nx * ny, words) uint64.
        found: (K,) int32, filled.
        ends: (T,) int64, filled: where each slot's ids end in `found`.
    """
    columns = w.columns[0] * w.columns[1]
    starts = np.zeros(64 * seen.shape[1] + 1, np.int64)
    n = 0
    for slot in range(len(w.low)):
        starts[:] = 0
        for column in range(slot * columns, (slot + 1) * columns):
            for word in range(seen.shape[1]):
                bits = seen[column, word]
                while bits != 0:
                    starts[word * 64 + _lowest_bit(bits) + 1] += 1
                    bits &= bits - _ONE
        starts[0] = n
        for floor in range(1, len(starts)):
            starts[floor] += starts[floor - 1]
        n = starts[-1]
        for column in range(columns):
            for word in range(seen.shape[1]):
                bits = seen[slot * columns + column, word]
                while bits != 0:
                    floor = word * 64 + _lowest_bit(bits)
                    bits &= bits - _ONE
                    found[starts[floor]] = (floor + w.lowest) * columns + column - columns // 2
                    starts[floor] += 1
        ends[slot] = n


@bare
def _ones_of(seen: U64) -> int:
    """How many bits are set."""
    n = 0
    for row in range(seen.shape[0]):
        for word in range(seen.shape[1]):
            bits = seen[row, word]
            while bits != 0:
                bits &= bits - _ONE
                n += 1
    return n


def voxel_ids(w: SightWindow, seen: U64) -> tuple[I32, I64]:
    """(K,) voxel ids of the bits, ascending, slot by slot, and (T,) where each slot's end."""
    found, ends = np.empty(_ones_of(seen), np.int32), np.empty(len(w.low), np.int64)
    collect(w, seen, found, ends)
    return found, ends
