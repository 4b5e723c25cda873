"""What scan-to-scan odometry is worth: online poses with and without it where wheels, map or GNSS fail.

A drive along the first street after it changed, with sensor errors, parked cars and the map from before. Poses are
compared as they come out at once; scans while the pose is not known count in their own column. Submaps are left out:
they would repair in hindsight what is looked at here.
"""

from collections.abc import Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from tempfile import TemporaryDirectory

import numpy as np

from gnd.fleet_sim.drives import DriveConfig, simulate_drive
from gnd.gnd_map.geodesy import LocalFrame
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.drive import DriveItem, GnssFix, MotionSample, Scan
from gnd.schemas.drive_mcap import read_drive
from gnd.vehicle_agent.local_map import LocalMap
from gnd.vehicle_agent.localise import LocaliserParameters, PoseEstimate, localisation_error
from studies.frame.measure import Figure
from studies.localisation_scenes import localising, mapped_street, note_newest, reference_of

SENSORS = ("VLP-16", "Scala")
HOLE_M = 60.0


@dataclass(frozen=True, slots=True)
class Trouble:
    """Seconds after the start: wheels show `wheel_share` of the speed in `slip_s`; no GNSS in `no_gnss_s`; the map has
    a hole of `HOLE_M` at half of the way.
    """

    slip_s: tuple[float, float] = (0.0, 0.0)
    wheel_share: float = 1.0
    no_gnss_s: tuple[float, float] = (0.0, 0.0)
    hole: bool = False


TROUBLES = {
    "no trouble": Trouble(),
    "wheels 10 % slow for 10 s": Trouble(slip_s=(5.0, 15.0), wheel_share=0.9),
    "wheels locked for 2 s": Trouble(slip_s=(8.0, 10.0), wheel_share=0.0),
    "hole in the map, no GNSS": Trouble(no_gnss_s=(4.0, 60.0), hole=True),
    "the same, wheels 10 % slow": Trouble(slip_s=(6.0, 16.0), wheel_share=0.9, no_gnss_s=(4.0, 60.0), hole=True),
}


def run() -> list[Figure]:
    """Every trouble with every sensor, with and without."""
    figures = []
    with TemporaryDirectory() as folder:
        world, _, local_map = mapped_street(Path(folder))
        for sensor in SENSORS:
            changed = DriveConfig("car", sensor, "after", seed=2, cruise_mps=12.0)
            path = simulate_drive(world, changed, Path(folder) / "drive.mcap")
            figures += [
                _figure(f"{sensor}, {name}, {'with' if enabled else 'without'}", path, local_map, trouble, enabled)
                for name, trouble in TROUBLES.items()
                for enabled in (False, True)
            ]
    return figures


def _figure(name: str, path: Path, local_map: LocalMap, trouble: Trouble, enabled: bool) -> Figure:
    reference = reference_of(path)
    held = with_hole(local_map, reference) if trouble.hole else local_map
    estimates, scans = online_poses(path, held, trouble, enabled)
    error = localisation_error(estimates, reference)
    detail = (
        f"longest {error.longitudinal_max_m * 100:.0f}; across {error.lateral_p95_m * 100:.1f} /"
        f" {error.lateral_max_m * 100:.0f} cm; heading {error.heading_p95_deg:.3f} / {error.heading_max_deg:.2f}°;"
        f" pose known in {len(estimates)} of {scans} scans"
    )
    return Figure(name, error.longitudinal_p95_m * 100, "cm along, 95 %", detail)


def online_poses(path: Path, local_map: LocalMap, trouble: Trouble, enabled: bool) -> tuple[list[PoseEstimate], int]:
    """The online poses of a drive, those that are called lost left out, and the number of its scans."""
    vehicle = localising(path, local_map, parameters_of(enabled))
    estimates: list[PoseEstimate] = []
    scans = 0
    for item in troubled(read_drive(path), trouble):
        scans += isinstance(item, Scan)
        note_newest(vehicle.push(item), estimates)
    return estimates, scans


def parameters_of(enabled: bool) -> LocaliserParameters:
    """With or without scan-to-scan odometry, without submaps."""
    default = LocaliserParameters()
    scan_odometry = replace(default.scan_odometry, enabled=enabled)
    return replace(default, scan_odometry=scan_odometry, refine=replace(default.refine, enabled=False))


def troubled(items: Iterator[DriveItem], trouble: Trouble) -> Iterator[DriveItem]:
    """What arrives of a drive under such trouble."""
    start_ns: int | None = None
    for item in items:
        start_ns = item.t_ns if start_ns is None else start_ns
        now_s = (item.t_ns - start_ns) * 1e-9
        if isinstance(item, MotionSample) and trouble.slip_s[0] <= now_s < trouble.slip_s[1]:
            yield replace(item, speed_mps=item.speed_mps * trouble.wheel_share)
        elif not (isinstance(item, GnssFix) and trouble.no_gnss_s[0] <= now_s < trouble.no_gnss_s[1]):
            yield item


def with_hole(local_map: LocalMap, reference: Trajectory) -> LocalMap:
    """The map without the tiles whose middle lies within half of `HOLE_M` of the way's middle, measured along it."""
    p = reference.T_dst_vehicle[:, :3, 3]
    way_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(p, axis=0), axis=1))])
    middle = int(np.searchsorted(way_m, 0.5 * way_m[-1]))
    forward = reference.T_dst_vehicle[middle, :3, 0]
    holed = LocalMap(local_map.grid_frame)
    for tile_id in local_map.tiles:
        T_map_tile = local_map.grid_frame.frame.T_self_other(LocalFrame.of_tile(tile_id))
        tile = local_map.tile(tile_id)
        if tile is not None and abs(float((T_map_tile[:3, 3] - p[middle]) @ forward)) > 0.5 * HOLE_M:
            holed.set_tile(tile)
    return holed
