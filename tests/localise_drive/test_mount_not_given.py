"""Real scans whose files tell no mount, end to end: found at import, or while driving where an old file lacks it."""

import dataclasses
import io
import json
from pathlib import Path

import numpy as np
import pytest
from localised_street import localise
from rich.console import Console

from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive_mcap import DriveWriter, read_drive, read_header
from gnd.tile_store.build import build_map
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.importer import open_recording, prepared, write_drive
from gnd.vehicle_agent.importers.recording import Recording, RecordingAnchor
from gnd.vehicle_agent.localise_drive.account import print_account, summary
from gnd.vehicle_agent.localise_drive.run import LocalisedDrive, localise_drive
from gnd.vehicle_agent.localise_drive.tiles import StoreMap

HEIGHT_M = 1.73
"""Of the LiDAR of KITTI's car above the road."""
HEAD = "VERSION 0.7\nFIELDS x y z\nSIZE 4 4 4\nTYPE F F F\nCOUNT 1 1 1\nWIDTH {n}\nHEIGHT 1\nPOINTS {n}\nDATA binary\n"


def pcd_folder(recording: Recording, first: int, last: int, folder: Path) -> Path:
    """Scans of a recording as PCD files: neither poses, nor times, nor a mount."""
    folder.mkdir()
    for number in range(first, last):
        points = np.asarray(recording.read(number).points_m, np.float32)
        (folder / f"{number:06d}.pcd").write_bytes(HEAD.format(n=len(points)).encode() + points.tobytes())
    return folder


@pytest.fixture(scope="module")
def imported(shared_data: Path, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """(drive of the odd scans, store with a map of the even ones) of 40 scans of KITTI raw 0027."""
    out = tmp_path_factory.mktemp("mount")
    folder = pcd_folder(open_recording("auto", shared_data / "kitti_raw_0027"), 100, 140, out / "pcds")
    recording, track = prepared(open_recording("pcd", folder, RecordingAnchor(49.0, 8.4, 110.0)))
    assert any("mount estimated from the scans: LiDAR 1.7" in note for note in recording.notes)
    for half in ("even", "odd"):
        write_drive(recording, track, out / f"{half}.mcap", half, stand_ins=True)
    with SqliteStore(out / "map.sqlite") as store:
        build_map([out / "even.mcap"], store)
    return out / "odd.mcap", out / "map.sqlite"


def forgotten(drive: Path, target: Path) -> Path:
    """The drive as an older import wrote it: the LiDAR at the vehicle's origin."""
    header = read_header(drive)
    T = header.T_vehicle_lidar.copy()
    T[:3, 3] = 0.0
    with DriveWriter(
        target, dataclasses.replace(header, T_vehicle_lidar=T, mount="unsaid", mount_sigma=None)
    ) as writer:
        for item in read_drive(drive):
            writer.add(item)
    return target


def heights_off(drive: LocalisedDrive) -> np.ndarray:
    """(N,) of the refined poses [m]."""
    assert drive.reference is not None
    T = drive.reference.at(np.array([pose.t_ns for pose in drive.refined]))
    return np.array([pose.T_map_vehicle[2, 3] for pose in drive.refined]) - T[:, 2, 3]


@pytest.mark.slow
def test_a_folder_of_pcd_files_gets_its_mount_at_import(imported: tuple[Path, Path], tmp_path: Path) -> None:
    drive, store = imported
    header = read_header(drive)
    assert header.mount == "estimated"
    assert header.T_vehicle_lidar[2, 3] == pytest.approx(HEIGHT_M, abs=0.06)
    ran = localise(drive, store, "--out", str(tmp_path / "out"), "--json", "-")
    assert ran.exit_code == 0, ran.output
    calibration = json.loads(ran.stdout)["calibration"]
    assert calibration["mount_told"] == calibration["mount_used"]
    assert calibration["mount_used"]["height_m"] == pytest.approx(HEIGHT_M, abs=0.06)


@pytest.mark.slow
def test_a_lidar_on_the_road_is_set_where_it_is_before_the_first_pose(
    imported: tuple[Path, Path], tmp_path: Path
) -> None:
    """Before: the wheels pulled every pose down by 1.7 m."""
    drive, store = imported
    old = forgotten(drive, tmp_path / "old.mcap")
    with SqliteStore(store, create=False) as opened:
        found = localise_drive(old, StoreMap(opened, "ndt"))
    assert found.counts.calibration is not None
    said = found.counts.calibration.as_json()
    assert said["mount_told"]["height_m"] == 0.0
    assert said["mount_used"]["height_m"] == pytest.approx(HEIGHT_M, abs=0.06)
    assert said["mount_doubtful"] == ["height"]
    assert {(moment.health, moment.cause) for moment in found.moments[:2]} == {("lost", "mount")}
    assert np.abs(heights_off(found)).max() < 0.10
    good = [pose for pose in found.refined if pose.health == "good"]
    assert len(good) > 0.9 * len(found.refined) > 10
    assert found.reference is not None
    off = T_inverse(found.reference.at(np.array([pose.t_ns for pose in good])))
    off = off @ np.stack([pose.T_map_vehicle for pose in good])
    assert np.hypot(off[:, 0, 3], off[:, 1, 3]).max() < 0.15
    console = Console(file=io.StringIO(), width=200)
    print_account(console, summary(found), [])
    assert "header: LiDAR 0.00 m above the road" in " ".join(console.file.getvalue().split())
