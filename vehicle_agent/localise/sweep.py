"""A sweep of the LiDAR: its points at one time, and what the motion that is left in them does to a pose."""

from collections.abc import Callable
from dataclasses import dataclass
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import Scan
from gnd.schemas.sweep_distortion import DistortionSigma
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.remount import Mounting
from gnd.vehicle_agent.localise.scan_odometry import ScanStep
from gnd.vehicle_agent.localise.stretch import log_se3

Distortion = Callable[[float, float], DistortionSigma]
"""Sigma of a pose from speed [m/s] and yaw rate [rad/s], by the motion that is left in the points of a sweep."""

POSE_SHARE: Final = 0.25
"""A pose moves by this share of what distortion moves a point by: points all around hold it."""
SURE: Final = np.zeros(3)
_SWEPT_NS: Final = 100_000_000


@dataclass(frozen=True, slots=True, eq=False)
class SampledScan:
    """A scan and the points of it that are matched.

    Attributes:
        scan: as it came.
        t_ns: its reference time.
        chosen: (K,) indices of the sampled points.
        points_m: (K, 3) these in the vehicle frame at `t_ns`; the sweep's motion is removed, by wheels and gyro.
        repeated: equal to the scan before bit for bit, which no sensor measures.
    """

    scan: Scan
    t_ns: int
    chosen: NDArray[np.int64]
    points_m: F64
    repeated: bool


def end_ns(scan: Scan) -> int:
    """Time of the last point."""
    return scan.t_ns + int(scan.t_offset_ns.max(initial=0))


def reference_ns(scan: Scan) -> int:
    """The middle of the sweep: an error of the motion is shared by both halves."""
    return (scan.t_ns + end_ns(scan)) // 2


def sweep_variance(T_driven: F64, seen: ScanStep | None, share: float) -> F64:
    """Return the variance (3,), forward, left and in yaw, of a sweep's motion that was removed from its points.

    It is by how much wheels and gyro, (4, 4) `T_driven`, differ from the scans since the scan before, beyond the scans'
    own uncertainty; a sweep lasts a `share` of that time.
    """
    if seen is None:
        return SURE
    off = log_se3(T_inverse(T_driven) @ seen.T_before_now)
    return np.asarray(np.maximum(off**2 - np.diag(seen.covariance), 0.0)[[3, 4, 2]] * min(share, 1.0) ** 2)


def left_in_sweep(variance: F64) -> F64:
    """Return the covariance (6, 6) that a `sweep_variance` (3,) adds to a pose: only the sweep's middle is right."""
    diagonal = np.zeros(6)
    diagonal[[3, 4, 2]] = variance * POSE_SHARE**2 / 12.0
    return np.diag(diagonal)


class Sweeps:
    """Removes the motion of sweeps from their points, and gives the uncertainty that is left of it.

    Args:
        motion: of wheels and gyro.
        mounting: in whose axes the points come out.
        distortion: what speed and turn do to the points of this recording, where they do.
    """

    def __init__(self, motion: MotionBuffer, mounting: Mounting, distortion: Distortion | None) -> None:
        self._motion, self._mounting, self._distortion = motion, mounting, distortion

    def deskewed(self, scan: Scan, chosen: NDArray[np.int64], sweep: Trajectory | None = None) -> F64:
        """Return the chosen points (K, 3) in the vehicle frame at the scan's reference time.

        The motion is that of wheels and gyro, or `sweep`.
        """
        if sweep is None:
            sweep = self._motion.trajectory(scan.t_ns, end_ns(scan))
        offset_ns = scan.t_offset_ns[chosen]
        return deskew(scan.points_m[chosen], offset_ns, scan.t_ns, sweep, self._mounting.T_used, reference_ns(scan))

    def pose_covariance(self, t_ns: int, variance: F64) -> F64:
        """Return the covariance (6, 6) that the motion left in a sweep at `t_ns` adds to its pose.

        All points of the sweep share that error, so matching does not see it. `variance` (3,): of the sweep's motion
        (`sweep_variance`), beside what is known of the times of its points.
        """
        diagonal = np.diag(left_in_sweep(variance)).copy()
        if self._distortion is not None and len(self._motion):
            before = self._motion.delta(t_ns - _SWEPT_NS, t_ns)
            dt_s = _SWEPT_NS * 1e-9
            sigma = self._distortion(before[0, 3] / dt_s, float(np.arctan2(before[1, 0], before[0, 0])) / dt_s)
            diagonal[[3, 4, 2]] += np.square(sigma) * POSE_SHARE**2
        return np.diag(diagonal)
