"""The files of a localised drive.

| file | |
|---|---|
| poses.tum, online.tum | refined and online poses, frame `map`: ENU at the drive's anchor |
| reference.tum | the drive's reference, interpolated at the times of the poses: other programs do not interpolate |
| poses.kitti, times.txt | the refined poses; reference.kitti: the reference, line by line beside them |
| poses.mcap | refined, online, reference: for Foxglove |
| track.csv, track.geojson | the refined poses on the Earth: for QGIS |
| health.json, summary.json | always |
| map.png, quality.png, errors.png | see `map_picture` |

Files of these names that an earlier run has left in the folder are removed, so that all belong together.
"""

import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

import numpy as np

from gnd.gnd_map.arrays import F64
from gnd.gnd_map.motion import Trajectory
from gnd.schemas.poses_mcap import HealthNote, PoseTrack, write_poses_mcap
from gnd.schemas.trajectory_files import write_kitti, write_text, write_times, write_tum
from gnd.vehicle_agent.errors import LocaliseError
from gnd.vehicle_agent.localise.estimates import PoseEstimate
from gnd.vehicle_agent.localise_drive.account import health_json
from gnd.vehicle_agent.localise_drive.geo import csv_text, geojson_text
from gnd.vehicle_agent.localise_drive.run import LocalisedDrive, trajectory_of
from gnd.vehicle_agent.localise_drive.stretches import HealthStretch, stretches_of

NAMES: Final = (
    "poses.tum", "online.tum", "reference.tum", "poses.kitti", "times.txt", "reference.kitti", "poses.mcap",
    "track.csv", "track.geojson", "health.json", "summary.json", "map.png", "quality.png", "errors.png",
)  # fmt: skip
LEVELS: Final = {"good": "info", "degraded": "warning", "lost": "error"}


def write_outputs(drive: LocalisedDrive, values: Mapping[str, Any], folder: Path, formats: Iterable[str]) -> list[Path]:
    """Write the files of the formats (`FORMATS`) and the two of JSON; each appears whole or not at all.

    Raises:
        LocaliseError: the folder cannot be made.
        TrajectoryError: a file cannot be written.
    """
    make_folder(folder)
    for name in NAMES:
        _remove(folder / name)
    written = [path for name in formats for path in FORMATS[name](drive, folder)]
    for name, content in (("health.json", health_json(drive)), ("summary.json", values)):
        write_text(folder / name, json.dumps(content, indent=1) + "\n")
        written.append(folder / name)
    return written


def make_folder(folder: Path) -> None:
    """Make the folder and those above it; `LocaliseError` when the system refuses."""
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise LocaliseError(f"{folder}: cannot make the folder: {error.strerror or error}") from None


def _remove(path: Path) -> None:
    try:
        path.unlink(missing_ok=True)
    except OSError as error:
        raise LocaliseError(f"{path}: cannot remove what an earlier run left: {error.strerror or error}") from None


def reference_at(drive: LocalisedDrive, estimates: Sequence[PoseEstimate]) -> Trajectory | None:
    """The reference at the times of the estimates that it covers; None without one, or when it covers none."""
    if drive.reference is None:
        return None
    first, last = int(drive.reference.t_ns[0]), int(drive.reference.t_ns[-1])
    t_ns = np.unique(np.array([e.t_ns for e in estimates if first <= e.t_ns <= last], np.int64))
    return Trajectory(t_ns, drive.reference.at(t_ns)) if len(t_ns) else None


def _tum(drive: LocalisedDrive, folder: Path) -> list[Path]:
    about = _about(drive)
    tracks = {"poses": trajectory_of(drive.refined), "online": trajectory_of(drive.online)}
    reference = reference_at(drive, [*drive.refined, *drive.online])
    if reference is not None:
        tracks["reference"] = reference
    for name, poses in tracks.items():
        write_tum(folder / f"{name}.tum", poses, f"{name}: {about}\nt[s] x y z[m] qx qy qz qw")
    return [folder / f"{name}.tum" for name in tracks]


def _about(drive: LocalisedDrive) -> str:
    anchor = drive.header.anchor
    lat_deg, lon_deg = np.degrees(anchor.lat_rad), np.degrees(anchor.lon_rad)
    return f"drive {drive.header.drive_id}, ENU at {lat_deg:.9f} deg, {lon_deg:.9f} deg, {anchor.height_m:.4f} m"


def _kitti(drive: LocalisedDrive, folder: Path) -> list[Path]:
    """The reference only when it covers every pose: rows must stand side by side."""
    poses, reference = trajectory_of(drive.refined), reference_at(drive, drive.refined)
    written = [folder / "poses.kitti", folder / "times.txt"]
    write_kitti(written[0], poses)
    write_times(written[1], poses.t_ns)
    if reference is not None and len(reference) == len(poses):
        written.append(folder / "reference.kitti")
        write_kitti(written[-1], reference)
    return written


def _health_text(stretch: HealthStretch) -> str:
    """Health with its cause, which may be good, too: a good pose on a stale map."""
    return stretch.health if stretch.cause == "none" else f"{stretch.health} ({stretch.cause.replace('_', ' ')})"


def _mcap(drive: LocalisedDrive, folder: Path) -> list[Path]:
    tracks = [_track("refined", drive.refined), _track("online", drive.online)]
    reference = reference_at(drive, [*drive.refined, *drive.online])
    if reference is not None:
        tracks.append(PoseTrack("reference", reference))
    notes = [HealthNote(one.first_ns, LEVELS[one.health], _health_text(one)) for one in stretches_of(drive.moments)]
    metadata = {"drive_id": drive.header.drive_id, "vehicle": drive.header.vehicle}
    path, moves = folder / "poses.mcap", drive.reference is None  # else /tf of the drive itself says where it was
    write_poses_mcap(path, drive.header.anchor, tracks, notes, metadata, moves_vehicle=moves)
    return [folder / "poses.mcap"]


def _track(name: str, estimates: Sequence[PoseEstimate]) -> PoseTrack:
    return PoseTrack(name, trajectory_of(estimates), position_cov_m2(estimates))


def position_cov_m2(estimates: Sequence[PoseEstimate]) -> F64 | None:
    """(N, 3, 3) covariances of the positions along the map's axes; None unless every estimate has one."""
    known = [(e.T_map_vehicle[:3, :3], e.covariance[3:, 3:]) for e in estimates if e.covariance is not None]
    if not known or len(known) < len(estimates):
        return None
    R, cov = (np.stack(column) for column in zip(*known, strict=True))
    turned: F64 = R @ cov @ np.swapaxes(R, 1, 2)
    return turned


def _geojson(drive: LocalisedDrive, folder: Path) -> list[Path]:
    write_text(folder / "track.csv", csv_text(drive))
    write_text(folder / "track.geojson", geojson_text(drive))
    return [folder / "track.csv", folder / "track.geojson"]


FORMATS: Final[Mapping[str, Callable[[LocalisedDrive, Path], list[Path]]]] = {
    "tum": _tum,
    "kitti": _kitti,
    "mcap": _mcap,
    "geojson": _geojson,
}
