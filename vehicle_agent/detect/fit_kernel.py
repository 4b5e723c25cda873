"""How badly single points fit the Gaussians of the map at a pose: what the shift test compares before and after."""

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.jit import bare

UNKNOWN_COST = -1.0
"""Of a point where the map is not known, or at the edge of the window."""


@bare
def point_costs(
    points: F64,
    R: F64,
    t: F64,
    index: NDArray[np.int32],
    A: F64,
    b: F64,
    mean: F64,
    omega: F64,
    scale2: float,
    cost: F64,
) -> None:
    """Fill `cost` (N,) with m² / (s² + m²), 0 ... 1 (Geman-McClure), of the nearest Gaussian of each point's voxel and
    its six face neighbours; 1 where there is none, `UNKNOWN_COST` where the map is not known.

    Args:
        points: (N, 3), any frame.
        R: (3, 3), with t the pose of that frame in the map frame.
        t: (3,).
        index: (nx, ny, nz) int32: a row of `mean` and `omega`, -1 empty, below -1 unknown.
        A: (3, 3); window coordinates of a map point q are A q + b.
        b: (3,).
        mean: (M, 3) in the map frame.
        omega: (M, 6) information matrices xx,xy,xz,yy,yz,zz, 1/m².
        scale2: s², in squared sigmas.
        cost: (N,), filled.
    """
    nx, ny, nz = index.shape
    for n in range(points.shape[0]):
        p0, p1, p2 = points[n, 0], points[n, 1], points[n, 2]
        q0 = R[0, 0] * p0 + R[0, 1] * p1 + R[0, 2] * p2 + t[0]
        q1 = R[1, 0] * p0 + R[1, 1] * p1 + R[1, 2] * p2 + t[1]
        q2 = R[2, 0] * p0 + R[2, 1] * p1 + R[2, 2] * p2 + t[2]
        gx = A[0, 0] * q0 + A[0, 1] * q1 + A[0, 2] * q2 + b[0]
        gy = A[1, 0] * q0 + A[1, 1] * q1 + A[1, 2] * q2 + b[1]
        gz = A[2, 0] * q0 + A[2, 1] * q1 + A[2, 2] * q2 + b[2]
        cost[n] = UNKNOWN_COST
        if not (1.0 <= gx < nx - 1 and 1.0 <= gy < ny - 1 and 1.0 <= gz < nz - 1):
            continue
        ix, iy, iz = int(gx), int(gy), int(gz)
        if index[ix, iy, iz] < -1:
            continue
        best = np.inf
        for k in range(7):
            jx, jy, jz = ix, iy, iz
            step = 1 if k & 1 else -1
            if 1 <= k <= 2:
                jx += step
            elif 3 <= k <= 4:
                jy += step
            elif k >= 5:
                jz += step
            row = index[jx, jy, jz]
            if row >= 0:
                d0, d1, d2 = q0 - mean[row, 0], q1 - mean[row, 1], q2 - mean[row, 2]
                o = omega[row]
                mixed = o[1] * d0 * d1 + o[2] * d0 * d2 + o[4] * d1 * d2
                best = min(best, o[0] * d0 * d0 + o[3] * d1 * d1 + o[5] * d2 * d2 + 2.0 * mixed)
        cost[n] = best / (scale2 + best) if best < np.inf else 1.0
