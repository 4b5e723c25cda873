"""Drives that brake, accelerate and swerve, with the stamps of the motion samples shifted against the scans'."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path

from gnd.fleet_sim.drives import DriveConfig, DriveSimulation, simulate_drive
from gnd.fleet_sim.street import street
from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveHeader, DriveItem, MotionSample
from gnd.schemas.drive_mcap import DriveWriter, read_drive
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise import Localiser, PoseEstimate
from gnd.vehicle_agent.pipeline import Output
from gnd.vehicle_agent.sources.recording import first_fix
from gnd.vehicle_agent.tiles_at_hand import localising_on
from studies.localisation_scenes import MAPPING, map_of, reference_of


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


def note_newest(output: Output, estimates: list[PoseEstimate]) -> None:
    """Append the online pose when it is a new one that is not lost."""
    online = output.online
    if online is not None and online.health != "lost" and (not estimates or online.t_ns > estimates[-1].t_ns):
        estimates.append(online)
