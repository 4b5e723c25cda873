"""When in its sweep a spinning LiDAR measured each point, found from the points themselves.

A sweep that was recorded as it was measured is distorted by the motion of the vehicle: a point is off by the motion
between the sweep's reference time and its own. When a surface is passed, its azimuth changes, and so does the time of
the sweep at which it is measured: seen from two scans it does not lie in one plane. These residuals are linear in the
times, so the *time of each azimuth* follows by least squares, without saying beforehand where the sweep begins and
which way the sensor turns. Only then is a saw tooth laid through the times: its jump is where the sweep begins, its
slope the direction, its height the share of the motion that is in the points: 1 in sweeps as measured, 0 in sweeps
that were freed of it.

Poses of the scans are unknowns as well: those of odometry with distorted sweeps are off by what distortion does.
A constant added to all times moves every pose along the way and is not seen; times count from the middle of the sweep.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray
from scipy.spatial import cKDTree

from gnd.gnd_map.se3 import T_inverse, log_so3, transform
from gnd.vehicle_agent.importers.voxels import covariances_of, voxels_of

F64 = NDArray[np.float64]
I64 = NDArray[np.int64]

VOXEL_M: Final = 1.0
RANGE_M: Final = (4.0, 50.0)
LEAST_POINTS: Final = 12
FLAT_M: Final = 0.06
"""A patch of one scan is a plane when it is no thicker; distortion does not thicken it: its points are of one time."""
WIDE_M: Final = 0.12
BINS: Final = 72
STRIDES: Final = (2, 3, 5, 8, 12)
REACH_M: Final = 0.7
"""Patches of two scans this far apart are one surface; twice the distortion at 20 m/s over an eighth of a turn."""
SAME_NORMAL: Final = 0.9
SCALE_M: Final = 0.08
POSE_SIGMA: Final = (0.01, 0.3)
"""How far poses of odometry with distorted sweeps may be off, in radians and metres."""
NEAR_RAD: Final = np.radians(30.0)
"""Saw teeth that begin farther apart are two answers, nearer ones are one that is not known exactly."""
CORRELATED: Final = 2.0
"""Pairs of the same patches share their errors: one in so many counts. With it the saw tooth of simulated drives fits
to a chi squared of 4 over 69 degrees of freedom, so sigmas are rather too large."""


@dataclass(frozen=True, slots=True, eq=False)
class Patches:
    """M planar pieces of one scan: mean_m (M, 3) and normal (M, 3) in the vehicle frame, azimuth_rad (M,) in the
    LiDAR's.
    """

    mean_m: F64
    normal: F64
    azimuth_rad: F64


@dataclass(frozen=True, slots=True, eq=False)
class AzimuthTimes:
    """Times of azimuth bins, in sweeps, up to a constant.

    tau: (BINS,) of bins that begin at -π. information: (BINS, BINS) of them, poses eliminated.
    """

    tau: F64
    information: F64


@dataclass(frozen=True, slots=True)
class FoundSweep:
    """A saw tooth: where the sweep begins (azimuth, LiDAR frame), which way it turns, and how long it lasts."""

    begin_rad: float
    clockwise: bool

    def share(self, azimuth_rad: F64) -> F64:
        """(N,) share of the sweep, 0 ... 1, that has passed at these azimuths."""
        after = (self.begin_rad - azimuth_rad) if self.clockwise else (azimuth_rad - self.begin_rad)
        return np.asarray(np.mod(after, 2.0 * np.pi) / (2.0 * np.pi))

    @property
    def reversed(self) -> "FoundSweep":
        """The same beginning, turning the other way."""
        return FoundSweep(self.begin_rad, not self.clockwise)


@dataclass(frozen=True, slots=True)
class SweepFit:
    """The saw tooth that fits best.

    begin_sigma_rad: how far its beginning is known. motion: share of the motion that it finds in the points, and one
    sigma of it. rival: how much worse (chi squared) the best saw tooth fits that turns or begins otherwise;
    still: how much worse no distortion at all fits.
    """

    sweep: FoundSweep
    begin_sigma_rad: float
    motion: float
    motion_sigma: float
    rival: float
    still: float


def patches_of(points_lidar_m: NDArray[np.generic], T_vehicle_lidar: F64) -> Patches:
    """Planar pieces of a scan (N, 3), a voxel each."""
    points = np.asarray(points_lidar_m, np.float64)
    horizontal = np.hypot(points[:, 0], points[:, 1])
    points = points[(horizontal > RANGE_M[0]) & (horizontal < RANGE_M[1])]
    voxel, count = voxels_of(points, VOXEL_M)
    mean, cov = covariances_of(points, voxel, count)
    many = count >= LEAST_POINTS
    mean, cov = mean[many], cov[many]
    values, vectors = np.linalg.eigh(cov)
    plane = (values[:, 0] < FLAT_M**2) & (values[:, 1] > WIDE_M**2)
    azimuth = np.arctan2(mean[plane, 1], mean[plane, 0])
    return Patches(transform(T_vehicle_lidar, mean[plane]), vectors[plane, :, 0] @ T_vehicle_lidar[:3, :3].T, azimuth)


def steps_of(t_ns: I64, T: F64, sweep_ns: int) -> F64:
    """(N, 6) motion (turn, way) of the vehicle during a sweep, vehicle frame, from the poses before and after."""
    k = np.arange(len(t_ns))
    before, after = np.maximum(k - 1, 0), np.minimum(k + 1, len(t_ns) - 1)
    step = T_inverse(T[before]) @ T[after]
    per_sweep = sweep_ns / (t_ns[after] - t_ns[before])
    return np.asarray(np.concatenate([log_so3(step[:, :3, :3]), step[:, :3, 3]], axis=1) * per_sweep[:, None])


def pooled(times: Sequence[AzimuthTimes]) -> AzimuthTimes:
    """What several windows of a recording say together."""
    information = np.sum([one.information for one in times], axis=0)
    right = np.sum([one.information @ one.tau for one in times], axis=0)
    return AzimuthTimes(np.linalg.solve(information + 1e-3 * np.eye(BINS), right), information)


def azimuth_times(patches: Sequence[Patches], T: F64, steps: F64, known: F64 | None = None) -> AzimuthTimes:
    """Times of azimuths that lay the patches of N scans into common planes.

    Args:
        patches: of each scan, not deskewed.
        T: (N, 4, 4) poses T_map_vehicle of the scans, roughly.
        steps: (N, 6) motion during each sweep; see `steps_of`.
        known: (BINS,) times that are applied before patches are paired; the result counts from zero all the same.
    """
    before = np.zeros(BINS) if known is None else known
    n, size = len(patches), BINS + 6 * len(patches)
    H, g = np.zeros((size, size)), np.zeros(size)
    for k in range(n):
        for j in (k - stride for stride in STRIDES if stride <= k):
            _add_pair(H, g, _Side(patches[k], T[k], steps[k], k), _Side(patches[j], T[j], steps[j], j), before)
    H[:BINS, :BINS] += 1e-6 * np.eye(BINS)
    sigma = np.repeat(POSE_SIGMA, 3)
    H[BINS:, BINS:] += np.diag(np.tile(sigma**-2.0, n))
    information, right = _without_poses(H, g)
    return AzimuthTimes(np.asarray(np.linalg.solve(information + 1e-3 * np.eye(BINS), right), np.float64), information)


def _without_poses(H: F64, g: F64) -> tuple[F64, F64]:
    mixed = np.linalg.solve(H[BINS:, BINS:], np.column_stack([H[BINS:, :BINS], g[BINS:]]))
    return H[:BINS, :BINS] - H[:BINS, BINS:] @ mixed[:, :-1], g[:BINS] - H[:BINS, BINS:] @ mixed[:, -1]


@dataclass(frozen=True, slots=True, eq=False)
class _Side:
    """One scan of a pair."""

    patches: Patches
    T: F64
    step: F64
    number: int

    @property
    def bins(self) -> I64:
        return bins_of(self.patches.azimuth_rad)

    @property
    def slope(self) -> F64:
        """(M, 3) how far each patch moves, map axes, when its time grows by a sweep."""
        return np.asarray((self.step[3:] + np.cross(self.step[:3], self.patches.mean_m)) @ self.T[:3, :3].T)


def bins_of(azimuth_rad: F64) -> I64:
    """(N,) numbers of the bins of azimuths."""
    return np.asarray(np.floor((azimuth_rad / (2 * np.pi) + 0.5) * BINS).astype(np.int64) % BINS)


def _add_pair(H: F64, g: F64, a: _Side, b: _Side, known: F64) -> None:
    """Normal equations of what two scans say of the same surfaces."""
    slope_a, slope_b = a.slope, b.slope
    at_a = transform(a.T, a.patches.mean_m) + slope_a * known[a.bins][:, None]
    at_b = transform(b.T, b.patches.mean_m) + slope_b * known[b.bins][:, None]
    normal_a, normal_b = a.patches.normal @ a.T[:3, :3].T, b.patches.normal @ b.T[:3, :3].T
    if not len(at_a) or not len(at_b):
        return
    distance, nearest = cKDTree(at_b).query(at_a, distance_upper_bound=REACH_M)
    i = np.flatnonzero(np.isfinite(distance))
    j = nearest[i]
    cosine = (normal_a[i] * normal_b[j]).sum(axis=1)
    i, j, cosine = (each[np.abs(cosine) > SAME_NORMAL] for each in (i, j, cosine))
    normal = normal_a[i] + np.sign(cosine)[:, None] * normal_b[j]
    normal /= np.linalg.norm(normal, axis=1, keepdims=True)
    # residuals count from the points as measured, so that `known` only chooses pairs and their weights
    now = (normal * (at_a[i] - at_b[j])).sum(axis=1)
    gain_a, gain_b = (normal * slope_a[i]).sum(axis=1), (normal * slope_b[j]).sum(axis=1)
    raw = now - gain_a * known[a.bins[i]] + gain_b * known[b.bins[j]]
    weight = 1.0 / (SCALE_M**2 * CORRELATED) / (1.0 + (now / SCALE_M) ** 2) ** 2  # Geman-McClure
    rows = np.zeros((len(i), BINS + 12))
    every = np.arange(len(i))
    np.add.at(rows, (every, a.bins[i]), gain_a)
    np.add.at(rows, (every, b.bins[j]), -gain_b)
    rows[:, BINS:] = np.hstack([_by_pose(a, i, normal), -_by_pose(b, j, normal)])
    local = rows.T @ (weight[:, None] * rows)
    columns = np.r_[0:BINS, BINS + 6 * a.number + np.arange(6), BINS + 6 * b.number + np.arange(6)]
    H[np.ix_(columns, columns)] += local
    g[columns] -= rows.T @ (weight * raw)


def _by_pose(side: _Side, rows: I64, normal: F64) -> F64:
    """(M, 6) how the residual changes with a small turn and shift of the scan, map axes about the vehicle."""
    lever = side.patches.mean_m[rows] @ side.T[:3, :3].T
    return np.hstack([np.cross(lever, normal), normal])


def middle_of_bins_rad() -> F64:
    """(BINS,) azimuths in the middle of the bins."""
    return np.asarray((np.arange(BINS) + 0.5) * (2 * np.pi / BINS) - np.pi, np.float64)


def fit_sweep(times: AzimuthTimes) -> SweepFit:
    """The saw tooth that fits the times of azimuths best, each as good as it is known."""
    middles = middle_of_bins_rad()
    begins = np.arange(BINS) * (2 * np.pi / BINS) - np.pi
    found = [_fit(FoundSweep(float(b), c), times, middles) for b in begins for c in (True, False)]
    cost, _, _, best = min(found, key=lambda one: one[0])
    near = [one for one in found if one[3].clockwise == best.clockwise and _apart(one[3], best) < NEAR_RAD]
    rival = min(one[0] for one in found if one not in near)
    weight = np.exp([0.5 * (cost - one[0]) for one in near])
    pointer = complex((weight @ np.exp([1j * one[3].begin_rad for one in near])) / weight.sum())
    begin_sigma_rad = float(np.sqrt(-2.0 * np.log(max(abs(pointer), 1e-9))))
    _, motion, sigma, sweep = _fit(FoundSweep(float(np.angle(pointer)), best.clockwise), times, middles)
    still = _cost(times, np.zeros(BINS))[0]
    return SweepFit(sweep, begin_sigma_rad, motion, sigma, rival - cost, still - cost)


def _apart(a: FoundSweep, b: FoundSweep) -> float:
    return float(abs(np.angle(np.exp(1j * (a.begin_rad - b.begin_rad)))))


def _cost(times: AzimuthTimes, off: F64) -> tuple[float, F64]:
    """Chi squared of times that are off the measured ones by `off`, the constant chosen best."""
    ones = np.ones(BINS)
    left = times.tau - off
    mean = (ones @ times.information @ left) / max(float(ones @ times.information @ ones), 1e-12)
    left = left - mean
    return float(left @ times.information @ left), left


def _fit(sweep: FoundSweep, times: AzimuthTimes, azimuth_rad: F64) -> tuple[float, float, float, FoundSweep]:
    """Chi squared, height of the saw tooth (positive only), its sigma."""
    tooth = sweep.share(azimuth_rad) - 0.5
    _, tooth = _cost(AzimuthTimes(tooth, times.information), np.zeros(BINS))
    _, tau = _cost(times, np.zeros(BINS))
    information = max(float(tooth @ times.information @ tooth), 1e-12)
    motion = max(0.0, float(tooth @ times.information @ tau) / information)
    return _cost(times, motion * tooth)[0], motion, information**-0.5, sweep
