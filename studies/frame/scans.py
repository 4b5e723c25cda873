"""Scans freed of their sweep's motion by known poses, and maps that are held whole: what many studies begin with."""

from collections.abc import Mapping

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.drive import Scan
from gnd.vehicle_agent.local_map import LocalMap


def posed(scan: Scan, poses: Trajectory, T_vehicle_lidar: F64, t_ns: int | None = None) -> tuple[F64, F64]:
    """Points (N, 3) in the vehicle frame at a time (the scan's begin where none is given), and its pose (4, 4) then."""
    t_ns = scan.t_ns if t_ns is None else t_ns
    return deskew(scan.points_m, scan.t_offset_ns, scan.t_ns, poses, T_vehicle_lidar, t_ns), poses.at(t_ns)


def rays(scan: Scan, poses: Trajectory, T_vehicle_lidar: F64, t_ns: int) -> tuple[F64, F64]:
    """Ends and origins (N, 3) of the rays of a scan that rests on its pose at a time, frame of the poses."""
    T = poses.at(t_ns)
    ends, origins = (
        transform(T, deskew(p, scan.t_offset_ns, scan.t_ns, poses, T_vehicle_lidar, t_ns))
        for p in (scan.points_m, np.zeros_like(scan.points_m))
    )
    return ends, origins


def local_map_of(grid_frame: GridFrame, tiles: Mapping[TileId, Gaussians]) -> LocalMap:
    """Tiles of version 1, held."""
    held = LocalMap(grid_frame)
    for tile_id, gaussians in tiles.items():
        held.set_tile(Tile(tile_id, 1, gaussians))
    return held
