"""How fast and how well scans find their place: simulated scans of the first street, one thread.

`registration` starts 0.3 m and 1° off, downsampling of the scan included; small_gicp gets the same scans and starts,
its own downsampling (0.25 m) and a target of the mapping drive's points: 1 m voxels (VGICP) or points at 0.2 m (GICP).
Both see the street before it changed. `localisation` is the whole localiser (first search, sampling, deskewing,
matching, pose graph, the final points of every scan) on a drive along the whole street after it changed, with sensor
errors, parked cars and the map from before.
"""

from collections.abc import Callable
from pathlib import Path
from tempfile import TemporaryDirectory
from time import perf_counter

import numpy as np
import small_gicp

from benchmarks.figures import Figure
from fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from fleet_sim.street import street
from gnd_map.accumulate import VoxelAccumulator
from gnd_map.arrays import F64
from gnd_map.grid import GridFrame
from gnd_map.motion import Trajectory, deskew
from gnd_map.se3 import T_from_R_t, T_inverse, exp_so3, transform
from gnd_map.tile import Tile
from gnd_map.tile_id import covering_corridor
from schemas.drive import DriveItem, GnssFix, MotionSample, Scan
from schemas.drive_mcap import load_track, read_drive, read_header
from vehicle_agent.local_map import LocalMap
from vehicle_agent.localise import Localiser, RefinedScan, localisation_error
from vehicle_agent.localise.match_map import MatchMapCache
from vehicle_agent.localise.parameters import LocaliserParameters
from vehicle_agent.localise.registration import register
from vehicle_agent.localise.sampling import sample_scan

COMMAND = "python -m benchmarks localisation"
SEED, SCANS, EVERY = 1, 60, 3
MAPPING = DriveConfig("map", "HDL-32E", "before", errors=PERFECT, car_share=0.0, cruise_mps=12.0)
Aligner = Callable[[F64, F64], F64]  # points in the vehicle frame and a start to T_map_vehicle


def run() -> list[Figure]:
    """Measure both sensors of the simulations."""
    figures: list[Figure] = []
    with TemporaryDirectory() as folder:
        path, world = Path(folder) / "drive.mcap", street(SEED)
        points, local_map = _map_of(simulate_drive(world, MAPPING, path))
        for sensor in ("VLP-16", "HDL-32E"):
            unchanged = DriveConfig("car", sensor, "before", seed=1, car_share=0.0, scans=SCANS)
            figures += _registrations(sensor, simulate_drive(world, unchanged, path), points, local_map)
            changed = DriveConfig("car", sensor, "after", seed=2, cruise_mps=12.0)
            figures.append(_localisation(sensor, simulate_drive(world, changed, path), local_map))
    return figures


def _registrations(sensor: str, path: Path, points: F64, local_map: LocalMap) -> list[Figure]:
    scans = _true_scans(path)[::EVERY]
    aligners = {"ours": _ours(local_map), "small_gicp VGICP": _vgicp(points), "small_gicp GICP": _gicp(points)}
    return [_registration(f"registration, {sensor}, {name}", align, scans) for name, align in aligners.items()]


def _registration(name: str, align: Aligner, scans: list[tuple[F64, F64]]) -> Figure:
    """Median time and error over the scans, each from a start that is 0.3 m and 1° off."""
    rng = np.random.default_rng(0)
    align(*scans[0])
    times_s, off_m = [], []
    for points, T_true in scans:
        start = T_true @ _offset(rng)
        begin_s = perf_counter()
        T = align(points, start)
        times_s.append(perf_counter() - begin_s)
        off_m.append(float(np.linalg.norm((T_inverse(T_true) @ T)[:3, 3])))
    found = np.mean(np.array(off_m) < 0.1)
    detail = f"median error {np.median(off_m) * 100:.2f} cm, {found:.0%} within 10 cm, {len(scans)} scans"
    return Figure(name, float(np.median(times_s)) * 1e3, "ms/scan", detail)


def _offset(rng: np.random.Generator) -> F64:
    axis, direction = rng.normal(size=3), rng.normal(size=3)
    turn = np.radians(1.0) * axis / np.linalg.norm(axis)
    return T_from_R_t(exp_so3(turn), 0.3 * direction / np.linalg.norm(direction))


def _ours(local_map: LocalMap) -> Aligner:
    parameters = LocaliserParameters()
    cache = MatchMapCache(local_map, parameters.registration.noise_m)

    def align(points: F64, start: F64) -> F64:
        chosen = sample_scan(points, parameters.sampling)
        return register(points[chosen], start, cache.near(start[:3, 3]), parameters.registration, "wide").T_map_vehicle

    return align


def _vgicp(map_points: F64) -> Aligner:
    target = small_gicp.GaussianVoxelMap(1.0)
    target.set_lru(horizon=1_000_000, clear_cycle=1_000_000)
    target.insert(small_gicp.preprocess_points(map_points, downsampling_resolution=0.2)[0])

    def align(points: F64, start: F64) -> F64:
        cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=0.25)
        return np.asarray(small_gicp.align(target, cloud, init_T_target_source=start).T_target_source)

    return align


def _gicp(map_points: F64) -> Aligner:
    target, tree = small_gicp.preprocess_points(map_points, downsampling_resolution=0.2)

    def align(points: F64, start: F64) -> F64:
        cloud, _ = small_gicp.preprocess_points(points, downsampling_resolution=0.25)
        return np.asarray(small_gicp.align(target, cloud, tree, init_T_target_source=start).T_target_source)

    return align


def _localisation(sensor: str, path: Path, local_map: LocalMap) -> Figure:
    """The whole localiser over a drive."""
    items = list(read_drive(path))
    localiser = Localiser(local_map, read_header(path).T_vehicle_lidar)
    begin_s = perf_counter()
    estimates = [scan.estimate for item in items for scan in _push(localiser, item)]
    estimates += [scan.estimate for scan in localiser.flush()]
    spent_s = perf_counter() - begin_s
    error = localisation_error(estimates, _reference(path))
    detail = (
        f"95 %: {error.longitudinal_p95_m * 100:.1f} cm along, {error.lateral_p95_m * 100:.1f} cm across,"
        f" {error.heading_p95_deg:.3f}°; {error.n} scans"
    )
    return Figure(f"localisation, {sensor}, changed street", len(estimates) / spent_s, "scans/s", detail)


def _push(localiser: Localiser, item: DriveItem) -> list[RefinedScan]:
    if isinstance(item, MotionSample):
        localiser.push_motion(item)
    elif isinstance(item, GnssFix):
        localiser.push_gnss(item)
    elif isinstance(item, Scan):
        return localiser.push_scan(item)
    return []


def _reference(path: Path) -> Trajectory:
    track = load_track(path).reference
    return Trajectory(track.t_ns, track.T_map_vehicle)


def _true_scans(path: Path) -> list[tuple[F64, F64]]:
    """(points in the vehicle frame, true pose) of each scan, sweep motion removed."""
    reference, T_vehicle_lidar = _reference(path), read_header(path).T_vehicle_lidar
    return [
        (
            deskew(scan.points_m, scan.t_offset_ns, scan.t_ns, reference, T_vehicle_lidar, scan.t_ns),
            reference.at(scan.t_ns),
        )
        for scan in read_drive(path)
        if isinstance(scan, Scan)
    ]


def _map_of(path: Path) -> tuple[F64, LocalMap]:
    """All points of a mapping drive in the map frame, and their Gaussians."""
    frame, reference = read_header(path).anchor, _reference(path)
    lat, lon, _ = frame.geodetic_from_enu(reference.T_dst_vehicle[:, :3, 3])
    grid_frame = GridFrame.around(frame, covering_corridor(lat, lon, 70.0))
    points = np.concatenate([transform(T, near[np.linalg.norm(near, axis=1) < 70.0]) for near, T in _true_scans(path)])
    accumulator, local_map = VoxelAccumulator(grid_frame), LocalMap(grid_frame)
    accumulator.add(points)
    for tile_id, gaussians in accumulator.finish().items():
        local_map.set_tile(Tile(tile_id, 1, gaussians))
    return points, local_map
