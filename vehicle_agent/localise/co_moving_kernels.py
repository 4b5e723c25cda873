"""Range images of single sweeps in the frame of the turning LiDAR, and whether an object in them may travel along."""

import math
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64, I64
from gnd.gnd_map.jit import bare, kernel

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]

COLUMNS: Final = 720
ROWS: Final = 128
TAN_LOW: Final = -0.55
TAN_STEP: Final = 0.0072
CM: Final = 100.0
FAR_CM: Final = 32767
"""Largest range that a pixel can hold; also the mask of its range bits."""
GROUND_BIT: Final = 32768
GROUND_M: Final = 0.3
GROUND_SLOPE: Final = 0.015
"""What lies lower than this in the vehicle frame, and so much more for each metre of distance, is ground."""
ENOUGH_RAYS: Final = 40_000
"""Of a sweep with many more points every third, fifth … is drawn; an odd stride meets every layer."""
SPREAD_S: Final = 0.02
"""A column of a longer time is one where start and end of the sweep meet: it is no evidence."""
LAYERS_ROWS: Final = 6
"""How far above and below the next layer may be: 2.5 degrees."""
MARGIN_M: Final = 0.5
MARGIN_SHARE: Final = 0.015
"""A ray passes a place where it ends farther behind it than this, and this share of the range."""
UNKNOWN, MET, PASSED, HIDDEN = 0, 1, 2, 3
NEAR_M: Final = 1.0
FAR_M: Final = 45.0
"""Points nearer to the LiDAR or farther are not asked about."""
LOW_M: Final = (-0.5, -0.8, 0.3)
HIGH_M: Final = (3.0, 0.8, 1.4)
"""Where the vehicle certainly is, vehicle frame."""
MIN_STAYS: Final = 3
MIN_PASSED: Final = 2
MIN_MET: Final = 2
SETTLED: Final = 3
"""Sweeps that met a point, none against them, after which no other is asked."""
MIN_SEEDS: Final = 6
NEIGHBOUR_M: Final = 0.9
SAME_M: Final = 0.2
SAME_MPS: Final = 0.45
"""What travels along may come nearer or fall back as fast as this."""


@bare
def _column(x: float, y: float) -> int:
    """Column of a direction: its share of a turn measured along a square, which needs no arcus tangent."""
    size = abs(x) + abs(y)
    if size == 0.0:
        return 0
    along = y / size
    if x < 0.0:
        along = 2.0 - along
    elif y < 0.0:
        along += 4.0
    return min(int(along * (COLUMNS / 4.0)), COLUMNS - 1)


@kernel
def draw_sweep(points: F32, offset_ns: NDArray[np.uint32], reference_ns: int, T_vehicle_lidar: F64) -> tuple[U16, F32]:
    """What one sweep saw, ray by ray as they left the LiDAR, not deskewed.

    Args:
        points: (N, 3) float32 LiDAR frame, as measured; what is not finite is left out.
        offset_ns: (N,) uint32 times after the sweep's start.
        reference_ns: the reference time after the sweep's start.
        T_vehicle_lidar: (4, 4) the mount.

    Returns:
        (COLUMNS, ROWS) uint16: nearest range, cm, 0 where no ray went, `GROUND_BIT` set where it met the ground;
        (COLUMNS,) float32: time of each column after the reference time, seconds, NaN where not known.
    """
    image = np.zeros((COLUMNS, ROWS), np.uint16)
    first, last = np.full(COLUMNS, np.float32(np.inf)), np.full(COLUMNS, np.float32(-np.inf))
    up_x, up_y, up_z, up = T_vehicle_lidar[2, 0], T_vehicle_lidar[2, 1], T_vehicle_lidar[2, 2], T_vehicle_lidar[2, 3]
    for n in range(0, len(points), (len(points) // ENOUGH_RAYS) | 1):
        x, y, z = np.float64(points[n, 0]), np.float64(points[n, 1]), np.float64(points[n, 2])
        flat2 = x * x + y * y
        if not 0.25 < flat2 < 1e5:
            continue
        flat = math.sqrt(flat2)
        row = math.floor((z / flat - TAN_LOW) / TAN_STEP)
        if row < 0 or row >= ROWS:
            continue
        column = _column(x, y)
        cm = max(1, min(int(math.sqrt(flat2 + z * z) * CM), FAR_CM))
        seen = int(image[column, row])
        if seen == 0 or cm < (seen & FAR_CM):
            low = up_x * x + up_y * y + up_z * z + up < GROUND_M + GROUND_SLOPE * flat
            image[column, row] = cm | GROUND_BIT if low else cm
        t = np.float32((np.int64(offset_ns[n]) - reference_ns) * 1e-9)
        first[column], last[column] = min(first[column], t), max(last[column], t)
    column_s = np.full(COLUMNS, np.float32(np.nan))
    for column in range(COLUMNS):
        if last[column] - first[column] <= SPREAD_S:
            column_s[column] = 0.5 * (first[column] + last[column])
    return image, column_s


@bare
def _in_sweep(p: F64, column_s: F32, twist: F64, T_lidar_vehicle: F64, out: F64) -> int:
    """Where the LiDAR that turns saw a place `p` (3,) of the vehicle frame at the reference time: `out` (3,), LiDAR
    frame when it looked there; its column, or -1 where that is not known.
    """
    T, x, y, s, column = T_lidar_vehicle, p[0], p[1], 0.0, -1
    for _ in range(2):
        turn = twist[2] * s
        at_x = x - twist[0] * s + turn * y
        at_y = y - twist[1] * s - turn * x
        for a in range(3):
            out[a] = T[a, 0] * at_x + T[a, 1] * at_y + T[a, 2] * p[2] + T[a, 3]
        column = _column(out[0], out[1])
        s = np.float64(column_s[column])
        if math.isnan(s):
            return -1
    return column


@bare
def _verdict(seen: int, range_m: float, below: bool) -> int:
    """Whether a ray ends before a place (`HIDDEN`), at it (`MET`) or well behind it (`PASSED`). Of a layer below the
    place, ground that is not before it shows that nothing stood in between.
    """
    behind_m, margin_m = (seen & FAR_CM) / CM - range_m, MARGIN_M + MARGIN_SHARE * range_m
    if behind_m < -margin_m:
        return HIDDEN
    if behind_m > margin_m or (below and seen & GROUND_BIT):
        return PASSED
    return MET


@bare
def look(image: U16, column: int, row: int, range_m: float) -> int:
    """What the rays around a direction show of a place there: `PASSED` when the next ones above and below, in three
    columns, all end well behind it, `MET` when one ends there, else `UNKNOWN`.
    """
    above, below, hidden = False, False, False
    for step in range(-1, 2):
        c = (column + step) % COLUMNS
        for r in range(row, min(row + LAYERS_ROWS + 1, ROWS)):
            if image[c, r]:
                verdict = _verdict(int(image[c, r]), range_m, False)
                if verdict == MET:
                    return MET
                above, hidden = above or verdict == PASSED, hidden or verdict == HIDDEN
                break
        for r in range(row, max(row - LAYERS_ROWS, 0) - 1, -1):
            if image[c, r]:
                verdict = _verdict(int(image[c, r]), range_m, r < row)
                if verdict == MET:
                    return MET
                below, hidden = below or verdict == PASSED, hidden or verdict == HIDDEN
                break
    return PASSED if above and below and not hidden else UNKNOWN


@bare
def _look_at(p: F64, image: U16, column_s: F32, twist: F64, T_lidar_vehicle: F64, at: F64) -> int:
    """Evidence of a sweep about a place (3,) in its vehicle frame; `at` is room for three numbers."""
    column = _in_sweep(p, column_s, twist, T_lidar_vehicle, at)
    flat = math.hypot(at[0], at[1])
    if column < 0 or flat < 1.0:
        return UNKNOWN
    row = math.floor((at[2] / flat - TAN_LOW) / TAN_STEP)
    if row < 0 or row >= ROWS:
        return UNKNOWN
    return look(image, column, row, math.sqrt(flat * flat + at[2] * at[2]))


@bare
def _nearest(image: U16, column: int, row: int, range_m: float) -> float:
    """The range in the 3 x 3 pixels around a direction that is nearest to `range_m`; infinite where no ray went."""
    best_m = np.inf
    for step in range(-1, 2):
        c = (column + step) % COLUMNS
        for r in range(max(row - 1, 0), min(row + 2, ROWS)):
            seen = int(image[c, r])
            if seen:
                m = (seen & FAR_CM) / CM
                if abs(m - range_m) < abs(best_m - range_m):
                    best_m = m
    return best_m


@bare
def _moved(T: F64, p: F64, out: F64) -> None:
    """`out` (3,) = T (4, 4) applied to p (3,)."""
    for a in range(3):
        out[a] = T[a, 0] * p[0] + T[a, 1] * p[1] + T[a, 2] * p[2] + T[a, 3]


@bare
def _under_the_vehicle(p: F64) -> bool:
    """True where the vehicle itself was: what lies there now was not there then."""
    return bool(LOW_M[0] < p[0] < HIGH_M[0] and LOW_M[1] < p[1] < HIGH_M[1] and LOW_M[2] < p[2] < HIGH_M[2])


@kernel
def compare(
    raw: F32, points: F64, newest: int, then: I64, ages_s: F64, T_now_then: F64, T_then_now: F64,
    images: U16, times_s: F32, twists: F64, T_vehicle_lidar: F64, T_lidar_vehicle: F64,
) -> tuple[U8, U8, U8]:  # fmt: skip
    """Compare points of the newest sweep with L earlier sweeps, at most eight.

    Args:
        raw: (K, 3) float32 points of the newest sweep, LiDAR frame, as measured.
        points: (K, 3) the same in the vehicle frame at its reference time.
        newest: slot of the newest sweep.
        then: (L,) slots of earlier ones, the farthest first: they are the best evidence.
        ages_s: (L,) how long ago they were.
        T_now_then: (L, 4, 4) motion of the vehicle since then.
        T_then_now: (L, 4, 4) and back.
        images: (S, COLUMNS, ROWS) uint16 of `draw_sweep`, by slot.
        times_s: (S, COLUMNS) float32 of `draw_sweep`.
        twists: (S, 3) the vehicle's motion during each sweep: forward and left [m/s], yaw rate [rad/s].
        T_vehicle_lidar: (4, 4) the mount.
        T_lidar_vehicle: (4, 4) its inverse.

    Returns:
        Three (K,) uint8, the number of earlier sweeps in which: something lay at the same place relative to the
        vehicle; of these: it has left that place, or the point's place was free then; or it is still there, or the
        point's place was taken already.
    """
    stays, passed, met = np.zeros(len(raw), np.uint8), np.zeros(len(raw), np.uint8), np.zeros(len(raw), np.uint8)
    lidar, there, at = np.empty(3), np.empty(3), np.empty(3)
    for n in range(len(raw)):
        x, y, z = np.float64(raw[n, 0]), np.float64(raw[n, 1]), np.float64(raw[n, 2])
        flat = math.sqrt(x * x + y * y)
        range_m = math.sqrt(flat * flat + z * z)
        if not range_m < FAR_M or flat < NEAR_M or points[n, 2] < GROUND_M:
            continue
        row, column = math.floor((z / flat - TAN_LOW) / TAN_STEP), _column(x, y)
        if row < 0 or row >= ROWS:
            continue
        for k, slot in enumerate(then):
            seen_m, s = _nearest(images[slot], column, row, range_m), np.float64(times_s[slot, column])
            if not abs(seen_m - range_m) < SAME_M + SAME_MPS * ages_s[k] or math.isnan(s):
                continue
            stays[n] += 1
            share = seen_m / range_m
            lidar[0], lidar[1], lidar[2] = share * x, share * y, share * z
            _moved(T_vehicle_lidar, lidar, at)
            turn = twists[slot, 2] * s
            lidar[0] = at[0] - turn * at[1] + twists[slot, 0] * s
            lidar[1] = at[1] + turn * at[0] + twists[slot, 1] * s
            lidar[2] = at[2]
            _moved(T_now_then[k], lidar, there)  # what lay there then, if it stands
            now = _look_at(there, images[newest], times_s[newest], twists[newest], T_lidar_vehicle, at)
            _moved(T_then_now[k], points[n], there)  # the point then, if it stands
            before = _look_at(there, images[slot], times_s[slot], twists[slot], T_lidar_vehicle, at)
            if now == PASSED or before == PASSED or _under_the_vehicle(there):
                passed[n] += 1
            elif now == MET or before == MET:
                met[n] += 1
            if passed[n] == 0 and met[n] >= SETTLED:
                break
    return stays, passed, met


@kernel
def grown(points: F64, stays: U8, passed: U8, met: U8) -> NDArray[np.bool_]:
    """(K,) bool: points (K, 3) on things that travel along.

    A thing grows from points that were passed (seeds), over neighbours that keep their place too. Points that were met
    and never passed are counted where it touches them, and end it.
    """
    n_points = len(points)
    result, seen = np.zeros(n_points, np.bool_), np.zeros(n_points, np.bool_)
    members, near2 = np.empty(n_points, np.int64), NEIGHBOUR_M * NEIGHBOUR_M
    able = np.flatnonzero(stays >= MIN_STAYS)
    for first in able:
        if seen[first] or not _is_seed(passed[first], met[first]):
            continue
        seen[first], members[0] = True, first
        size, done, seeds, static = 1, 0, 0, 0
        while done < size:
            n = members[done]
            done += 1
            if _is_static(passed[n], met[n]):
                static += 1
                continue
            seeds += _is_seed(passed[n], met[n])
            for m in able:
                if seen[m]:
                    continue
                x, y, z = points[m, 0] - points[n, 0], points[m, 1] - points[n, 1], points[m, 2] - points[n, 2]
                if x * x + y * y + z * z < near2:
                    seen[m], members[size] = True, m
                    size += 1
        for k in range(size):
            n = members[k]
            result[n] = seeds >= MIN_SEEDS and seeds > static and not _is_static(passed[n], met[n])
            # what ends one thing may be touched by the next one
            seen[n] = not _is_static(passed[n], met[n])
    return result


@bare
def _is_seed(passed: int, met: int) -> bool:
    return passed >= MIN_PASSED and met <= passed


@bare
def _is_static(passed: int, met: int) -> bool:
    return passed == 0 and met >= MIN_MET
