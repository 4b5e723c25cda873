"""Vehicles whose recordings tell a wrong mount: they were driven with another than their header says."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from gnd.deploy.errors import DeployError
from gnd.gnd_map.se3 import exp_so3
from gnd.schemas.drive_mcap import DriveWriter, read_drive, read_header


def with_wrong_mounts(drives: Sequence[Path], wrong: Mapping[int, float], folder: Path) -> tuple[Path, ...]:
    """The drives, those of the vehicles in `wrong` as copies in `folder` whose headers tell another mount.

    What was measured stays as it is, as when a LiDAR was knocked and nobody has measured its mount again.

    Raises:
        DeployError: there is no such vehicle.
        DriveError: a drive cannot be read or written.
    """
    unknown = sorted(set(wrong) - set(range(len(drives))))
    if unknown:
        raise DeployError(f"no vehicle {unknown[0]}: the run has {len(drives)}, counted from 0")
    paths = list(drives)
    for vehicle, turn_rad in sorted(wrong.items()):
        folder.mkdir(parents=True, exist_ok=True)
        paths[vehicle] = folder / f"{vehicle:02d}-{drives[vehicle].name}"
        _write_turned(drives[vehicle], paths[vehicle], turn_rad)
    return tuple(paths)


def _write_turned(source: Path, target: Path, turn_rad: float) -> None:
    header = read_header(source)
    T_vehicle_lidar = header.T_vehicle_lidar.copy()
    T_vehicle_lidar[:3, :3] = exp_so3(np.array([0.0, 0.0, turn_rad])) @ T_vehicle_lidar[:3, :3]
    with DriveWriter(target, replace(header, T_vehicle_lidar=T_vehicle_lidar)) as writer:
        for item in read_drive(source):
            writer.add(item)
