"""Trajectories, and sweeps freed of the motion that the vehicle made while the LiDAR turned."""

from dataclasses import dataclass

import numpy as np
import numpy.typing as npt

from gnd.gnd_map.arrays import F64, I64, Array, check_array, points_3d
from gnd.gnd_map.errors import MotionError
from gnd.gnd_map.jit import bare, kernel
from gnd.gnd_map.se3 import T_inverse, interpolate_poses

TOLERANCE_NS = 100_000_000  # one sweep at 10 Hz: its last points come after its last pose
_KNOT_NS = 1_000_000  # at 1 rad/s, blending rotations over 1 ms is off by 1.3e-7 rad


@dataclass(frozen=True, slots=True, eq=False)
class Trajectory:
    """Where a vehicle was: poses of the vehicle in some frame dst, in time order."""

    t_ns: I64
    """(N,) UTC, strictly increasing."""
    T_dst_vehicle: F64
    """(N, 4, 4)."""

    def __post_init__(self) -> None:
        check_array("t_ns", self.t_ns, np.int64, (None,))
        check_array("T_dst_vehicle", self.T_dst_vehicle, np.float64, (len(self.t_ns), 4, 4))
        late = np.flatnonzero(self.t_ns[1:] <= self.t_ns[:-1])
        if len(late):
            raise MotionError(f"trajectory: pose {late[0] + 1} of {len(self.t_ns)} is not later than the one before")

    def __len__(self) -> int:
        return len(self.t_ns)

    def at(self, t_ns: npt.ArrayLike, *, tolerance_ns: int = TOLERANCE_NS) -> F64:
        """(M, 4, 4) poses T_dst_vehicle at times (M,), or (4, 4) at one time.

        Raises:
            MotionError: a time lies more than `tolerance_ns` outside; within it the motion is continued.
        """
        query = np.asarray(t_ns, dtype=np.int64)
        asked = query.reshape(-1)
        if not len(self) or (len(asked) and not self._covers(asked, tolerance_ns)):
            return interpolate_poses(self.t_ns, self.T_dst_vehicle, asked, tolerance_ns=tolerance_ns)  # says why not
        poses = np.empty((len(asked), 4, 4))
        _poses_at(np.ascontiguousarray(self.t_ns), np.ascontiguousarray(self.T_dst_vehicle), asked, poses)
        return poses if query.ndim else poses[0]

    def _covers(self, query: I64, tolerance_ns: int) -> bool:
        return bool(query.min() >= self.t_ns[0] - tolerance_ns and query.max() <= self.t_ns[-1] + tolerance_ns)


def deskew(
    points_lidar_m: Array,
    t_offset_ns: Array,
    sweep_t_ns: int,
    poses: Trajectory,
    T_vehicle_lidar: F64,
    reference_ns: int,
) -> F64:
    """(N, 3) float64 points in metres in the vehicle frame at `reference_ns`, order kept.

    Args:
        points_lidar_m: (N, 3) metres in the LiDAR frame, each at its own time.
        t_offset_ns: (N,) integers, time of each point after `sweep_t_ns`.
        sweep_t_ns: start of the sweep, UTC.
        poses: the vehicle's trajectory in any frame.
        T_vehicle_lidar: (4, 4) mount pose.
        reference_ns: the time whose vehicle frame the result is in.

    Raises:
        MotionError: the trajectory does not cover the sweep.
        ShapeError: wrong shapes, or points that are not finite.
    """
    points = points_3d("points_lidar_m", points_lidar_m)
    offset = np.asarray(t_offset_ns).astype(np.int64)
    check_array("t_offset_ns", offset, np.int64, (len(points),))
    check_array("T_vehicle_lidar", T_vehicle_lidar, np.float64, (4, 4))
    if not len(points):
        return points
    first, knots_ns = _knots(offset)
    T_reference_dst = T_inverse(poses.at(reference_ns))
    T_reference_lidar = T_reference_dst @ poses.at(sweep_t_ns + knots_ns) @ T_vehicle_lidar
    out = np.empty_like(points)
    _blend(points, offset, first, np.ascontiguousarray(T_reference_lidar[:, :3, :]), _KNOT_NS, out)
    return out


@kernel
def _turn(T_from: F64, T_to: F64, q: F64) -> None:
    """Fill `q` (4,) with the unit quaternion x, y, z, w >= 0 of the turn between two poses (4, 4), by Shepperd's form
    that is best conditioned.
    """
    R = np.empty((3, 3))
    for r in range(3):
        for c in range(3):
            R[r, c] = T_from[0, r] * T_to[0, c] + T_from[1, r] * T_to[1, c] + T_from[2, r] * T_to[2, c]
    trace = R[0, 0] + R[1, 1] + R[2, 2]
    k = 0 if R[0, 0] >= R[1, 1] and R[0, 0] >= R[2, 2] else (1 if R[1, 1] >= R[2, 2] else 2)
    i, j = (k + 1) % 3, (k + 2) % 3
    if trace >= R[k, k]:
        q[0], q[1], q[2], q[3] = R[2, 1] - R[1, 2], R[0, 2] - R[2, 0], R[1, 0] - R[0, 1], 1.0 + trace
    else:
        q[k], q[3] = 1.0 + R[k, k] - R[i, i] - R[j, j], R[j, i] - R[i, j]
        q[i], q[j] = R[k, i] + R[i, k], R[k, j] + R[j, k]
    length = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2] + q[3] * q[3])
    if q[3] < 0.0:
        length = -length
    for r in range(4):
        q[r] /= length


@kernel
def _poses_at(t_ns: I64, T: F64, query_ns: I64, poses: F64) -> None:
    """Fill `poses` (M, 4, 4) with those at times (M,) between or beyond poses T (N, 4, 4) at `t_ns` (N,): translation
    linear, rotation along the shortest arc. `se3.interpolate_poses` is the plain twin.
    """
    q, last, n = np.empty(4), -1, t_ns.shape[0]
    half, x, y, z = 0.0, 0.0, 0.0, 0.0
    for m in range(query_ns.shape[0]):
        if n == 1:
            poses[m] = T[0]
            continue
        k = min(max(int(np.searchsorted(t_ns, query_ns[m], side="right")) - 1, 0), n - 2)
        if k != last:
            _turn(T[k], T[k + 1], q)
            sine = np.sqrt(q[0] * q[0] + q[1] * q[1] + q[2] * q[2])
            half = np.arctan2(sine, q[3])
            per = 1.0 / sine if sine > 1e-300 else 0.0
            x, y, z, last = q[0] * per, q[1] * per, q[2] * per, k
        part = (query_ns[m] - t_ns[k]) / (t_ns[k + 1] - t_ns[k])
        s, w = np.sin(part * half), np.cos(part * half)
        a, b, c = x * s, y * s, z * s
        R = ((1.0 - 2.0 * (b * b + c * c), 2.0 * (a * b - c * w), 2.0 * (a * c + b * w)),
             (2.0 * (a * b + c * w), 1.0 - 2.0 * (a * a + c * c), 2.0 * (b * c - a * w)),
             (2.0 * (a * c - b * w), 2.0 * (b * c + a * w), 1.0 - 2.0 * (a * a + b * b)))  # fmt: skip
        for r in range(3):
            poses[m, r, 3] = T[k, r, 3] + part * (T[k + 1, r, 3] - T[k, r, 3])
            poses[m, 3, r] = 0.0
            for col in range(3):
                poses[m, r, col] = T[k, r, 0] * R[0][col] + T[k, r, 1] * R[1][col] + T[k, r, 2] * R[2][col]
        poses[m, 3, 3] = 1.0


def _knots(offset_ns: I64) -> tuple[int, I64]:
    """First offset, and times every millisecond from there to past the last one."""
    first = int(offset_ns.min())
    return first, first + _KNOT_NS * np.arange(int(offset_ns.max() - first) // _KNOT_NS + 2)


@bare
def _blend(points: F64, offset_ns: I64, first_ns: int, poses: F64, knot_ns: int, out: F64) -> None:
    """Fill `out` with each point under the pose blended between the two knots around its time."""
    for i in range(points.shape[0]):
        since_ns = offset_ns[i] - first_ns
        k = since_ns // knot_ns
        after = (since_ns - k * knot_ns) / knot_ns
        before = 1.0 - after
        x, y, z = points[i, 0], points[i, 1], points[i, 2]
        for row in range(3):
            a, b = poses[k, row], poses[k + 1, row]
            out[i, row] = before * (a[0] * x + a[1] * y + a[2] * z + a[3]) + after * (
                b[0] * x + b[1] * y + b[2] * z + b[3]
            )
