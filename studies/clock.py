"""What a clock of wheels and gyro that differs from the LiDAR's does to poses, and how well its offset is found.

Drives that brake, accelerate and swerve through streets that have changed since their map; the stamps of the motion
samples are shifted by so many milliseconds before the localiser sees them. Decision 0086.
"""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation, simulate_drive
from gnd.fleet_sim.street import street
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveHeader, DriveItem, MotionSample
from gnd.schemas.drive_mcap import DriveWriter, read_drive
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise import Localiser, PoseEstimate, localisation_error
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import localising_on
from studies.frame.measure import Figure
from studies.localisation_scenes import MAPPING, map_of, note_newest, reference_of

DRIVES = ((3, "VLP-16"), (3, "HDL-64E"), (11, "VLP-16"), (12, "VLP-16"))
OFFSETS_MS = (0, -50, 50)
SCANS = 150


@dataclass(frozen=True, slots=True, eq=False)
class ClockDrive:
    """A drive, what is true of it, and the map that it is to be localised on."""

    items: tuple[DriveItem, ...]
    header: DriveHeader
    reference: Trajectory
    local_map: LocalMap


@dataclass(frozen=True, slots=True, eq=False)
class ClockRun:
    """What a localiser made of a drive."""

    localiser: Localiser
    refined: tuple[PoseEstimate, ...]
    online: tuple[PoseEstimate, ...]


def brisk_drive(seed: int, sensor: str, scans: int, folder: Path) -> ClockDrive:
    """A drive of 5 to 12 m/s with up to 2.1 m/s² and swerves of 0.9 m through a street, and the street's old map."""
    world = street(seed)
    config = DriveConfig("car", sensor, "after", cruise_mps=8.5, seed=2, scans=scans)
    drive, path = DriveSimulation(world, config), folder / "drive.mcap"
    style = replace(
        drive.motion.style, wave_mps=3.5, wave_radps=0.6, start_share=0.8, wander_m=0.9, wander_length_m=50.0
    )
    drive.motion = replace(drive.motion, style=style)
    with DriveWriter(path, drive.header()) as writer:
        for item in drive.items():
            writer.add(item)
    _, local_map = map_of(simulate_drive(world, MAPPING, folder / "map.mcap"))
    return ClockDrive(tuple(read_drive(path)), drive.header(), reference_of(path), local_map)


def driven(recorded: ClockDrive, offset_s: Callable[[float], float], T_vehicle_lidar: F64 | None = None) -> ClockRun:
    """Localise with motion samples stamped late by `offset_s` of the time since the start [s], or another mount."""
    mount = recorded.header.T_vehicle_lidar if T_vehicle_lidar is None else T_vehicle_lidar
    fix, items = first_fix(_shifted(recorded.items, offset_s), recorded.header.drive_id)
    pipeline = localising_on(recorded.local_map, replace(recorded.header, T_vehicle_lidar=mount), fix)
    refined, online = list[PoseEstimate](), list[PoseEstimate]()
    for item in items:
        output = pipeline.push(item)
        refined += output.poses
        note_newest(output, online)
    return ClockRun(pipeline.localiser, (*refined, *pipeline.finish().poses), tuple(online))


def _shifted(items: Sequence[DriveItem], offset_s: Callable[[float], float]) -> list[DriveItem]:
    """The items in the order of their stamps, those of the motion samples shifted."""
    start_ns = items[0].t_ns
    shifted = [
        replace(item, t_ns=item.t_ns + round(offset_s((item.t_ns - start_ns) * 1e-9) * 1e9))
        if isinstance(item, MotionSample)
        else item
        for item in items
    ]
    return sorted(shifted, key=lambda item: item.t_ns)


def run() -> list[Figure]:
    """Measure the drives at each offset."""
    figures: list[Figure] = []
    with TemporaryDirectory() as folder:
        for seed, sensor in DRIVES:
            recorded = brisk_drive(seed, sensor, SCANS, Path(folder))
            figures += [_figure(f"street {seed}, {sensor}", recorded, ms) for ms in OFFSETS_MS]
    return figures


def _figure(name: str, recorded: ClockDrive, offset_ms: int) -> Figure:
    made = driven(recorded, lambda _: offset_ms * 1e-3)
    refined, online = (localisation_error(poses, recorded.reference) for poses in (made.refined, made.online))
    known = made.localiser.calibration
    good = float(np.mean([pose.health == "good" for pose in made.refined]))
    return Figure(
        f"refined along, 95 %, {offset_ms:+d} ms, {name}",
        100.0 * refined.longitudinal_p95_m,
        "cm",
        f"found {known.time_offset_s * 1e3:+.1f} ± {known.time_offset_sigma_s * 1e3:.1f} ms; across"
        f" {refined.lateral_p95_m * 100:.1f} cm, {refined.heading_p95_deg:.3f}°; online"
        f" {online.longitudinal_p95_m * 100:.1f} cm, {online.lateral_p95_m * 100:.1f} cm; {good:.0%} good",
    )
