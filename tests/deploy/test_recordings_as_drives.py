"""`gnd map build` and `gnd fleet` take recordings where drives are asked for, and each names the command after it."""

import json
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner

from gnd.deploy.cli import gnd
from gnd.deploy.errors import DeployError
from gnd.deploy.made_up import made_up_lines
from gnd.deploy.next_commands import after_fleet, after_map_build
from gnd.deploy.recordings import drives_of
from gnd.deploy.run_folder import RunFolder
from gnd.deploy.source import Source
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import DriveHeader, GnssFix, MotionSample, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter, is_drive
from gnd.schemas.errors import DriveError
from gnd.vehicle_agent.errors import ImportDriveError

ANCHOR = LocalFrame(np.radians(49.0), np.radians(8.4), 100.0)
SAID: list[str] = []


def a_drive(path: Path, *, driveable: bool = True) -> Path:
    path.parent.mkdir(parents=True, exist_ok=True)
    with DriveWriter(path, DriveHeader("d", "v", "VLP-16", ANCHOR, np.eye(4))) as writer:
        writer.add(ReferencePose(10, np.eye(4)))
        writer.add(Scan(10, np.ones((5, 3), np.float32), np.zeros(5, np.uint32)))
        if driveable:
            writer.add(GnssFix(20, ANCHOR.lat_rad, ANCHOR.lon_rad, 100.0, 1.0))
            writer.add(MotionSample(20, 1.0, 0.0))
    return path


def test_drives_and_folders_of_drives_stay_as_they_are(tmp_path: Path) -> None:
    one, two = a_drive(tmp_path / "day" / "a.mcap"), a_drive(tmp_path / "day" / "b.mcap")
    single, missing = a_drive(tmp_path / "c.mcap"), tmp_path / "not there"
    out = tmp_path / "out"
    assert drives_of([tmp_path / "day", single, missing], out, SAID.append) == (one, two, single, missing)
    assert not out.exists()
    assert SAID == []


def test_a_damaged_drive_is_left_to_those_who_read_it(tmp_path: Path) -> None:
    path = a_drive(tmp_path / "a.mcap")
    path.write_bytes(path.read_bytes()[:-40])
    assert drives_of([path], tmp_path / "out", SAID.append) == (path,)
    with pytest.raises(DriveError, match="mcap recover"):
        is_drive(path)


def test_what_cannot_be_imported_in_passing_names_the_import(tmp_path: Path) -> None:
    (tmp_path / "empty").mkdir()
    with pytest.raises(ImportDriveError, match=r"gnd import auto \S*empty -o drive\.mcap \.\.\., and give drive\.mcap"):
        drives_of([tmp_path / "empty"], tmp_path / "out", SAID.append)


@pytest.mark.slow
def test_two_days_of_the_same_name_become_two_drives(shared_data: Path, tmp_path: Path) -> None:
    """Also: a recording without a place is refused with the option that gives it, and a store is not made then."""
    source = shared_data / "av2_pit_overlap" / "7fab2350"
    days = [tmp_path / name / "bag" for name in ("monday", "tuesday")]
    for day in days:
        day.parent.mkdir()
        day.symlink_to(source)
    said: list[str] = []
    drives = drives_of(days, tmp_path / "out", said.append)
    assert len(set(drives)) == 2
    assert all(is_drive(drive) for drive in drives)
    assert {drive.parent for drive in drives} == {tmp_path / "out"}
    assert any("used: scans" in line for line in said)
    result = CliRunner().invoke(
        gnd, ["map", "build", str(shared_data / "kitti00_start16"), "-o", str(tmp_path / "m.sqlite")]
    )
    assert "--anchor LAT,LON,HEIGHT" in str(result.exception)
    assert not (tmp_path / "m.sqlite").exists()


def test_the_commands_after_a_map_are_named(tmp_path: Path) -> None:
    drive = a_drive(tmp_path / "a.mcap")
    later, alone = after_map_build([drive], Path("map.sqlite"))
    assert later.startswith("next: gnd fleet --drives LATER --map map.sqlite --out healed (")
    assert f"gnd fleet --drives {drive} --agents 2 --map map.sqlite --made-up 4 --out healed" in alone
    _, hint = after_map_build([a_drive(tmp_path / "b.mcap", driveable=False)], Path("map.sqlite"))
    assert "--made-up" not in hint
    assert "--stand-ins" in hint


def test_the_commands_after_a_run_are_named(tmp_path: Path) -> None:
    folder = RunFolder(tmp_path / "run")
    changed, _ = after_fleet({"tiles_published": 2, "drive_km": 0.1}, Path("map.sqlite"), folder)
    assert changed.startswith(f"next: gnd map diff map.sqlite {folder.store} --to changes.gpkg")
    (nothing,) = after_fleet({"tiles_published": 0, "drive_km": 0.1}, Path("map.sqlite"), folder)
    assert nothing.startswith(f"next: gnd map status {folder.store}")
    lost, _ = after_fleet({"tiles_published": 0, "drive_km": 0.0}, Path("map.sqlite"), folder)
    assert lost.startswith("no vehicle found its place on map.sqlite: ")


def test_made_up_boxes_are_for_recordings() -> None:
    with pytest.raises(DeployError, match="--map takes a file"):
        Source((Path("a.mcap"),), Path("postgresql://gnd@db/gnd"))
    with pytest.raises(DeployError, match="--made-up goes with --drives"):
        Source(made_up=3)


def test_boxes_that_found_no_place_are_said() -> None:
    score = {"asked": 6, "boxes": 4, "boxes_in_map": 3, "voxels": 30, "voxels_in_map": 21, "changes_elsewhere": 2}
    (line,) = made_up_lines(json.loads(json.dumps(score)))
    assert line == (
        "made-up boxes: 3 of 4 (6 were asked for, no more bare places) are in the map now, 21 of their 30 voxels;"
        " voxels changed elsewhere: 2"
    )
    assert made_up_lines(None) == []
