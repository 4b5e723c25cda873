"""Odometry from the scans alone: ours against the growing map, KISS-ICP and small_gicp VGICP on the same scans.

All get the scans in the order of firing and give the vehicle's pose at the middle of each sweep in the frame of the
first. The rivals run on one thread with their defaults and ranges like ours; KISS-ICP is an extra of the
benchmarks and its row says so when it is not installed.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from time import perf_counter
from typing import Any, Final

import numpy as np
import small_gicp
from numpy.typing import NDArray

from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_inverse, log_so3
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import fit_heading_and_position
from gnd.vehicle_agent.importers.lidar_odometry import RANGE_M, lidar_odometry, reference_ns
from gnd.vehicle_agent.importers.recording import Recording
from studies.real.scene import RecordedScans

F64 = NDArray[np.float64]

OURS: Final = "ours, growing map"
OURS_ALONE: Final = "ours, without the recording's motion"
DOWNSAMPLING_M: Final = 0.25
VOXEL_M: Final = 1.0
MAX_STEP_M: Final = 8.0
"""Between two scans: 290 km/h."""
_GICP: Final = {"max_correspondence_distance": 2.0, "max_iterations": 50}


@dataclass(frozen=True, slots=True, eq=False)
class OdometryResult:
    """A track (T_first_vehicle at the middle of each sweep) and the median time of a scan; or why there is none."""

    name: str
    track: Trajectory | None
    ms_per_scan: float | None
    absent: str = ""


def odometries(recorded: RecordedScans) -> list[OdometryResult]:
    """All of them."""
    recording = recorded.recording
    found = [_ours(OURS, recording)]
    if recording.motion:
        found.append(_ours(OURS_ALONE, _without_motion(recording)))
    return [*found, _kiss(recorded), *(_rival(name, recorded, make()) for name, make in _SMALL_GICP.items())]


def _without_motion(recording: Recording) -> Recording:
    return replace(recording, motion=())


def _ours(name: str, recording: Recording) -> OdometryResult:
    stamps_s = [perf_counter()]
    try:
        track = lidar_odometry(recording, lambda *_: stamps_s.append(perf_counter()))
    except ImportDriveError as error:
        return OdometryResult(name, None, None, str(error))
    return OdometryResult(name, track, 1e3 * float(np.median(np.diff(stamps_s))))


def _kiss(recorded: RecordedScans) -> OdometryResult:
    try:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP
    except ImportError:
        return OdometryResult("KISS-ICP", None, None, "kiss-icp is not installed (extra `peers`)")
    config = load_config(None)
    config.data.min_range, config.data.max_range, config.registration.max_num_threads = *RANGE_M, 1
    config.mapping.voxel_size = 1.0
    engine = KissICP(config)

    def step(scan: Scan) -> F64:
        offset = (
            scan.t_offset_ns.astype(np.float64) if scan.t_offset_ns.any() else np.empty(0)
        )  # equal times are NaN there
        engine.register_frame(scan.points_m.astype(np.float64), offset)
        return np.asarray(engine.last_pose)

    return _rival("KISS-ICP", recorded, step)


class _Predicted(ABC):
    """A rival of small_gicp: the scan freed of the last step's motion, matched from where that step leads."""

    def __init__(self) -> None:
        self._T: list[F64] = []

    def __call__(self, scan: Scan) -> F64:
        step = T_inverse(self._T[-2]) @ self._T[-1] if len(self._T) > 1 else np.eye(4)
        points = _in_range(_deskewed(scan, step))
        T = self._T[-1] @ step if self._T else np.eye(4)
        self._T.append(self._matched(points, T))
        return self._T[-1]

    @abstractmethod
    def _matched(self, points: F64, T_predicted: F64) -> F64:
        """(4, 4) the pose of the LiDAR."""


class _Vgicp(_Predicted):
    """Scan to a growing map of voxels, as small_gicp's own odometry benchmark does."""

    def __init__(self) -> None:
        super().__init__()
        self._map = small_gicp.GaussianVoxelMap(VOXEL_M)
        self._map.set_lru(horizon=100, clear_cycle=10)

    def _matched(self, points: F64, T_predicted: F64) -> F64:
        cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=DOWNSAMPLING_M)
        T = T_predicted
        if self._map.size():
            T = np.asarray(small_gicp.align(self._map, cloud, init_T_target_source=T).T_target_source)
        self._map.insert(cloud, T)
        return T


class _Gicp(_Predicted):
    """Scan to scan."""

    def __init__(self) -> None:
        super().__init__()
        self._before: tuple[Any, Any] | None = None

    def _matched(self, points: F64, T_predicted: F64) -> F64:
        cloud, tree = small_gicp.preprocess_points(points, downsampling_resolution=DOWNSAMPLING_M)
        T = T_predicted
        if self._before is not None:
            start = T_inverse(self._T[-1]) @ T_predicted
            T = self._T[-1] @ small_gicp.align(self._before[0], cloud, self._before[1], start, **_GICP).T_target_source
        self._before = (cloud, tree)
        return np.asarray(T)


def _deskewed(scan: Scan, step: F64) -> F64:
    """(N, 3) points at the middle of the sweep, the last step taken as a turn's motion; LiDAR frame."""
    span = int(scan.t_offset_ns.max(initial=0))
    if not span:
        return scan.points_m.astype(np.float64)
    sweep = Trajectory(np.array([scan.t_ns, scan.t_ns + span], np.int64), np.stack([np.eye(4), step]))
    return deskew(scan.points_m, scan.t_offset_ns, scan.t_ns, sweep, np.eye(4), reference_ns(scan))


def _in_range(points: F64) -> F64:
    range_m = np.linalg.norm(points, axis=1)
    return np.asarray(points[(range_m >= RANGE_M[0]) & (range_m <= RANGE_M[1])])


def _rival(name: str, recorded: RecordedScans, step: Callable[[Scan], F64]) -> OdometryResult:
    """Poses of the LiDAR, one a scan, as poses of the vehicle."""
    T_lidar, times_s = [], []
    for number, scan in enumerate(recorded.scans):
        begin_s = perf_counter()
        T_lidar.append(step(scan).copy())
        times_s.append(perf_counter() - begin_s)
        if number and not np.linalg.norm(T_lidar[-1][:3, 3] - T_lidar[-2][:3, 3]) < MAX_STEP_M:
            return OdometryResult(name, None, None, f"lost at scan {number}: a step of more than {MAX_STEP_M:.0f} m")
    mount = recorded.recording.T_vehicle_lidar
    T = mount @ T_inverse(T_lidar[0]) @ np.stack(T_lidar) @ T_inverse(mount)
    t_ns = np.array([reference_ns(scan) for scan in recorded.scans], np.int64)
    return OdometryResult(name, Trajectory(t_ns, T), 1e3 * float(np.median(times_s)))


_SMALL_GICP: Final[dict[str, type[_Predicted]]] = {
    "small_gicp VGICP, growing map": _Vgicp,
    "small_gicp GICP, scan to scan": _Gicp,
}

# --- what is said of them --------------------------------------------------------------------------------------------


def compared(found: Sequence[OdometryResult], recorded: RecordedScans) -> list[dict[str, Any]]:
    """Each beside the first one and the recording's own positions."""
    first = found[0].track
    return [_row(one, first, recorded.recording) for one in found]


def _row(one: OdometryResult, first: Trajectory | None, recording: Recording) -> dict[str, Any]:
    row: dict[str, Any] = {"name": one.name, "absent": one.absent}
    if one.track is None:
        return row
    p = one.track.T_dst_vehicle[:, :3, 3]
    row |= {"way_m": float(np.linalg.norm(np.diff(p, axis=0), axis=1).sum()), "ms_per_scan": one.ms_per_scan}
    row |= against_positions(one.track, recording)
    if first is not None and one.track is not first:
        row |= against_track(one.track, first)
    return row


def against_track(track: Trajectory, other: Trajectory) -> dict[str, float]:
    """Steps and end against another odometry's at the same times."""
    T, T_other = track.T_dst_vehicle, other.at(track.t_ns)
    step = T_inverse(T_inverse(T_other[:-1]) @ T_other[1:]) @ T_inverse(T[:-1]) @ T[1:]
    end = T_inverse(T_other[-1]) @ T_other[0] @ T_inverse(T[0]) @ T[-1]
    return {
        "step_m_p95": float(np.quantile(np.linalg.norm(step[:, :3, 3], axis=1), 0.95)),
        "step_deg_p95": float(np.degrees(np.quantile(np.linalg.norm(log_so3(step[:, :3, :3]), axis=1), 0.95))),
        "end_along_m": float(end[0, 3]),
        "end_across_m": float(end[1, 3]),
    }


def against_positions(track: Trajectory, recording: Recording) -> dict[str, float]:
    """The recording's positions less the track turned and shifted onto them, horizontally, and their way; nothing where
    it has none.
    """
    fixes = [fix for fix in recording.gnss if track.t_ns[0] <= fix.t_ns <= track.t_ns[-1]]
    if len(fixes) < 3:
        return {}
    lat, lon, height = np.array([(fix.lat_rad, fix.lon_rad, fix.height_m) for fix in fixes]).T
    p_fix = recording.anchor.frame.enu_from_geodetic(lat, lon, height)
    p = track.at(np.array([fix.t_ns for fix in fixes], np.int64))[:, :3, 3]
    T = fit_heading_and_position(p, p_fix)
    off = np.linalg.norm((p @ T[:3, :3].T + T[:3, 3] - p_fix)[:, :2], axis=1)
    ways = [float(np.linalg.norm(np.diff(q[:, :2], axis=0), axis=1).sum()) for q in (p, p_fix)]
    return {
        "positions_m_p50": float(np.median(off)),
        "positions_m_p95": float(np.quantile(off, 0.95)),
        "way_less_positions_m": ways[0] - ways[1],
    }
