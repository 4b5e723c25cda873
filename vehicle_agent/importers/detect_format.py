"""Which format a folder or a file is of, found from what lies in it."""

from pathlib import Path
from typing import Final

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.apollo import is_apollo
from gnd.vehicle_agent.importers.files import files_below, files_of

ENDINGS: Final = {
    "kitti": (".bin", ".bin.xz"),
    "pcd": (".pcd", ".pcd.xz"),
    "mcap": (".mcap",),
    "planes": (".xyz_mm", ".xyz_mm.xz"),
}


def format_of(place: Path) -> str:
    """kitti, pcd, mcap, planes, apollo or radiate.

    Raises:
        ImportDriveError: nothing of the kind is there, or several kinds are.
    """
    if not place.exists():
        raise ImportDriveError(f"{place}: no such file or folder")
    if place.is_file():
        return _format_of_file(place)
    if files_of(place, "GPS_IMU_Twist.txt", "velo_lidar*"):
        return "radiate"
    if is_apollo(place):
        return "apollo"
    found = {kind: len(files_below(place, *endings)) for kind, endings in ENDINGS.items()}
    held = [f"{n} of {kind}" for kind, n in found.items() if n]
    if len(held) != 1:
        known = ", ".join(ending for endings in ENDINGS.values() for ending in endings)
        raise ImportDriveError(
            f"{place}: files {' and '.join(held)}: name the format" if held else f"{place}: no scans ({known}) below it"
        )
    return max(found, key=lambda kind: found[kind])


def _format_of_file(place: Path) -> str:
    if place.suffix == ".mcap":
        return "mcap"
    raise ImportDriveError(f"{place}: a single file must be an .mcap; give the folder that holds the scans")
