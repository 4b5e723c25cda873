"""nuScenes: scenes of a data set with its tables; sweeps of LIDAR_TOP with poses of the vehicle.

`v1.0-*/sample_data.json`, `ego_pose.json`, `calibrated_sensor.json`, `sensor.json`, `scene.json`, `log.json`; sweeps
are `.pcd.bin` files of five float32: x, y, z, intensity, ring. Poses are in the map of one of four places, x east and y
north from an origin that nuScenes's tools give; its heights are not told.
"""

from pathlib import Path
from typing import Any, Final

import numpy as np
from numpy.typing import NDArray

from gnd.gnd_map.bounded import json_value
from gnd.gnd_map.se3 import R_from_quaternion_xyzw, T_from_R_t
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importers.attached_poses import with_table
from gnd.vehicle_agent.importers.bins import read_bin
from gnd.vehicle_agent.importers.choices import Choices
from gnd.vehicle_agent.importers.files import named_file
from gnd.vehicle_agent.importers.recording import NOMINAL, Entry, Recording, RecordingAnchor
from gnd.vehicle_agent.importers.trajectories.pose_table import PoseTable

F64 = NDArray[np.float64]
Row = dict[str, Any]

ORIGINS_DEG: Final = {
    "boston-seaport": (42.336849169438615, -71.05785369873047),
    "singapore-onenorth": (1.2882100868743724, 103.78475189208984),
    "singapore-hollandvillage": (1.2993652317780957, 103.78217697143555),
    "singapore-queenstown": (1.2782562240223188, 103.76741409301758),
}
"""nuscenes-devkit, python-sdk/nuscenes/scripts/export_poses.py."""
SPHERE_M: Final = 6.378137e6
"""The radius with which those tools go from metres to degrees."""
CHANNEL: Final = "LIDAR_TOP"
TABLES: Final = ("sample_data", "ego_pose", "calibrated_sensor", "sensor", "sample", "scene", "log")


def is_nuscenes(folder: Path) -> bool:
    """Whether a folder holds the tables of the data set."""
    return any((path / "sample_data.json").is_file() for path in (folder, *folder.glob("v1.0-*")))


def open_nuscenes(folder: Path, anchor: RecordingAnchor | None, choices: Choices | None = None) -> Recording:
    """A scene of the data set; of several the one that `choices.topic` names.

    Raises:
        ImportDriveError: tables that are missing or do not fit each other, several scenes, no sweeps, a sweep's file
            outside of the data set.
    """
    choices = choices or Choices()
    root = next(path for path in (*folder.glob("v1.0-*"), folder) if (path / "sample_data.json").is_file())
    tables = {name: _table(root / f"{name}.json") for name in TABLES}
    base = root if root == folder and not root.name.startswith("v1.0") else root.parent
    try:
        return _open(base, root / "sample_data.json", tables, anchor, choices)
    except KeyError as error:
        raise ImportDriveError(f"{root}: tables that do not fit each other: no {error}") from None


def _open(
    base: Path, listed: Path, tables: dict[str, dict[str, Row]], anchor: RecordingAnchor | None, choices: Choices
) -> Recording:
    scene = _scene(base, tables["scene"], choices.topic)
    rows = _sweeps(tables, scene["token"])
    files = [named_file(base, row["filename"], listed) for row in rows]
    rows = [row for row, path in zip(rows, files, strict=True) if path.is_file()]
    files = [path for path in files if path.is_file()]
    if len(rows) < 2:
        raise ImportDriveError(f"{base}: scene {scene['name']}: {len(rows)} sweeps of {CHANNEL}; at least 2 are needed")
    calibration = tables["calibrated_sensor"][rows[0]["calibrated_sensor_token"]]
    location = tables["log"][scene["log_token"]]["location"]
    t_ns = np.array([row["timestamp"] * 1_000 for row in rows], np.int64)
    recording = Recording(
        name=scene["name"],
        sensor_model="HDL-32E",
        source="nuScenes (Caesar et al.), CC BY-NC-SA 4.0",
        T_vehicle_lidar=_pose(calibration),
        t_ns=t_ns,
        read=lambda i: read_bin(files[i], int(t_ns[i]), 5),
        anchor=anchor or NOMINAL,
        placed=anchor is not None,
        entries=(
            Entry(CHANNEL, ".pcd.bin sweeps", len(rows), f"float32 x y z intensity ring; {location}", "scans"),
            *(Entry(one["name"], "scene", one["nbr_samples"], "", "", f"--topic {one['name']} takes it")
              for one in tables["scene"].values() if one is not scene),
        ),
    )  # fmt: skip
    T = np.stack([_pose(tables["ego_pose"][row["ego_pose_token"]]) for row in rows])
    stamps = np.array([tables["ego_pose"][row["ego_pose_token"]]["timestamp"] * 1_000 for row in rows], np.int64)
    taken = Choices(anchor=anchor, poses_of="vehicle", nowhere=choices.nowhere and anchor is None)
    return with_table(recording, base, taken, _geodetic(scene["name"], location, stamps, T))


def _table(path: Path) -> dict[str, Row]:
    try:
        return {row["token"]: row for row in json_value(path.read_text())}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ImportDriveError(f"{path}: no table of nuScenes: {error}") from None


def _scene(base: Path, scenes: dict[str, Row], wanted: str | None) -> Row:
    names = {row["name"]: row for row in scenes.values()}
    if wanted is not None and wanted in names:
        return names[wanted]
    listed = ", ".join(sorted(names)[:20])
    if wanted is not None or len(names) != 1:
        asked = f"scene {wanted} is not there; " if wanted else ""
        raise ImportDriveError(f"{base}: {asked}{len(names)} scenes ({listed}); choose one with --topic")
    return next(iter(names.values()))


def _sweeps(tables: dict[str, dict[str, Row]], scene: str) -> list[Row]:
    """Rows of the scene's sweeps, in time order."""
    found = []
    for row in tables["sample_data"].values():
        sensor = tables["calibrated_sensor"][row["calibrated_sensor_token"]]["sensor_token"]
        if (
            tables["sensor"][sensor]["channel"] == CHANNEL
            and tables["sample"][row["sample_token"]]["scene_token"] == scene
        ):
            found.append(row)
    return sorted(found, key=lambda row: row["timestamp"])


def _pose(row: Row) -> F64:
    w, x, y, z = row["rotation"]
    return T_from_R_t(R_from_quaternion_xyzw((x, y, z, w)), row["translation"])


def _geodetic(name: str, location: str, t_ns: NDArray[np.int64], T: F64) -> PoseTable:
    """Poses with latitude and longitude as nuScenes's tools compute them."""
    if location not in ORIGINS_DEG:
        return PoseTable(name, t_ns, T[:, :3, 3].copy(), T[:, :3, :3].copy(), "local")
    lat0, lon0 = np.radians(ORIGINS_DEG[location])
    east, north, up = T[:, :3, 3].T
    distance, bearing = np.hypot(east, north) / SPHERE_M, np.arctan2(east, north)
    lat = np.arcsin(np.sin(lat0) * np.cos(distance) + np.cos(lat0) * np.sin(distance) * np.cos(bearing))
    lon = lon0 + np.arctan2(
        np.sin(bearing) * np.sin(distance) * np.cos(lat0), np.cos(distance) - np.sin(lat0) * np.sin(lat)
    )
    notes = (f"place of {location} by nuScenes's tools: good to some metres; heights are those of its map",)
    return PoseTable(name, t_ns, np.column_stack([lat, lon, up]), T[:, :3, :3].copy(), "geodetic", notes=notes)
