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
    "ros": (".db3", ".db3.zstd", ".mcap.zstd"),
}
MAGIC: Final = {b"\x89MCAP0\r\n": "mcap", b"SQLite format 3\0": "ros"}
REFUSED: Final = {
    b"#ROSBAG V2.0": "a bag of ROS 1; make a bag of ROS 2 of it: rosbags-convert --src FILE.bag --dst FOLDER",
    b"\x28\xb5\x2f\xfd": "compressed with zstd; give the bag's folder with its metadata.yaml, or unzstd it",
}
"""First bytes of files that are known but not read, and what to do."""


def format_of(place: Path) -> str:
    """kitti, pcd, mcap, planes, apollo or radiate.

    Raises:
        ImportDriveError: nothing of the kind is there, or several kinds are.
    """
    if not place.exists():
        raise ImportDriveError(f"{place}: no such file or folder")
    if place.is_file():
        return _format_of_file(place)
    if files_of(place, "metadata.yaml") and "rosbag2" in (place / "metadata.yaml").read_text(errors="replace"):
        return "ros"
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
    """By its first bytes, whatever its name."""
    with place.open("rb") as stream:
        head = stream.read(64)
    for magic, kind in MAGIC.items():
        if head.startswith(magic):
            return kind
    for magic, what in REFUSED.items():
        if head.startswith(magic):
            raise ImportDriveError(f"{place}: {what}")
    kinds = ", ".join(dict.fromkeys(MAGIC.values()))
    raise ImportDriveError(
        f"{place}: no single file of a kind that is read ({kinds}); give the folder that holds the scans"
    )
