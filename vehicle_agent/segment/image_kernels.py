"""Range images of motion segmentation, and the votes of one scan on the points of another."""

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64, I32
from gnd.gnd_map.jit import bare, kernel
from gnd.vehicle_agent.segment.voxel_kernels import GROUND, LOW

U16 = NDArray[np.uint16]
U8 = NDArray[np.uint8]

CM = 100.0
FAR_CM = 32767
"""Largest range that a cell can hold; also the mask of its range bits."""
GROUND_BIT = 32768
BINS = 180
"""Of azimuth, for the place of the moving sensor."""


class Optics(NamedTuple):
    """A range image's scale: columns of azimuth, rows of the tangent of elevation."""

    columns: int
    rows: int
    tan_low: float
    tan_step: float


class RangeJudge(NamedTuple):
    """What a vote needs of the parameters."""

    reach_across_m: float
    reach_up_m: float
    margin_m: float
    margin_share: float
    gap_tan: float
    enough: int
    """Weight of "static" votes, none against them, after which a point is asked about no more."""


@bare
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


@bare
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
        voxel_of: (N,) int32 of `find_objects`; marks the ground.
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


@bare
def _look(
    image: U16, column: int, across: int, low: int, high: int, near_cm: float, far_cm: float
) -> tuple[bool, bool, bool]:
    """Whether rays of a window of rows `low` to `high` go beyond `far_cm`, end before `near_cm`, end between.

    Ground between the two counts as beyond: it lies below what is looked for, and can be seen.
    """
    beyond, nearer, same = False, False, False
    columns, rows = image.shape
    for c in range(column - across, column + across + 1):
        at = c + columns if c < 0 else (c - columns if c >= columns else c)  # a division would cost as much as a cell
        for q in range(max(0, low), min(rows, high + 1)):
            seen = int(image[at, q])
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


@bare
def vote(  # noqa: C901  (one loop over the window)
    points: F32,
    offset_m: F64,
    image: U16,
    places: F32,
    R: F64,
    optics: Optics,
    judge: RangeJudge,
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
        weight: weight of a return at the same place.
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
