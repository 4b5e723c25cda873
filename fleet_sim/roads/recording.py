"""Drives along roads as recordings: what a vehicle without LiDAR brings home, in the form of every other drive."""

import heapq
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Final

import numpy as np

from gnd.fleet_sim.roads.drive import RoadDrive
from gnd.schemas.drive import DriveHeader, DriveItem, GnssFix, MotionSample, ReferencePose
from gnd.schemas.drive_mcap import DriveWriter

_REFERENCE_EVERY: Final = 5


def write_road_drive(drive: RoadDrive, vehicle: str, path: Path) -> Path:
    """Write a drive as MCAP; the file appears complete or not at all.

    Args:
        drive: the drive.
        vehicle: pseudonym.
        path: the file to write.

    Returns:
        The path.

    Raises:
        DriveError: the file cannot be written.
    """
    header = DriveHeader(f"{drive.route.name}-{drive.seed}", vehicle, "none", drive.route.frame, np.eye(4))
    with DriveWriter(path, header) as writer:
        for item in items_of(drive):
            writer.add(item)
    return path


def items_of(drive: RoadDrive) -> Iterator[DriveItem]:
    """Yield what is recorded, in time order: motion, GNSS, looks, lanes, and the true poses as reference."""
    parts = (_motion(drive), _gnss(drive), _looks(drive), iter(drive.lane_looks), _reference(drive))
    return heapq.merge(*parts, key=lambda item: item.t_ns)


def _motion(drive: RoadDrive) -> Iterator[DriveItem]:
    columns = (drive.motion.t_ns, drive.motion.speed_mps, drive.motion.yaw_rate_radps)
    return (MotionSample(*row) for row in zip(*(column.tolist() for column in columns), strict=True))


def _looks(drive: RoadDrive) -> Iterator[DriveItem]:
    """The looks, with what was in the way of each."""
    field_rad = float(np.float32(drive.view.width_rad))
    for look, free_m in zip(drive.looks, drive.occluder_m, strict=True):
        hidden = np.isfinite(free_m).any()
        yield replace(look, free_m=free_m, free_field_rad=field_rad) if hidden else look


def _gnss(drive: RoadDrive) -> Iterator[DriveItem]:
    xyz = np.column_stack([drive.gnss.xy_m, np.zeros(len(drive.gnss.t_ns))])
    lat, lon, height = drive.route.frame.geodetic_from_enu(xyz)
    rows = zip(drive.gnss.t_ns.tolist(), lat.tolist(), lon.tolist(), height.tolist(), strict=True)
    return (GnssFix(*row, drive.gnss.sigma_m) for row in rows)


def _reference(drive: RoadDrive) -> Iterator[DriveItem]:
    for t_ns, (x, y, heading) in zip(
        drive.truth.t_ns[::_REFERENCE_EVERY].tolist(), drive.truth.poses[::_REFERENCE_EVERY].tolist(), strict=True
    ):
        T = np.eye(4)
        T[:2, :2] = [[np.cos(heading), -np.sin(heading)], [np.sin(heading), np.cos(heading)]]
        T[:2, 3] = x, y
        yield ReferencePose(t_ns, T)
