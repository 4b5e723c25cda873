"""Registration against small_gicp: the same scans and starts, one thread, time of the processor.

Ours samples the scan itself; small_gicp gets its own downsampling (0.25 m), 50 iterations, neighbours within 2 m (GICP)
and a target of the mapping drive's points: 1 m voxels (VGICP) or points at 0.2 m (GICP). All see the street before it
changed.

Beside it scan-to-scan odometry without a map: the steps of a drive put one after the other.
"""

from collections.abc import Callable, Sequence
from pathlib import Path
from time import process_time
from typing import Any, NamedTuple

import numpy as np
import small_gicp

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from gnd.schemas.drive import MotionSample, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.registration import Start, register
from gnd.vehicle_agent.localise.sampling import sample_scan
from gnd.vehicle_agent.localise.scan_odometry import ScanOdometry, joint_step
from studies.frame.measure import Figure


class Aligner(NamedTuple):
    """Two steps: `prepare` makes of points (N, 3) in the vehicle frame what `match` takes with a start (4, 4), to give
    T_map_vehicle.
    """

    prepare: Callable[[F64], Any]
    match: Callable[[Any, F64], F64]


STARTS: Sequence[tuple[float, float, Start]] = ((0.3, 1.0, "wide"), (1.0, 3.0, "wide"), (2.0, 5.0, "capture"))
"""Metres, degrees, and how far ours is told to reach."""
CONVERGED_M, CONVERGED_DEG = 0.1, 0.3
REACH_M = 2.0


def rivals_of(map_points: F64) -> dict[str, Aligner]:
    """small_gicp on the points (N, 3) of a map."""
    return {"small_gicp VGICP": _vgicp(map_points), "small_gicp GICP": _gicp(map_points)}


def registrations(
    sensor: str, scans: Sequence[tuple[F64, F64]], rivals: dict[str, Aligner], local_map: LocalMap
) -> list[Figure]:
    """Time, share that converged and median error, for each start and aligner."""
    figures = []
    for metres, degrees, start in STARTS:
        for name, align in {"ours": _ours(local_map, start), **rivals}.items():
            title = f"registration, {sensor}, {metres:g} m / {degrees:g}°, {name}"
            figures.append(_registration(title, align, scans, metres, degrees))
    return figures


def _registration(name: str, align: Aligner, scans: Sequence[tuple[F64, F64]], metres: float, degrees: float) -> Figure:
    rng = np.random.default_rng(0)
    align.match(align.prepare(scans[0][0]), scans[0][1])
    times_s, errors = [], []
    for points, T_true in scans:
        start = T_true @ _offset(rng, metres, degrees)
        begin_s = process_time()
        prepared = align.prepare(points)
        prepared_s = process_time()
        T = align.match(prepared, start)
        times_s.append((process_time() - begin_s, process_time() - prepared_s))
        errors.append(_error(T_true, T))
    off = np.array(errors)
    found = (off[:, 0] < CONVERGED_M) & (off[:, 1] < CONVERGED_DEG)
    m, deg = np.median(off[found], axis=0) if found.any() else (np.nan, np.nan)
    whole_ms, match_ms = np.median(times_s, axis=0) * 1e3
    detail = (
        f"matching alone {match_ms:.1f} ms; {found.mean():.0%} converged, of these median error {m * 100:.2f} cm,"
        f" {deg:.3f}°; {len(scans)} scans"
    )
    return Figure(name, float(whole_ms), "ms/scan", detail)


def _error(T_true: F64, T: F64) -> tuple[float, float]:
    """Horizontal distance [m] and heading [degrees]: what a pose is asked for."""
    off = T_inverse(T_true) @ T
    return float(np.hypot(off[0, 3], off[1, 3])), float(np.degrees(abs(np.arctan2(off[1, 0], off[0, 0]))))


def _offset(rng: np.random.Generator, metres: float, degrees: float) -> F64:
    """Mostly along the ground and about the vertical, as vehicles are off."""
    axis, direction = rng.normal(size=3) * [0.2, 0.2, 1.0], rng.normal(size=3) * [1.0, 1.0, 0.2]
    turn = np.radians(degrees) * axis / np.linalg.norm(axis)
    return T_from_R_t(exp_so3(turn), metres * direction / np.linalg.norm(direction))


def _ours(local_map: LocalMap, start: Start) -> Aligner:
    parameters = LocaliserParameters()
    cache = MatchMapCache(local_map, parameters.registration.noise_m)

    def match(points: F64, T_start: F64) -> F64:
        try:
            return register(points, T_start, cache.near(T_start[:3, 3]), parameters.registration, start).T_map_vehicle
        except RegistrationError:
            return T_start

    return Aligner(lambda points: points[sample_scan(points, parameters.sampling)], match)


def _downsampled(points: F64) -> Any:
    return small_gicp.preprocess_points(points, downsampling_resolution=0.25)[0]


def _vgicp(map_points: F64) -> Aligner:
    target = small_gicp.GaussianVoxelMap(1.0)
    target.set_lru(horizon=1_000_000, clear_cycle=1_000_000)
    target.insert(small_gicp.preprocess_points(map_points, downsampling_resolution=0.2)[0])

    def match(cloud: Any, start: F64) -> F64:
        found = small_gicp.align(target, cloud, init_T_target_source=start, max_iterations=50)
        return np.asarray(found.T_target_source)

    return Aligner(_downsampled, match)


def _gicp(map_points: F64) -> Aligner:
    target, tree = small_gicp.preprocess_points(map_points, downsampling_resolution=0.2)

    def match(cloud: Any, start: F64) -> F64:
        found = small_gicp.align(
            target, cloud, tree, init_T_target_source=start, max_correspondence_distance=REACH_M, max_iterations=50
        )
        return np.asarray(found.T_target_source)

    return Aligner(_downsampled, match)


def steps_of(path: Path) -> tuple[Trajectory, float]:
    """T_first_vehicle of a drive's scans at the middle of their sweeps, and the median time of a scan, ms (sampling and
    deskewing included, as in the rival). Wheels and gyro are taken as they are: nothing teaches them.
    """
    motion, parameters = MotionBuffer(), LocaliserParameters()
    scans = []
    for item in read_drive(path):
        if isinstance(item, MotionSample):
            motion.push(item.t_ns, item.speed_mps, item.yaw_rate_radps)
        elif isinstance(item, Scan):
            scans.append(item)
    teacher = MotionTeacher(motion)
    odometry = ScanOdometry(parameters.registration.noise_m)
    T_vehicle_lidar, T = read_header(path).T_vehicle_lidar, np.eye(4)
    times_ns: list[int] = []
    poses: list[F64] = []
    times_s = []
    for scan in scans:
        begin_s = process_time()
        t_ns = scan.t_ns + int(scan.t_offset_ns.max()) // 2
        points = _points(scan, motion, T_vehicle_lidar, t_ns)
        before_ns = times_ns[-1] if times_ns else t_ns
        driven = motion.delta(before_ns, t_ns)
        sigmas = teacher.sigmas(driven, (t_ns - before_ns) * 1e-9)
        T = T @ joint_step(driven, sigmas, odometry.step(t_ns, points, driven, sigmas)).T_before_now
        times_s.append(process_time() - begin_s)
        times_ns.append(t_ns)
        poses.append(T)
    return Trajectory(np.array(times_ns, np.int64), np.stack(poses)), float(np.median(times_s)) * 1e3


def _points(scan: Scan, motion: MotionBuffer, T_vehicle_lidar: F64, t_ns: int) -> F64:
    chosen = sample_scan(scan.points_m, LocaliserParameters().sampling)
    sweep = motion.trajectory(scan.t_ns, scan.t_ns + int(scan.t_offset_ns.max()))
    return deskew(scan.points_m[chosen], scan.t_offset_ns[chosen], scan.t_ns, sweep, T_vehicle_lidar, t_ns)
