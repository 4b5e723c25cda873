"""How fast and how well scans find their place: simulated scans of the first street, time of one core.

`registration` is a single scan on the map, from three distances (`studies.registering`). `online` is the whole
localiser on a drive along the street after it changed, with sensor errors, parked cars and the map from before: the
time until the online pose of a scan is known, and its parts; what comes later (submaps, the final points of a scan) is
counted apart. `odometry` matches scans with scans only, no map: ours with and KISS-ICP without wheels and gyro.
"""

from collections.abc import Iterator
from pathlib import Path
from tempfile import TemporaryDirectory
from time import process_time

import numpy as np

from gnd.fleet_sim.drives import DriveConfig, simulate_drive
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import read_drive, read_header
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise import PoseEstimate, localisation_error, localiser
from gnd.vehicle_agent.localise.graph import PoseGraph
from gnd.vehicle_agent.localise.judge import Judge
from gnd.vehicle_agent.localise.packed_scan import PackedScan
from gnd.vehicle_agent.localise.refine import Refiner
from gnd.vehicle_agent.localise.scan_odometry import ScanOdometry
from studies.frame.measure import Figure, Stopwatch
from studies.localisation_scenes import localising, mapped_street, note_newest, reference_of, true_scans
from studies.registering import registrations, rivals_of, steps_of

SENSORS = ("VLP-16", "HDL-32E", "HDL-64E", "Scala")
SCANS, EVERY = 60, 5
WARMING = 30
PARTS = (
    ("sampling", localiser, "sample_scan"),
    ("deskewing", localiser, "deskew"),
    ("scan to scan", ScanOdometry, "step"),
    ("registration", localiser, "register"),
    ("judging", Judge, "see"),
    ("graph", PoseGraph, "add"),
    ("graph", PoseGraph, "smoothed"),
    ("packing", localiser, "pack"),
    ("submaps", Refiner, "push"),
    ("final points", PackedScan, "placed"),
)
LATER = ("submaps", "final points")


def run() -> list[Figure]:
    """Measure the four sensors."""
    figures: list[Figure] = []
    with TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        world, points, local_map = mapped_street(Path(folder))
        rivals = rivals_of(points)
        for sensor in SENSORS:
            unchanged = DriveConfig("car", sensor, "before", seed=1, car_share=0.0, scans=SCANS)
            scans = list(true_scans(simulate_drive(world, unchanged, path)))[::EVERY]
            figures += registrations(sensor, scans, rivals, local_map)
            changed = DriveConfig("car", sensor, "after", seed=2, cruise_mps=12.0)
            simulate_drive(world, changed, path)
            figures += _online(sensor, path, local_map)
            figures += _odometry(sensor, path)
    return figures


def _online(sensor: str, path: Path, local_map: LocalMap) -> list[Figure]:
    """The localiser over a drive: a step's time and its parts."""
    _drive(path, local_map, Stopwatch(), WARMING)
    watch = Stopwatch()
    steps_s, estimates = _drive(path, local_map, watch)
    error = localisation_error(estimates, reference_of(path))
    accuracy = (
        f"95 % below {np.quantile(steps_s, 0.95) * 1e3:.1f}, longest {max(steps_s) * 1e3:.1f} ms; online pose, 95 %:"
        f" {error.longitudinal_p95_m * 100:.1f} cm along, {error.lateral_p95_m * 100:.1f} cm across,"
        f" {error.heading_p95_deg:.3f}°; {error.n} scans"
    )
    mean_ms = float(np.mean(steps_s)) * 1e3
    parts = {name: 1e3 * spent_s / len(steps_s) for name, spent_s in watch.total_s.items()}
    rest_ms = mean_ms - sum(ms for name, ms in parts.items() if name not in LATER)
    detail = [Figure(f"  {name}, {sensor}", ms, "ms/scan", "later" * (name in LATER)) for name, ms in parts.items()]
    return [
        Figure(f"online step, {sensor}, changed street", mean_ms, "ms/scan", accuracy),
        *detail,
        Figure(f"  the rest, {sensor}", rest_ms, "ms/scan"),
    ]


def _drive(
    path: Path, local_map: LocalMap, watch: Stopwatch, scans: int = 1_000_000
) -> tuple[list[float], list[PoseEstimate]]:
    """Time of each online step (since the scan before, less what comes later), and the online poses."""
    vehicle, estimates = localising(path, local_map), list[PoseEstimate]()
    steps_s, before_s, spent_s = [], 0.0, 0.0
    with watch.worn(PARTS):
        for item in read_drive(path):
            begin_s = process_time()
            output = vehicle.push(item)
            spent_s += process_time() - begin_s
            if isinstance(item, Scan):
                online_s = spent_s - sum(watch.total_s[name] for name in LATER)
                steps_s.append(online_s - before_s)
                before_s = online_s
            note_newest(output, estimates)
            if len(steps_s) >= scans:
                break
    return steps_s, estimates


# --- odometry --------------------------------------------------------------------------------------------------------


def _odometry(sensor: str, path: Path) -> list[Figure]:
    """Ours, timed within the localiser without a map, and KISS-ICP on the same scans."""
    return [_ours(sensor, path), _kiss(sensor, path)]


def _ours(sensor: str, path: Path) -> Figure:
    reference = reference_of(path)
    track, ms = steps_of(path)
    return Figure(f"odometry, {sensor}, scan to scan", ms, "ms/scan", _drift(track, reference))


def _kiss(sensor: str, path: Path) -> Figure:
    name = f"odometry, {sensor}, KISS-ICP"
    try:
        from kiss_icp.config import load_config
        from kiss_icp.kiss_icp import KissICP
    except ImportError:
        return Figure(name, float("nan"), "ms/scan", "not installed (extra `peers`)")
    config = load_config(None)
    config.registration.max_num_threads, config.data.max_range, config.mapping.voxel_size = 1, 100.0, 1.0
    engine, T_vehicle_lidar = KissICP(config), read_header(path).T_vehicle_lidar
    poses, times_ns, times_s = [], [], []
    for scan in _scans(path):
        points, offset = scan.points_m.astype(np.float64), scan.t_offset_ns.astype(np.float64)
        begin_s = process_time()
        engine.register_frame(points, offset)
        times_s.append(process_time() - begin_s)
        poses.append(T_vehicle_lidar @ engine.last_pose @ T_inverse(T_vehicle_lidar))
        times_ns.append(scan.t_ns + int(scan.t_offset_ns.max()) // 2)
    track = Trajectory(np.array(times_ns, np.int64), np.stack(poses))
    return Figure(name, float(np.median(times_s)) * 1e3, "ms/scan", _drift(track, reference_of(path)))


def _scans(path: Path) -> Iterator[Scan]:
    return (item for item in read_drive(path) if isinstance(item, Scan))


def _drift(track: Trajectory, reference: Trajectory) -> str:
    """Error at the end of each stretch of 60 m, in the frame of its start, and of each step."""
    within = (track.t_ns >= reference.t_ns[0]) & (track.t_ns <= reference.t_ns[-1])
    T, T_true = track.T_dst_vehicle[within], reference.at(track.t_ns[within])
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(T_true[:, :3, 3], axis=0), axis=1))])
    first = np.flatnonzero(way_m + 60.0 <= way_m[-1])
    ends = _relative_error(T, T_true, first, np.searchsorted(way_m, way_m[first] + 60.0))
    steps = _relative_error(T, T_true, np.arange(len(T) - 1), np.arange(1, len(T)))
    rms_m, rms_deg = np.sqrt((ends**2).mean(axis=0))
    return (
        f"after 60 m {rms_m * 100:.1f} cm, {rms_deg:.3f}° (root mean square);"
        f" a step {np.median(steps[:, 0]) * 100:.2f} cm; {len(T)} scans"
    )


def _relative_error(T: F64, T_true: F64, first: np.ndarray, last: np.ndarray) -> F64:
    """(K, 2) horizontal metres and degrees of heading by which motions from `first` to `last` are off."""
    off = T_inverse(T_inverse(T_true[first]) @ T_true[last]) @ (T_inverse(T[first]) @ T[last])
    heading = np.degrees(np.abs(np.arctan2(off[:, 1, 0], off[:, 0, 0])))
    return np.column_stack([np.hypot(off[:, 0, 3], off[:, 1, 3]), heading])
