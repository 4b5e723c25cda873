"""Helpers of the localisation tests: a map from drives with reference poses, and a drive replayed into a localiser."""

import time
from collections.abc import Iterable
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from gnd.gnd_map.accumulate import N_MIN_CELLS, VoxelAccumulator
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.grid import GridFrame
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import transform
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId, covering_corridor
from gnd.schemas.drive import GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise import Localiser, LocaliserParameters, PoseEstimate

REACH_M = 70.0


def reference_of(path: Path) -> Trajectory:
    """T_map_vehicle of a drive; map = ENU at its anchor."""
    track = load_track(path).reference
    return Trajectory(track.t_ns, track.T_map_vehicle)


def grid_frame_of(path: Path) -> GridFrame:
    """Grid of all tiles within reach of a drive, in its own map frame."""
    frame = read_header(path).anchor
    return GridFrame.around(frame, tiles_around(frame, reference_of(path)))


def tiles_around(frame: LocalFrame, track: Trajectory) -> tuple[TileId, ...]:
    lat, lon, _ = frame.geodetic_from_enu(track.T_dst_vehicle[:, :3, 3])
    return covering_corridor(lat, lon, REACH_M)


def map_of(paths: Iterable[Path], grid_frame: GridFrame) -> LocalMap:
    """The Gaussians of drives at their reference poses, in `grid_frame`."""
    accumulator = VoxelAccumulator(grid_frame)
    for path in paths:
        header, track = read_header(path), reference_of(path)
        T_map_drive = grid_frame.frame.T_self_other(header.anchor)
        for item in read_drive(path):
            if isinstance(item, Scan):
                t_ns = item.t_ns + int(item.t_offset_ns.max()) // 2
                near = np.linalg.norm(item.points_m, axis=1) < REACH_M
                points = deskew(
                    item.points_m[near], item.t_offset_ns[near], item.t_ns, track, header.T_vehicle_lidar, t_ns
                )
                accumulator.add(transform(T_map_drive @ track.at(t_ns), points))
    local_map = LocalMap(grid_frame)
    for tile_id, gaussians in accumulator.finish(N_MIN_CELLS).items():
        local_map.set_tile(Tile(tile_id, 1, gaussians))
    return local_map


@dataclass
class Replay:
    """What a localiser made of a drive."""

    localiser: Localiser
    final: list[PoseEstimate] = field(default_factory=list)
    online: list[PoseEstimate] = field(default_factory=list)
    scans: int = 0
    points: int = 0
    seconds: float = 0.0


def replay(path: Path, local_map: LocalMap, parameters: LocaliserParameters | None = None) -> Replay:
    """Feed a drive (but not its reference) to a localiser."""
    run = Replay(Localiser(local_map, read_header(path).T_vehicle_lidar, parameters))
    localiser = run.localiser
    for item in read_drive(path):
        start = time.perf_counter()
        match item:
            case MotionSample():
                localiser.push_motion(item)
            case GnssFix():
                localiser.push_gnss(item)
            case Scan():
                run.scans += 1
                refined = list(localiser.take_scan(item))
                run.final += [scan.estimate for scan in refined]
                run.points += sum(len(scan.points_map_m) for scan in refined)
            case ReferencePose():
                pass
        run.seconds += time.perf_counter() - start
        if localiser.online is not None and (not run.online or run.online[-1].t_ns != localiser.online.t_ns):
            run.online.append(localiser.online)
    run.final += [scan.estimate for scan in localiser.flush()]
    return run
