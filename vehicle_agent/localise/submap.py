"""Submaps: what the vehicle saw over some 20 m of way, as one point cloud (GND, 6.2: "a single LiDAR measurement
measured from larger areas by summing continuously sequential measurements").

Inside a submap the scans lie as wheels and gyro say, not as the map says: where the world has changed, single matches
are drawn aside, and a submap bent by them could not tell. Only attitude and height, which the odometry does not
measure, are those of the single scans.
"""

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, transform
from vehicle_agent.localise.odometry import MotionBuffer
from vehicle_agent.localise.refine_parameters import RefineParameters
from vehicle_agent.localise.registration import WHEELS_M

F64 = NDArray[np.float64]
F32 = NDArray[np.float32]


@dataclass(frozen=True, slots=True, eq=False)
class ToldByScans:
    """What scans tell of the motion since the scan before: its turn (3, 3), its way (3,), or None where the vehicle's
    own sensors know better; those can still be corrected when more has been learnt about them.
    """

    R_before_now: F64 | None
    t_before_now: F64 | None

    def instead_of(self, T_driven: F64) -> F64:
        """(4, 4) the motion with what the scans know better."""
        R = T_driven[:3, :3] if self.R_before_now is None else self.R_before_now
        return T_from_R_t(R, T_driven[:3, 3] if self.t_before_now is None else self.t_before_now)


@dataclass(frozen=True, slots=True, eq=False)
class SubmapScan:
    """A scan as submaps take it.

    number: of its pose in the track. points_m: (K, 3) float32 sampled points, vehicle frame, sweep motion removed.
    T_map_vehicle: (4, 4) its online pose, of which only attitude and height are used. way_m: odometer. told: what
    scans tell better than wheels and gyro of the motion since the scan before.
    """

    number: int
    t_ns: int
    way_m: float
    points_m: F32
    T_map_vehicle: F64
    told: ToldByScans | None = None


@dataclass(frozen=True, slots=True, eq=False)
class Submap:
    """Points (N, 3) and wheels on the road (M, 3), both float64 in the vehicle frame of the anchor."""

    points_m: F64
    wheels_m: F64


def local_poses(scans: Sequence[SubmapScan], motion: MotionBuffer, *, driven_only: bool = False) -> F64:
    """(N, 4, 4) T_local_vehicle of scans in time order: way and heading by odometry, attitude and height by the single
    scans; the first one's position is the origin, its heading that of its online pose.

    `driven_only`: by wheels and gyro alone, also where scans know better.
    """
    t_ns = np.array([scan.t_ns for scan in scans], np.int64)
    driven = motion.trajectory(int(t_ns[0]), int(t_ns[-1])).at(t_ns)
    steps = T_inverse(driven[:-1]) @ driven[1:]
    for n, scan in enumerate(scans[1:]):
        if scan.told is not None and not driven_only:
            steps[n] = scan.told.instead_of(steps[n])
    T_online = np.stack([scan.T_map_vehicle for scan in scans])
    roll, pitch, yaw = _roll_pitch_yaw(T_online[:, :3, :3])
    heading = yaw[0] + np.concatenate([[0.0], np.cumsum(np.arctan2(steps[:, 1, 0], steps[:, 0, 0]))])
    T = np.tile(np.eye(4), (len(scans), 1, 1))
    T[:, :3, :3] = _rotation(roll, pitch, heading)
    way = np.einsum("nij,nj->ni", T[:-1, :3, :3], steps[:, :3, 3])
    T[1:, :2, 3] = np.cumsum(way[:, :2], axis=0)
    T[:, 2, 3] = T_online[:, 2, 3]
    return T


def make_submap(scans: Sequence[SubmapScan], T_local: F64, anchor: int, parameters: RefineParameters) -> Submap:
    """The submap around `scans[anchor]`, of the scans near it in way and time; `T_local` (N, 4, 4) of `local_poses`."""
    chosen = _near(scans, anchor, parameters)
    T_anchor_scan = T_inverse(T_local[anchor]) @ T_local[chosen]
    points = np.concatenate(
        [transform(T, scans[i].points_m.astype(np.float64)) for i, T in zip(chosen, T_anchor_scan, strict=True)]
    )
    way_m = np.array([scans[i].way_m for i in chosen])
    down = _apart(way_m, parameters.wheel_every_m)
    wheels = np.concatenate([transform(T_anchor_scan[i], WHEELS_M) for i in down])
    return Submap(thinned(points, parameters.leaf_m, parameters.n_points), wheels)


def thinned(points_m: F64, leaf_m: float, n: int) -> F64:
    """The first of the points (N, 3) in each cube of `leaf_m`, and of these at most n, evenly through their order."""
    cubes = np.floor(points_m / leaf_m).astype(np.int64) + (1 << 20)
    key = (cubes[:, 0] << 42) | (cubes[:, 1] << 21) | cubes[:, 2]
    first = np.sort(np.unique(key, return_index=True)[1])
    if len(first) > n:
        first = first[np.linspace(0, len(first) - 1, n).astype(np.int64)]
    return np.asarray(points_m[first])


def _near(scans: Sequence[SubmapScan], anchor: int, par: RefineParameters) -> NDArray[np.int64]:
    """Indices of the scans of the submap, its anchor among them."""
    way_m = np.array([scan.way_m for scan in scans])
    age_s = np.array([scan.t_ns - scans[anchor].t_ns for scan in scans]) * 1e-9
    near = np.flatnonzero((np.abs(way_m - way_m[anchor]) <= par.half_m) & (np.abs(age_s) <= par.half_s))
    if len(near) <= par.max_scans:
        return near
    even = near[np.linspace(0, len(near) - 1, par.max_scans - 1).astype(np.int64)]
    return np.union1d(even, [anchor])


def _apart(way_m: F64, every_m: float) -> list[int]:
    """Indices of the first, and of each that lies `every_m` further than the one before."""
    chosen = [0]
    for i, way in enumerate(way_m):
        if way - way_m[chosen[-1]] >= every_m:
            chosen.append(i)
    return chosen


def _roll_pitch_yaw(R: F64) -> tuple[F64, F64, F64]:
    """Angles (N,) of R = Rz(yaw) Ry(pitch) Rx(roll), R (N, 3, 3)."""
    roll, yaw = np.arctan2(R[:, 2, 1], R[:, 2, 2]), np.arctan2(R[:, 1, 0], R[:, 0, 0])
    return roll, -np.arcsin(np.clip(R[:, 2, 0], -1.0, 1.0)), yaw


def _rotation(roll: F64, pitch: F64, yaw: F64) -> F64:
    """(N, 3, 3) Rz(yaw) Ry(pitch) Rx(roll)."""
    axes = np.eye(3)
    Rx, Ry, Rz = (exp_so3(angle[:, None] * axis) for angle, axis in zip((roll, pitch, yaw), axes, strict=True))
    return np.asarray(Rz @ Ry @ Rx)
