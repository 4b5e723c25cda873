"""What the benchmarks of localisation look at: a street, its map from one drive, and drives through it."""

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from gnd.fleet_sim.drives import PERFECT, DriveConfig
from gnd.gnd_map.accumulate import VoxelAccumulator
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import covering_corridor
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header
from gnd.vehicle_agent.local_map import LocalMap

MAP_REACH_M = 70.0
MAPPING = DriveConfig("map", "HDL-32E", "before", errors=PERFECT, car_share=0.0, cruise_mps=12.0)


def map_of(path: Path) -> tuple[F64, LocalMap]:
    """All points of a mapping drive in the map frame, and their Gaussians."""
    frame, reference = read_header(path).anchor, reference_of(path)
    lat, lon, _ = frame.geodetic_from_enu(reference.T_dst_vehicle[:, :3, 3])
    grid_frame = GridFrame.around(frame, covering_corridor(lat, lon, MAP_REACH_M))
    near = ((T, p[np.linalg.norm(p, axis=1) < MAP_REACH_M]) for p, T in true_scans(path))
    points = np.concatenate([transform(T, p) for T, p in near])
    accumulator, local_map = VoxelAccumulator(grid_frame), LocalMap(grid_frame)
    accumulator.add(points)
    for tile_id, gaussians in accumulator.finish().items():
        local_map.set_tile(Tile(tile_id, 1, gaussians))
    return points, local_map


def reference_of(path: Path) -> Trajectory:
    """T_map_vehicle of a simulated drive."""
    track = load_track(path).reference
    return Trajectory(track.t_ns, track.T_map_vehicle)


def true_scans(path: Path) -> Iterator[tuple[F64, F64]]:
    """(points in the vehicle frame, true pose) of each scan, sweep motion removed."""
    reference, T_vehicle_lidar = reference_of(path), read_header(path).T_vehicle_lidar
    for scan in read_drive(path):
        if isinstance(scan, Scan):
            points = deskew(scan.points_m, scan.t_offset_ns, scan.t_ns, reference, T_vehicle_lidar, scan.t_ns)
            yield points, reference.at(scan.t_ns)
