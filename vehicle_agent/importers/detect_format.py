"""Which format a folder or a file is of, found from what lies in it."""

from collections.abc import Callable
from pathlib import Path
from typing import Final

from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.apollo import is_apollo
from gnd.vehicle_agent.importers.argoverse_logs import is_argoverse
from gnd.vehicle_agent.importers.bins import has_rings, looks_like_kitti
from gnd.vehicle_agent.importers.files import files_below, files_of
from gnd.vehicle_agent.importers.kitti_raw import is_kitti_raw
from gnd.vehicle_agent.importers.nuscenes import is_nuscenes
from gnd.vehicle_agent.importers.pcap import is_pcap

ENDINGS: Final = {
    "bin": (".bin", ".bin.xz"),
    "pcd": (".pcd", ".pcd.xz"),
    "mcap": (".mcap",),
    "planes": (".xyz_mm", ".xyz_mm.xz"),
    "ros": (".db3", ".db3.zstd", ".mcap.zstd"),
    "las": (".las", ".laz"),
    "pcap": (".pcap", ".pcapng"),
}
FOLDERS: Final[dict[str, Callable[[Path], bool]]] = {
    "ros": lambda place: "rosbag2_bagfile_information" in _text(place / "metadata.yaml"),
    "radiate": lambda place: bool(files_of(place, "GPS_IMU_Twist.txt", "velo_lidar*")),
    "apollo": is_apollo,
    "nuscenes": is_nuscenes,
    "argoverse": is_argoverse,
    "kitti-raw": is_kitti_raw,
}
"""Formats that are known by what lies beside the scans."""
HINTS: Final = {
    ".bag": "a bag of ROS 1; make a bag of ROS 2 of it: rosbags-convert --src FILE.bag --dst FOLDER",
    ".feather": "a log of Argoverse 2 is named by its folder (with city_SE3_egovehicle.feather and sensors/lidar)",
    ".ply": "PLY is not read; convert it to PCD: `pdal translate IN.ply OUT.pcd`, one file a sweep",
    ".e57": "E57 is not read; convert it to LAS: `pdal translate IN.e57 OUT.las`, one file a sweep",
    ".npy": "arrays without names are not read; write .pcd, or .bin of float32 x y z intensity",
    ".csv": "tables of points are not read; write .pcd, or .bin of float32 x y z intensity",
    ".h5": "HDF5 is not read; write .pcd, or .bin of float32 x y z intensity",
    ".tfrecord": "records of Waymo are not read; export sweeps as .pcd or .bin with poses as TUM",
}
MAGIC: Final = {b"\x89MCAP0\r\n": "mcap", b"SQLite format 3\0": "ros"}
REFUSED: Final = {
    b"#ROSBAG V2.0": "a bag of ROS 1; make a bag of ROS 2 of it: rosbags-convert --src FILE.bag --dst FOLDER",
    b"\x28\xb5\x2f\xfd": "compressed with zstd; give the bag's folder with its metadata.yaml, or unzstd it",
}
"""First bytes of files that are known but not read, and what to do."""


def format_of(place: Path) -> str:
    """The name of a format in `importer.FORMATS`.

    Raises:
        ImportDriveError: nothing of the kind is there, or several kinds are; with what to do where it is known.
    """
    if not place.exists():
        raise ImportDriveError(f"{place}: no such file or folder")
    if place.is_file():
        return _format_of_file(place)
    for kind, is_one in FOLDERS.items():
        if is_one(place):
            return kind
    found = {kind: len(files_below(place, *endings)) for kind, endings in ENDINGS.items()}
    held = [f"{n} of {kind}" for kind, n in found.items() if n]
    if len(held) == 1:
        return _by_content(place, max(found, key=lambda kind: found[kind]))
    if held:
        raise ImportDriveError(f"{place}: files {' and '.join(held)}: name the format, or the folder of one of them")
    raise ImportDriveError(f"{place}: {_what_else(place)}")


def _by_content(place: Path, kind: str) -> str:
    """Endings alone do not tell: `.bin` is of many sensors, and a file may hold something else than its name says."""
    path = files_below(place, *ENDINGS[kind])[0]
    if kind == "bin":
        return "kitti" if looks_like_kitti(place) and not has_rings(path) else "bin"
    if path.suffix != ".xz":
        with path.open("rb") as stream:
            head = stream.read(64)
        magics = {"las": (b"LASF",), "pcd": (b"#", b"VERSION", b"FIELDS")}
        if kind in magics and head and not head.startswith(magics[kind]):
            raise ImportDriveError(f"{path}: begins with {head[:12]!r}, which is no {kind.upper()}")
        if kind == "pcap":
            return _format_of_file(path)
    return kind


def _what_else(place: Path) -> str:
    """Why a folder is refused in which nothing known lies."""
    for ending, hint in HINTS.items():
        if files_below(place, ending):
            return f"files {ending}: {hint}"
    known = ", ".join(ending for endings in ENDINGS.values() for ending in endings)
    return f"no scans ({known}) below it"


def _format_of_file(place: Path) -> str:
    """By its first bytes, whatever its name."""
    with place.open("rb") as stream:
        head = stream.read(64)
    if is_pcap(head):
        return "pcap"
    for magic, kind in MAGIC.items():
        if head.startswith(magic):
            return kind
    for magic, what in REFUSED.items():
        if head.startswith(magic):
            raise ImportDriveError(f"{place}: {what}")
    kinds = ", ".join((*dict.fromkeys(MAGIC.values()), "pcap"))
    raise ImportDriveError(
        f"{place}: no single file of a kind that is read ({kinds}); give the folder that holds the scans"
    )


def _text(path: Path) -> str:
    return path.read_text(errors="replace") if path.is_file() else ""
