"""Scans find their place: registration beside small_gicp, odometry beside KISS-ICP."""

from collections.abc import Callable
from typing import Any

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_from_R_t, T_inverse, exp_so3
from gnd.schemas.drive import MotionSample, Scan
from gnd.vehicle_agent.errors import RegistrationError
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.match_map import MatchMapCache
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.registration import register
from gnd.vehicle_agent.localise.sampling import sample_scan
from gnd.vehicle_agent.localise.scan_odometry import ScanOdometry, joint_step
from studies.speed.contest import Absent, Contest, Entrant
from studies.speed.scene import SpeedScene

OFF_M, OFF_DEG = 0.3, 1.0
CONVERGED_M, CONVERGED_DEG = 0.1, 0.3
REACH_M = 2.0
MAP_STEP_M, SCAN_STEP_M, VOXEL_M = 0.2, 0.25, 1.0
STRETCH_M = 60.0

Align = Callable[[F64, F64], F64]
"""Points (N, 3) in the vehicle frame and a start (4, 4) to T_map_vehicle."""


def matching_contest(scene: SpeedScene) -> Contest:
    """Each scan once, from a start that is a little off."""
    rng = np.random.default_rng(0)
    starts = [T @ _offset(rng) for _, T in scene.unchanged]

    def entrant(name: str, align: Align) -> Entrant:
        return Entrant(
            name,
            lambda: [align(points, start) for (points, _), start in zip(scene.unchanged, starts, strict=True)],
            lambda found: _found(found, [T for _, T in scene.unchanged]),
        )

    notes = (
        f"{scene.sensor} on the unchanged street, starts {OFF_M} m and {OFF_DEG:g}° off, one thread. Sampling of the"
        f" scan is part of the time. small_gicp has a target of the same drive's points: voxels of {VOXEL_M:g} m"
        f" (VGICP) or points at {MAP_STEP_M} m (GICP); its scans are downsampled to {SCAN_STEP_M} m.",
        f"Converged: nearer than {CONVERGED_M} m and {CONVERGED_DEG}°.",
    )
    others = [entrant(*one) if isinstance(one, tuple) else one for one in _small_gicp(scene.cloud)]
    return Contest("A scan on a map", "ms/scan", len(starts), entrant("ours", _ours(scene)), others, notes)


def _offset(rng: np.random.Generator) -> F64:
    """Mostly along the ground and about the vertical, as vehicles are off."""
    axis, direction = rng.normal(size=3) * [0.2, 0.2, 1.0], rng.normal(size=3) * [1.0, 1.0, 0.2]
    turn = np.radians(OFF_DEG) * axis / np.linalg.norm(axis)
    return T_from_R_t(exp_so3(turn), OFF_M * direction / np.linalg.norm(direction))


def _found(found: list[F64], truth: list[F64]) -> str:
    off = np.stack([T_inverse(a) @ b for a, b in zip(truth, found, strict=True)])
    m, deg = np.hypot(off[:, 0, 3], off[:, 1, 3]), np.degrees(np.abs(np.arctan2(off[:, 1, 0], off[:, 0, 0])))
    good = (m < CONVERGED_M) & (deg < CONVERGED_DEG)
    if not good.any():
        return "none converged"
    return (
        f"{good.mean():.0%} converged, of these median {100 * np.median(m[good]):.2f} cm, {np.median(deg[good]):.3f}°"
    )


def _ours(scene: SpeedScene) -> Align:
    parameters = LocaliserParameters()
    cache = MatchMapCache(scene.local_map, parameters.registration.noise_m)

    def align(points: F64, T_start: F64) -> F64:
        sampled = points[sample_scan(points, parameters.sampling)]
        try:
            return register(sampled, T_start, cache.near(T_start[:3, 3]), parameters.registration).T_map_vehicle
        except RegistrationError:
            return T_start

    return align


def _small_gicp(cloud: F64) -> list[tuple[str, Align] | Absent]:
    try:
        import small_gicp
    except ImportError:
        return [Absent("small_gicp", "small_gicp is not installed (extra `vehicle`)")]
    points, tree = small_gicp.preprocess_points(cloud, downsampling_resolution=MAP_STEP_M)
    voxels = small_gicp.GaussianVoxelMap(VOXEL_M)
    voxels.set_lru(horizon=1_000_000, clear_cycle=1_000_000)
    voxels.insert(points)

    def sampled(scan: F64) -> Any:
        return small_gicp.preprocess_points(scan, downsampling_resolution=SCAN_STEP_M)[0]

    def vgicp(scan: F64, T_start: F64) -> F64:
        found = small_gicp.align(voxels, sampled(scan), init_T_target_source=T_start, max_iterations=50)
        return np.asarray(found.T_target_source)

    def gicp(scan: F64, T_start: F64) -> F64:
        found = small_gicp.align(
            points, sampled(scan), tree, init_T_target_source=T_start, max_correspondence_distance=REACH_M,
            max_iterations=50,
        )  # fmt: skip
        return np.asarray(found.T_target_source)

    return [("small_gicp VGICP", vgicp), ("small_gicp GICP", gicp)]


# --- odometry ---------------------------------------------------------------------------------------------------------


def odometry_contest(scene: SpeedScene) -> Contest:
    """A whole drive, scan by scan, without a map of before."""
    scans = [item for item in scene.drive if isinstance(item, Scan)]

    def judge(track: Trajectory) -> str:
        return _drift(track, scene.reference)

    entrant = Entrant("ours, with wheels and gyro", lambda: _steps(scene), judge)
    notes = (
        f"{scene.sensor} on the changed street, raw sweeps in order of time, one thread, deskewing included. KISS-ICP"
        f" has its defaults, maximal range 100 m, voxels of {VOXEL_M:g} m; it knows neither wheels nor gyro.",
    )
    return Contest("Odometry", "ms/scan", len(scans), entrant, [_kiss(scene, scans, judge)], notes)


def _steps(scene: SpeedScene) -> Trajectory:
    """T_first_vehicle at the middle of each sweep: the steps of our odometry put one after the other."""
    parameters = LocaliserParameters()
    motion = MotionBuffer()
    for item in scene.drive:
        if isinstance(item, MotionSample):
            motion.push(item.t_ns, item.speed_mps, item.yaw_rate_radps)
    teacher, odometry = MotionTeacher(motion), ScanOdometry()
    T, times_ns, poses = np.eye(4), list[int](), list[F64]()
    for scan in scene.drive:
        if not isinstance(scan, Scan):
            continue
        t_ns = _middle_ns(scan)
        chosen = sample_scan(scan.points_m, parameters.sampling)
        sweep = motion.trajectory(scan.t_ns, scan.t_ns + int(scan.t_offset_ns.max()))
        offset_ns = scan.t_offset_ns[chosen]
        points = deskew(scan.points_m[chosen], offset_ns, scan.t_ns, sweep, scene.T_vehicle_lidar, t_ns)
        before_ns = times_ns[-1] if times_ns else t_ns
        driven = motion.delta(before_ns, t_ns)
        sigmas = teacher.sigmas(driven, (t_ns - before_ns) * 1e-9)
        T = T @ joint_step(driven, sigmas, odometry.step(t_ns, points, driven, sigmas)).T_before_now
        times_ns.append(t_ns)
        poses.append(T)
    return Trajectory(np.array(times_ns, np.int64), np.stack(poses))


def _kiss(scene: SpeedScene, scans: list[Scan], judge: Callable[[Trajectory], str]) -> Entrant | Absent:
    try:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP
    except ImportError:
        return Absent("KISS-ICP", "kiss-icp is not installed (extra `peers`)")
    config = load_config(None)
    config.registration.max_num_threads, config.data.max_range, config.mapping.voxel_size = 1, 100.0, VOXEL_M
    T_lidar_vehicle = T_inverse(scene.T_vehicle_lidar)
    inputs = [(scan.points_m.astype(np.float64), scan.t_offset_ns.astype(np.float64)) for scan in scans]
    times_ns = np.array([_middle_ns(scan) for scan in scans], np.int64)

    def work() -> Trajectory:
        engine, poses = KissICP(config), []
        for points, offset_ns in inputs:
            engine.register_frame(points, offset_ns)
            poses.append(scene.T_vehicle_lidar @ engine.last_pose @ T_lidar_vehicle)
        return Trajectory(times_ns, np.stack(poses))

    return Entrant("KISS-ICP", work, judge)


def _middle_ns(scan: Scan) -> int:
    return scan.t_ns + int(scan.t_offset_ns.max()) // 2


def _drift(track: Trajectory, reference: Trajectory) -> str:
    """Horizontal error at the end of stretches, in the frame of their start, and of heading."""
    within = (track.t_ns >= reference.t_ns[0]) & (track.t_ns <= reference.t_ns[-1])
    T, T_true = track.T_dst_vehicle[within], reference.at(track.t_ns[within])
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1))])
    stretch_m = min(STRETCH_M, 0.5 * way_m[-1])
    first = np.flatnonzero(way_m + stretch_m <= way_m[-1])
    last = np.searchsorted(way_m, way_m[first] + stretch_m)
    off = T_inverse(T_inverse(T_true[first]) @ T_true[last]) @ (T_inverse(T[first]) @ T[last])
    rms_m = np.sqrt(np.mean(off[:, 0, 3] ** 2 + off[:, 1, 3] ** 2))
    rms_deg = np.degrees(np.sqrt(np.mean(np.arctan2(off[:, 1, 0], off[:, 0, 0]) ** 2)))
    return f"after {stretch_m:.0f} m {100 * rms_m:.1f} cm, {rms_deg:.3f}° (root mean square)"
