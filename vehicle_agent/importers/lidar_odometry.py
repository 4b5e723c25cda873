"""LiDAR odometry against a local map of the last scans (small_gicp): the reference track of recordings without one."""

from collections import deque
from collections.abc import Callable

import numpy as np
import small_gicp
from numpy.typing import NDArray

from gnd_map.motion import Trajectory, deskew
from gnd_map.se3 import T_inverse, transform
from schemas.drive import Scan
from vehicle_agent.errors import ImportDriveError
from vehicle_agent.importers.recording import Recording
from vehicle_agent.localise.odometry import MotionBuffer

F64 = NDArray[np.float64]
Progress = Callable[[str, int, int], None]

SCAN_LEAF_M, MAP_LEAF_M = 0.25, 0.15
LOCAL_SCANS = 12
FIRST_REACH_M, REACH_M = 2.0, 0.7  # farthest correspondence: before the speed is known, and after
MIN_OVERLAP = 0.3  # share of a scan's points that must find a partner


def lidar_odometry(recording: Recording, progress: Progress) -> Trajectory:
    """T_first_vehicle of every scan, at the middle of its sweep; the first is the identity.

    Raises:
        ImportDriveError: a scan does not fit those before it.
    """
    odometry = _Odometry(recording)
    for i in range(len(recording)):
        odometry.add(recording.read(i), i)
        progress("LiDAR odometry", i + 1, len(recording))
    return odometry.trajectory


def reference_ns(scan: Scan) -> int:
    """The middle of the sweep."""
    return scan.t_ns + int(scan.t_offset_ns.max(initial=0)) // 2


class _Odometry:
    def __init__(self, recording: Recording) -> None:
        self._recording = recording
        self._motion = MotionBuffer()
        for sample in recording.motion:
            self._motion.push(sample.t_ns, sample.speed_mps, sample.yaw_rate_radps)
        self._local: deque[F64] = deque(maxlen=LOCAL_SCANS)
        self._t_ns: list[int] = []
        self._T: list[F64] = []

    @property
    def trajectory(self) -> Trajectory:
        return Trajectory(np.array(self._t_ns, np.int64), np.stack(self._T))

    def add(self, scan: Scan, number: int) -> None:
        t_ns = reference_ns(scan)
        points = self._deskewed(scan, t_ns)
        cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=SCAN_LEAF_M)
        T = self._aligned(cloud, self._guess(t_ns), number) if self._T else np.eye(4)
        self._local.append(transform(T, np.asarray(cloud.points())[:, :3]))
        self._t_ns.append(t_ns)
        self._T.append(T)

    def _deskewed(self, scan: Scan, t_ns: int) -> F64:
        finite = np.isfinite(scan.points_m).all(axis=1)
        sweep = self._sweep(scan, t_ns)
        return deskew(
            scan.points_m[finite], scan.t_offset_ns[finite], scan.t_ns, sweep, self._recording.T_vehicle_lidar, t_ns
        )

    def _sweep(self, scan: Scan, t_ns: int) -> Trajectory:
        """Motion during the sweep: as measured, else the motion between the two scans before."""
        end_ns = max(scan.t_ns + 1, 2 * t_ns - scan.t_ns)
        if len(self._motion):
            return self._motion.trajectory(scan.t_ns, end_ns)
        if len(self._T) < 2 or end_ns == scan.t_ns + 1:
            return Trajectory(np.array([t_ns], np.int64), np.eye(4)[None])
        last = Trajectory(np.array([0, self._t_ns[-1] - self._t_ns[-2]], np.int64), np.stack([np.eye(4), self._step()]))
        turn = last.at(np.array([0, end_ns - scan.t_ns]), tolerance_ns=end_ns - scan.t_ns)
        return Trajectory(np.array([scan.t_ns, end_ns], np.int64), turn)

    def _step(self) -> F64:
        return np.asarray(T_inverse(self._T[-2]) @ self._T[-1])

    def _guess(self, t_ns: int) -> F64:
        if len(self._motion):
            return np.asarray(self._T[-1] @ self._motion.delta(self._t_ns[-1], t_ns))
        return np.asarray(self._T[-1] @ self._step()) if len(self._T) > 1 else self._T[-1]

    def _aligned(self, cloud: small_gicp.PointCloud, guess: F64, number: int) -> F64:
        target, tree = small_gicp.preprocess_points(np.concatenate(self._local), downsampling_resolution=MAP_LEAF_M)
        known_speed = len(self._T) > 1 or len(self._motion) > 0
        result = small_gicp.align(
            target, cloud, tree, init_T_target_source=guess, max_iterations=40, rotation_epsilon=1e-5,
            translation_epsilon=1e-4, max_correspondence_distance=REACH_M if known_speed else FIRST_REACH_M,
        )  # fmt: skip
        overlap = result.num_inliers / max(cloud.size(), 1)
        if overlap < MIN_OVERLAP:
            raise ImportDriveError(
                f"{self._recording.name}: scan {number} shares {overlap:.0%} of its points with the {len(self._local)}"
                f" scans before it, {MIN_OVERLAP:.0%} are needed: are scans missing, or out of order?"
            )
        return np.asarray(result.T_target_source)
