"""A light witness of the pose: how a scan's rays agree with the map, and how that is spread around the vehicle.

Three things are counted by sector: standing points that lie on a Gaussian (hits), standing points that lie far from
every Gaussian where the map is known (new), and Gaussians that rays passed well before they ended (gone). A stale map
shows new and gone in some places and hits in the rest; a wrong pose takes the hits away all around.
"""

from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64, I32, I64
from gnd.gnd_map.jit import bare, kernel
from gnd.vehicle_agent.localise.initialise import STANDING_ABOVE_M
from gnd.vehicle_agent.localise.match_map import MatchMap

_N_RAYS: Final = 600
"""Asked at a time, every `period_s` or `way_m`."""
_SECTORS: Final = 12
"""Around the vehicle, counted with `least_points`."""
_LEAST_POINTS: Final = 8
_HIT_SIGMAS: Final = 3.0
_FAR_SIGMAS: Final = 8.0
"""A point nearer than the one to a Gaussian is a hit, farther than the other from all is new."""
_BEHIND_M: Final = 1.0
"""A Gaussian is gone when a ray went on for so long behind it."""
_LEAST_ALONG_PER_M2: Final = 50.0
"""Least information of the Gaussian along the ray, so that grazing rays do not count."""
_MAX_WAY_M: Final = 60.0
"""A ray is followed no farther than this."""

KNOWN, HIT, NEW, CROSSED, GONE = range(5)  # columns of the counts


@dataclass(frozen=True, slots=True, eq=False)
class Testimony:
    """Evidence of one scan's rays.

    counts: (sectors, 5) int64: standing points in known voxels, of these on a Gaussian, of these far from every one;
    Gaussians that rays met or crossed, of these crossed well before the ray's end. Sector 0 begins straight ahead,
    counted counter-clockwise. standing, known: standing points in all, and in known voxels.
    """

    counts: I64
    standing: int
    least_points: int

    @property
    def known(self) -> int:
        """Standing points in known voxels."""
        return int(self.counts[:, KNOWN].sum())

    @property
    def hit_share(self) -> float:
        """Of the standing points in known voxels, those that lie on a Gaussian; 0 without any."""
        return _share(self.counts, HIT, KNOWN)

    @property
    def new_share(self) -> float:
        """Of the same points, those far from every Gaussian."""
        return _share(self.counts, NEW, KNOWN)

    @property
    def gone_share(self) -> float:
        """Of the Gaussians that rays met, those that rays went through."""
        return _share(self.counts, GONE, CROSSED)

    @property
    def sector_hits(self) -> F64:
        """(K,) share of hits of each sector that has enough points."""
        full = self.counts[self.counts[:, KNOWN] >= self.least_points]
        return np.asarray(full[:, HIT] / full[:, KNOWN])

    @property
    def best_hits(self) -> float:
        """Share of hits in the better half of the sectors: stays high where only some places have changed."""
        hits = np.sort(self.sector_hits)
        return float(hits[len(hits) // 2 :].mean()) if len(hits) else 0.0


def _share(counts: I64, part: int, whole: int) -> float:
    return float(counts[:, part].sum() / max(int(counts[:, whole].sum()), 1))


def witnessed(
    points_m: F64, origin_m: F64, ground_below_m: float, T_map_vehicle: F64, match_map: MatchMap,
) -> Testimony:  # fmt: skip
    """Ask a sample of the scan's rays.

    Args:
        points_m: (N, 3) ends of rays, vehicle frame, sweep motion removed.
        origin_m: (3,) the sensor in the vehicle frame.
        ground_below_m: height of the ground in the vehicle frame.
        T_map_vehicle: (4, 4) the pose to judge.
        match_map: the map window.
        parameters: of the witness.
    """
    m = match_map
    points = np.ascontiguousarray(points_m[:: max(1, len(points_m) // _N_RAYS)], dtype=np.float64)
    standing = points[:, 2] > ground_below_m + STANDING_ABOVE_M
    counts = np.zeros((_SECTORS, 5), np.int64)
    R, t = np.ascontiguousarray(T_map_vehicle[:3, :3]), np.ascontiguousarray(T_map_vehicle[:3, 3])
    limits = np.array([_HIT_SIGMAS**2, _FAR_SIGMAS**2, _BEHIND_M, _LEAST_ALONG_PER_M2, _MAX_WAY_M])
    ask_rays(points, standing, origin_m, R, t, m.index, m.A, m.b, m.mean_m, m.information, limits, counts)
    return Testimony(counts, int(standing.sum()), _LEAST_POINTS)


@bare
def _mahalanobis2(o: F64, d0: float, d1: float, d2: float) -> float:
    """Squared distance d' Omega d with Omega as upper triangle (6,)."""
    mixed = o[1] * d0 * d1 + o[2] * d0 * d2 + o[4] * d1 * d2
    return float(o[0] * d0 * d0 + o[3] * d1 * d1 + o[5] * d2 * d2 + 2.0 * mixed)


@bare
def _nearest2(q: F64, ix: int, iy: int, iz: int, index: I32, mean: F64, omega: F64) -> float:
    """Least squared Mahalanobis distance to a Gaussian of the 27 voxels around, 1e9 if there is none."""
    best = 1e9
    for jx in range(ix - 1, ix + 2):
        for jy in range(iy - 1, iy + 2):
            for jz in range(iz - 1, iz + 2):
                row = index[jx, jy, jz]
                if row >= 0:
                    d0, d1, d2 = q[0] - mean[row, 0], q[1] - mean[row, 1], q[2] - mean[row, 2]
                    if d0 * d0 + d1 * d1 + d2 * d2 <= 1.0:  # its information is that of its own voxel's surface
                        best = min(best, _mahalanobis2(omega[row], d0, d1, d2))
    return best


@bare
def _crossing(o: F64, u: F64, mean: F64, omega: F64, least: float) -> float:
    """Way along the ray from `o` (3,) in direction `u` (3,) to where it is nearest to a Gaussian in its own measure, if
    the ray goes through it rather than along it (information along the ray at least `least`), else -1.
    """
    along = _mahalanobis2(omega, u[0], u[1], u[2])
    if along < least:
        return -1.0
    d0, d1, d2 = mean[0] - o[0], mean[1] - o[1], mean[2] - o[2]
    s = (
        u[0] * (omega[0] * d0 + omega[1] * d1 + omega[2] * d2)
        + u[1] * (omega[1] * d0 + omega[3] * d1 + omega[4] * d2)
        + u[2] * (omega[2] * d0 + omega[4] * d1 + omega[5] * d2)
    ) / along
    e0, e1, e2 = u[0] * s - d0, u[1] * s - d1, u[2] * s - d2
    return s if _mahalanobis2(omega, e0, e1, e2) < 1.0 else -1.0


@bare
def _walk(
    o: F64, u: F64, way_m: float, behind_m: float, least: float, index: I32, A: F64, b: F64, mean: F64, omega: F64,
    count: I64,
) -> None:  # fmt: skip
    """Count the Gaussians that a ray of length `way_m` meets, in `count[CROSSED]`, and those that it has passed by more
    than `behind_m`, in `count[GONE]`; steps of 0.5 m, a voxel is looked at once.
    """
    nx, ny, nz = index.shape
    last = -1
    for k in range(int(way_m / 0.5) + 1):
        s = k * 0.5
        p0, p1, p2 = o[0] + s * u[0], o[1] + s * u[1], o[2] + s * u[2]
        ix = int(np.floor(A[0, 0] * p0 + A[0, 1] * p1 + A[0, 2] * p2 + b[0]))
        iy = int(np.floor(A[1, 0] * p0 + A[1, 1] * p1 + A[1, 2] * p2 + b[1]))
        iz = int(np.floor(A[2, 0] * p0 + A[2, 1] * p1 + A[2, 2] * p2 + b[2]))
        if not (0 <= ix < nx and 0 <= iy < ny and 0 <= iz < nz):
            continue
        row = index[ix, iy, iz]
        if row < 0 or row == last:
            continue
        last = row
        at = _crossing(o, u, mean[row], omega[row], least)
        if at < 0.0 or abs(at - s) > 1.0:
            continue
        count[CROSSED] += 1
        if at < way_m - behind_m:
            count[GONE] += 1


@kernel
def ask_rays(
    points: F64, standing: NDArray[np.bool_], origin: F64, R: F64, t: F64, index: I32, A: F64, b: F64, mean: F64,
    omega: F64, limits: F64, counts: I64,
) -> None:  # fmt: skip
    """Fill `counts` (sectors, 5), see `Testimony`.

    `points` (N, 3) and `origin` (3,) in the vehicle frame, `R`, `t` the pose, the map as in `linearise`; `limits` (5,):
    squared Mahalanobis distance of a hit, of being far, way behind a Gaussian [m], least information along a ray
    [1/m²], how much of a ray is followed from its end [m].
    """
    nx, ny, nz = index.shape
    sectors = counts.shape[0]
    o, u, q = np.empty(3), np.empty(3), np.empty(3)
    for i in range(3):
        o[i] = R[i, 0] * origin[0] + R[i, 1] * origin[1] + R[i, 2] * origin[2] + t[i]
    for n in range(points.shape[0]):
        for i in range(3):
            q[i] = R[i, 0] * points[n, 0] + R[i, 1] * points[n, 1] + R[i, 2] * points[n, 2] + t[i]
        ix = int(np.floor(A[0, 0] * q[0] + A[0, 1] * q[1] + A[0, 2] * q[2] + b[0]))
        iy = int(np.floor(A[1, 0] * q[0] + A[1, 1] * q[1] + A[1, 2] * q[2] + b[1]))
        iz = int(np.floor(A[2, 0] * q[0] + A[2, 1] * q[1] + A[2, 2] * q[2] + b[2]))
        if not (1 <= ix < nx - 1 and 1 <= iy < ny - 1 and 1 <= iz < nz - 1) or index[ix, iy, iz] < -1:
            continue
        angle = np.arctan2(points[n, 1], points[n, 0]) / (2.0 * np.pi)
        count = counts[int((angle - np.floor(angle)) * sectors) % sectors]
        if standing[n]:
            m2 = _nearest2(q, ix, iy, iz, index, mean, omega)
            count[KNOWN] += 1
            if m2 < limits[0]:
                count[HIT] += 1
            elif m2 > limits[1]:
                count[NEW] += 1
        way = np.sqrt((q[0] - o[0]) ** 2 + (q[1] - o[1]) ** 2 + (q[2] - o[2]) ** 2)
        if way < 1.0:
            continue
        for i in range(3):
            u[i] = (q[i] - o[i]) / way
        _walk(o, u, min(way, limits[4]), limits[2], limits[3], index, A, b, mean, omega, count)
