"""The way of the vehicle without a map: wheels, gyro and each scan on those before it."""

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F32, F64, Array
from gnd.gnd_map.motion import deskew
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.parameters import SamplingParameters
from gnd.vehicle_agent.localise.sampling import sample_scan
from gnd.vehicle_agent.localise.scan_odometry import ScanOdometry, joint_step
from gnd.vehicle_agent.localise.sweep import end_ns, reference_ns

_SAMPLING: Final = SamplingParameters()
RANGE_M: Final = (2.5, 30.0)
"""Nearer points are the vehicle itself; farther ones tell little of the road and much of the heading's error."""

MOST_WAITING: Final = 10
"""Scans that wait for wheels and gyro, which may be silent; older ones are dropped."""

SigmasBetween = Callable[[int, int, F64], F64]
"""(6,) one sigma of a motion (4, 4) by wheels and gyro between two times: rotation [rad] before translation [m]."""


@dataclass(frozen=True, slots=True, eq=False)
class OdometryScan:
    """A scan at its place in the odometry frame, which is that of the vehicle at the first scan.

    Attributes:
        t_ns: reference time.
        T_odom_vehicle: (4, 4).
        way_m: driven since the first scan.
        seen: whether scans gave the step; else wheels and gyro alone.
        points_m, origins_m: (N, 3) ends and starts of its rays in the odometry frame, sweep motion removed.
    """

    t_ns: int
    T_odom_vehicle: F64
    way_m: float
    seen: bool
    points_m: F64
    origins_m: F64


class SurveyOdometry:
    """Feeds on scans in time order; each comes out once the motion to its end is known.

    Args:
        motion: of the wheels and the gyro, with what the localiser has learnt of them; others fill it.
        T_vehicle_lidar: (4, 4) the mount.
        sigmas_between: how well wheels and gyro know a motion.
    """

    def __init__(self, motion: MotionBuffer, T_vehicle_lidar: F64, sigmas_between: SigmasBetween) -> None:
        self._motion, self._mount, self._sigmas_between = motion, T_vehicle_lidar, sigmas_between
        self._scans, self._pending = ScanOdometry(), list[Scan]()
        self._before_ns: int | None = None
        self._T, self._way_m = np.eye(4), 0.0

    def take(self, scan: Scan | None) -> Iterator[OdometryScan]:
        """Take a scan, or None to look whether one that waits can be placed by now."""
        if scan is not None and len(scan):
            self._pending = [*self._pending[-MOST_WAITING + 1 :], scan]
        while self._pending and len(self._motion):
            if self._motion.last_ns < end_ns(self._pending[0]) and len(self._pending) < 2:
                return
            yield self._placed(self._pending.pop(0))

    @property
    def newest_ns(self) -> int | None:
        """Time of the newest scan that was placed."""
        return self._before_ns

    def to_now(self, t_ns: int) -> F64:
        """(4, 4) T_odom_vehicle at a time after the newest scan."""
        if self._before_ns is None:
            return np.eye(4)
        return np.asarray(self._T @ self._motion.delta(self._before_ns, t_ns))

    def _placed(self, scan: Scan) -> OdometryScan:
        t_ns = reference_ns(scan)
        chosen = sample_scan(scan.points_m, _SAMPLING)
        points = self._deskewed(scan, scan.points_m[chosen], scan.t_offset_ns[chosen])
        seen = self._advance(t_ns, points)
        kept = np.flatnonzero(_in_range(scan.points_m))
        offset_ns = scan.t_offset_ns[kept]
        ends = self._deskewed(scan, scan.points_m[kept], offset_ns)
        starts = self._deskewed(scan, np.zeros((len(kept), 3), np.float32), offset_ns)
        R, p = self._T[:3, :3].T, self._T[:3, 3]
        return OdometryScan(t_ns, self._T.copy(), self._way_m, seen, ends @ R + p, starts @ R + p)

    def _advance(self, t_ns: int, points_m: F64) -> bool:
        """Go on to the pose of this scan; whether scans gave the step."""
        if self._before_ns is None or t_ns <= self._before_ns:
            self._before_ns = t_ns
            self._scans.begin(t_ns, points_m)
            return True
        T_driven = self._motion.delta(self._before_ns, t_ns)
        sigmas = self._sigmas_between(self._before_ns, t_ns, T_driven)
        step = self._scans.step(t_ns, points_m, T_driven, sigmas)
        joint = joint_step(T_driven, sigmas, step)
        self._T = self._T @ joint.T_before_now
        self._way_m += float(np.linalg.norm(joint.T_before_now[:3, 3]))
        self._before_ns = t_ns
        return step is not None

    def _deskewed(self, scan: Scan, points_m: F32 | F64, offset_ns: Array) -> F64:
        sweep = self._motion.trajectory(scan.t_ns, max(end_ns(scan), scan.t_ns + 1))
        return deskew(points_m, offset_ns, scan.t_ns, sweep, self._mount, reference_ns(scan))


def _in_range(points_m: F32 | F64) -> NDArray[np.bool_]:
    squared = np.einsum("ij,ij->i", points_m, points_m, dtype=np.float64)
    return np.asarray((squared >= RANGE_M[0] ** 2) & (squared <= RANGE_M[1] ** 2))  # false for NaN, too


def between(T_before: F64, T_now: F64) -> F64:
    """(4, 4) the second pose in the frame of the first."""
    return np.asarray(T_inverse(T_before) @ T_now)
