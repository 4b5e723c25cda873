"""Scan-to-scan odometry without a map: the steps of a drive put one after the other."""

from pathlib import Path
from time import process_time

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.schemas.drive import MotionSample, Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.localise.calibration import MotionTeacher
from gnd.vehicle_agent.localise.odometry import MotionBuffer
from gnd.vehicle_agent.localise.parameters import LocaliserParameters
from gnd.vehicle_agent.localise.sampling import sample_scan
from gnd.vehicle_agent.localise.scan_odometry import ScanOdometry, joint_step


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
    teacher = MotionTeacher(motion, parameters.odometry)
    odometry = ScanOdometry(parameters.scan_odometry, parameters.registration.noise_m)
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
