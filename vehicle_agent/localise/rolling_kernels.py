"""Numba kernels of the rolling map: moments of the last scans' points in a dense window, old ones fading.

The window's index holds, for each voxel, a row that is shown (>= 0), -1 where nothing was seen, or -2 - row for a row
that is hidden: it holds too little yet. Registration takes hidden voxels as not known, never as empty.
"""

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.jit import bare, kernel

U64 = NDArray[np.uint64]

SUMS = 10  # weight, x, y, z, xx, xy, xz, yy, yz, zz about the voxel's centre


@kernel
def add_points(
    points: F64, per_m: float, origin: I64, fade: float, now: int, used: int, index: I32, voxel: I32, last: I32,
    mask: U64, sums: F64, touched: I64,
) -> tuple[int, int]:  # fmt: skip
    """Add points (N, 3) of the odometry frame to the rows of their voxels.

    Args:
        points: metres.
        per_m: voxels a metre.
        origin: (3,) voxel coordinates of index[0, 0, 0].
        fade: what a row's old sums count when it is touched the first time in this call.
        now: number of this call; two calls never share one.
        used: rows in use; points that would need a row beyond the room are left out.
        index: (nx, ny, nz).
        voxel: (M, 3) voxel coordinates of each row.
        last: (M,) call that touched the row last.
        mask: (M,) which of 4 x 4 x 4 sub-cells were hit.
        sums: (M, 10).
        touched: (M,) filled with the rows touched.

    Returns:
        rows in use, rows touched.
    """
    n_touched = 0
    for n in range(points.shape[0]):
        g0, g1, g2 = points[n, 0] * per_m, points[n, 1] * per_m, points[n, 2] * per_m
        f0, f1, f2 = np.floor(g0), np.floor(g1), np.floor(g2)
        i0, i1, i2 = int(f0) - origin[0], int(f1) - origin[1], int(f2) - origin[2]
        if not (0 <= i0 < index.shape[0] and 0 <= i1 < index.shape[1] and 0 <= i2 < index.shape[2]):
            continue
        entry = index[i0, i1, i2]
        if entry == -1:
            if used >= voxel.shape[0]:
                continue
            row = used
            used += 1
            index[i0, i1, i2] = -2 - row
            voxel[row, 0], voxel[row, 1], voxel[row, 2] = int(f0), int(f1), int(f2)
            last[row], mask[row], sums[row] = -1, np.uint64(0), 0.0
        else:
            row = entry if entry >= 0 else -2 - entry
        if last[row] != now:
            last[row] = now
            touched[n_touched] = row
            n_touched += 1
            sums[row] *= fade
        x, y, z = g0 - f0, g1 - f1, g2 - f2
        cell = (int(x * 4.0) * 4 + int(y * 4.0)) * 4 + int(z * 4.0)
        mask[row] |= np.uint64(1) << np.uint64(cell)
        x, y, z = (x - 0.5) / per_m, (y - 0.5) / per_m, (z - 0.5) / per_m
        s = sums[row]
        s[0] += 1.0
        s[1] += x
        s[2] += y
        s[3] += z
        s[4] += x * x
        s[5] += x * y
        s[6] += x * z
        s[7] += y * y
        s[8] += y * z
        s[9] += z * z
    return used, n_touched


@bare
def _bits(mask: np.uint64) -> int:
    n = 0
    while mask:
        mask &= mask - np.uint64(1)
        n += 1
    return n


@bare
def refresh(
    rows: I64, per_m: float, origin: I64, min_cells: int, line_ratio: float, upright: float, voxel: I32, mask: U64,
    sums: F64, index: I32, mean: F64, cov: F64,
) -> None:  # fmt: skip
    """Bring mean (M, 3) and, in the order of `rows` (K,), covariance (K, 6) up to date, and show or hide the rows.

    A row is shown when `min_cells` sub-cells were hit and its points do not lie along a line; upright lines (cosine to
    the vertical above `upright`) are posts and are shown. A line has a second variance below `line_ratio` of the
    first; with a third variance of 0 that is m2 / trace² below r / (1 + r)², m2 the sum of the principal 2 x 2 minors.
    """
    limit = line_ratio / (1.0 + line_ratio) ** 2
    for k in range(rows.shape[0]):
        row = rows[k]
        s, w = sums[row], 1.0 / sums[row, 0]
        x, y, z = s[1] * w, s[2] * w, s[3] * w
        xx, xy, xz = s[4] * w - x * x, s[5] * w - x * y, s[6] * w - x * z
        yy, yz, zz = s[7] * w - y * y, s[8] * w - y * z, s[9] * w - z * z
        v = voxel[row]
        mean[row, 0], mean[row, 1], mean[row, 2] = (
            (v[0] + 0.5) / per_m + x,
            (v[1] + 0.5) / per_m + y,
            (v[2] + 0.5) / per_m + z,
        )
        cov[k, 0], cov[k, 1], cov[k, 2], cov[k, 3], cov[k, 4], cov[k, 5] = xx, xy, xz, yy, yz, zz
        trace = xx + yy + zz
        minors = xx * yy - xy * xy + xx * zz - xz * xz + yy * zz - yz * yz
        is_line = minors < limit * trace * trace and zz < upright * upright * trace
        shown = _bits(mask[row]) >= min_cells and not is_line
        index[v[0] - origin[0], v[1] - origin[1], v[2] - origin[2]] = row if shown else -2 - row


@kernel
def move_window(
    origin: I64, new_origin: I64, oldest: int, used: int, index: I32, voxel: I32, last: I32, mask: U64, sums: F64,
    mean: F64, information: F64,
) -> int:  # fmt: skip
    """Lay the window at `new_origin` (3,) and keep, closed up, the rows inside it that were touched since `oldest`;
    gives the rows in use.
    """
    shown = np.empty(used, np.bool_)
    for row in range(used):
        v = voxel[row]
        shown[row] = index[v[0] - origin[0], v[1] - origin[1], v[2] - origin[2]] >= 0
    index[:] = -1
    kept = 0
    for row in range(used):
        i0, i1, i2 = voxel[row, 0] - new_origin[0], voxel[row, 1] - new_origin[1], voxel[row, 2] - new_origin[2]
        inside = 0 <= i0 < index.shape[0] and 0 <= i1 < index.shape[1] and 0 <= i2 < index.shape[2]
        if not inside or last[row] < oldest:
            continue
        voxel[kept], last[kept], mask[kept], sums[kept] = voxel[row], last[row], mask[row], sums[row]
        mean[kept], information[kept] = mean[row], information[row]
        index[i0, i1, i2] = kept if shown[row] else -2 - kept
        kept += 1
    return kept
