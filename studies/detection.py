"""How fast scans become evidence: simulated scans of the first street, true poses, one thread.

The map is made of the mapping drive's own scans. Times are of one call of `ChangeDetector.add_scan` (ray walk, six
cases, new points into voxels); the second figure is the ray kernel alone.
"""

from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header
from gnd.vehicle_agent.detect.detector import ChangeDetector
from gnd.vehicle_agent.detect.kernel import cast_rays, kernel_parameters, window_affine
from gnd.vehicle_agent.detect.parameters import DetectParameters
from gnd.vehicle_agent.detect.records import make_records
from gnd.vehicle_agent.local_map import LocalMap
from studies.frame.measure import Figure, median_s
from studies.frame.scans import local_map_of, rays

SEED, SCANS = 1, 30


def run() -> list[Figure]:
    """Measure both sensors of the simulations in default and paper mode."""
    figures: list[Figure] = []
    for sensor in ("VLP-16", "HDL-32E"):
        scans = _scans(sensor)
        local_map = _map_of(scans)
        for mode, parameters in (("default", DetectParameters()), ("paper", DetectParameters.paper())):
            figures += _measure(f"{sensor}, {mode}", scans, local_map, parameters)
    return figures


def _measure(
    name: str, scans: list[tuple[F64, F64]], local_map: LocalMap, parameters: DetectParameters
) -> list[Figure]:
    detector = ChangeDetector(local_map, parameters)
    n = len(scans)
    whole_s = median_s(lambda: [detector.add_scan(points, origins) for points, origins in scans]) / n
    kernel_s, voxels = _kernel_alone(scans, local_map, parameters)
    many = sum(len(points) for points, _ in scans) / n
    detail = f"{many:,.0f} rays and {voxels:,.0f} voxels a scan, {local_map.count:,} Gaussians"
    return [
        Figure(f"detection, {name}", 1 / whole_s, "scans/s", detail),
        Figure(f"ray kernel, {name}", kernel_s * 1e3, "ms/scan", f"{kernel_s / voxels * 1e9:.1f} ns a voxel"),
    ]


def _kernel_alone(
    scans: list[tuple[F64, F64]], local_map: LocalMap, parameters: DetectParameters
) -> tuple[float, float]:
    """Seconds a scan of the kernel alone, and how many voxels a scan's rays cross."""
    anchor_m = local_map.mean_map_m.mean(axis=0)
    records = make_records(local_map.mean_map_m, local_map.cov_m2, anchor_m, parameters)
    state, p = local_map.index.copy(), kernel_parameters(parameters)
    shape = state.shape
    jobs = []
    for points, origins in scans:
        A, b = window_affine(*local_map.grid_frame.affine(origins[0]), anchor_m, local_map.window_origin_g)
        jobs.append((points - anchor_m, origins - anchor_m, A, b, np.empty(len(points), np.uint8)))

    def cast() -> None:
        for points, origins, A, b, kept in jobs:
            cast_rays(
                points, origins, A, b, state.reshape(-1), shape, records.words, records.floats, records.block, p,
                np.zeros(len(points), np.bool_), kept,
            )  # fmt: skip

    steps = sum(float(np.abs(np.floor(p @ A.T + b) - np.floor(o @ A.T + b)).sum()) for p, o, A, b, _ in jobs)
    return median_s(cast) / len(jobs), steps / len(jobs)


def _scans(sensor: str) -> list[tuple[F64, F64]]:
    """(points, origins) of each scan in the map frame."""
    with TemporaryDirectory() as folder:
        path = Path(folder) / "drive.mcap"
        config = DriveConfig("bench", sensor, state="before", errors=PERFECT, car_share=0.0, scans=SCANS)
        simulate_drive(street(SEED), config, path)
        header, track = read_header(path), load_track(path)
        poses = Trajectory(track.reference.t_ns, track.reference.T_map_vehicle)
        scans = (item for item in read_drive(path) if isinstance(item, Scan))
        return [rays(scan, poses, header.T_vehicle_lidar, scan.t_ns) for scan in scans]


def _map_of(scans: list[tuple[F64, F64]]) -> LocalMap:
    world = street(SEED)
    frame = LocalFrame(world.lat_rad, world.lon_rad, world.height_m)
    grid_frame = GridFrame.around(frame, [TileId.from_geodetic(world.lat_rad, world.lon_rad)])
    accumulator = VoxelAccumulator(grid_frame)
    for points, _ in scans:
        accumulator.add(points)
    return local_map_of(grid_frame, accumulator.finish())
