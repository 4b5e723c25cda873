"""Simulated drives as recordings that lost what tests ask to be found: times of points, order of points, mount."""

from collections.abc import Callable
from pathlib import Path

import numpy as np

from gnd.fleet_sim.drives import PERFECT, DriveConfig, simulate_drive
from gnd.fleet_sim.street import street
from gnd.gnd_map.motion import Trajectory, deskew
from gnd.gnd_map.se3 import T_inverse, transform
from gnd.schemas.drive import Scan
from gnd.schemas.drive_mcap import load_track, read_drive, read_header
from gnd.vehicle_agent.importers.recording import Recording, RecordingAnchor


def drive_of(path: Path, sensor: str = "VLP-16", seed: int = 2, scans: int = 40, world: int = 1) -> Path:
    """A drive along a street at 12 m/s without sensor errors."""
    config = DriveConfig("car", sensor, "after", seed=seed, cruise_mps=12.0, scans=scans, errors=PERFECT)
    return simulate_drive(street(world), config, path)


def scans_of(path: Path) -> list[Scan]:
    return [item for item in read_drive(path) if isinstance(item, Scan)]


def truth_of(path: Path) -> Trajectory:
    return Trajectory(*load_track(path).reference)


def recording_of(path: Path, change: Callable[[Scan], Scan], **said) -> Recording:
    """The scans of a drive, changed, and nothing else of it; `said` joins what the recording says."""
    header, scans = read_header(path), [change(scan) for scan in scans_of(path)]
    anchor = RecordingAnchor(
        np.degrees(header.anchor.lat_rad), np.degrees(header.anchor.lon_rad), header.anchor.height_m
    )
    t_ns = np.array([scan.t_ns for scan in scans])
    mount = said.pop("T_vehicle_lidar", header.T_vehicle_lidar)
    return Recording(path.stem, header.sensor_model, "", mount, t_ns, scans.__getitem__, anchor, **said)


def without_times(scan: Scan) -> Scan:
    """As fired, times forgotten."""
    return Scan(scan.t_ns, scan.points_m, np.zeros(len(scan), np.uint32), scan.ring)


def ring_by_ring(scan: Scan) -> Scan:
    """Times and firing order forgotten, as KITTI's files are: laser by laser, azimuths from 0 upwards in each."""
    azimuth = np.mod(np.arctan2(scan.points_m[:, 1], scan.points_m[:, 0]), 2.0 * np.pi)
    order = np.lexsort((azimuth, scan.ring))
    return Scan(scan.t_ns, np.ascontiguousarray(scan.points_m[order]), np.zeros(len(scan), np.uint32), None)


def mirrored(scan: Scan) -> Scan:
    """The same world, left and right exchanged: the sensor turns the other way."""
    return Scan(scan.t_ns, scan.points_m * np.float32([1, -1, 1]), scan.t_offset_ns, scan.ring)


def freed_of_motion(path: Path) -> Callable[[Scan], Scan]:
    """Sweeps as if all points had been measured in the middle, by the true motion."""
    truth, T_vehicle_lidar = truth_of(path), read_header(path).T_vehicle_lidar

    def change(scan: Scan) -> Scan:
        middle_ns = scan.t_ns + 50_000_000
        still = deskew(scan.points_m, scan.t_offset_ns, scan.t_ns, truth, T_vehicle_lidar, middle_ns)
        points = transform(T_inverse(T_vehicle_lidar), still).astype(np.float32)
        return ring_by_ring(Scan(scan.t_ns, np.ascontiguousarray(points), scan.t_offset_ns, scan.ring))

    return change


def mounted_otherwise(path: Path, T_vehicle_other: np.ndarray) -> Callable[[Scan], Scan]:
    """Scans of the same drive by a LiDAR that looks another way from the same place."""
    T_other_lidar = T_inverse(T_vehicle_other) @ read_header(path).T_vehicle_lidar

    def change(scan: Scan) -> Scan:
        points = transform(T_other_lidar, scan.points_m).astype(np.float32)
        return Scan(scan.t_ns, np.ascontiguousarray(points), scan.t_offset_ns, scan.ring)

    return change
