"""A drive says only what was recorded: no place, fixes or motion of its own, no input destroyed, bad files named."""

import json
import os
import shutil
import threading
from pathlib import Path

import numpy as np
import pytest
from click.testing import CliRunner, Result
from recording_testing import scan_of, write_bin

from gnd.deploy.prepare import Source
from gnd.schemas.drive_mcap import drive_counts, read_header
from gnd.schemas.errors import NoPlace
from gnd.tile_store.build import drive_sources
from gnd.vehicle_agent.config import AgentConfig
from gnd.vehicle_agent.errors import ImportDriveError
from gnd.vehicle_agent.importer import import_recording
from gnd.vehicle_agent.importer_cli import import_drives
from gnd.vehicle_agent.importers.choices import Choices, mount_of_text
from gnd.vehicle_agent.importers.output import check_output
from gnd.vehicle_agent.importers.recording import RecordingAnchor
from gnd.vehicle_agent.vehicle import open_vehicle

ANCHOR = RecordingAnchor(35.6586, 139.7454, 40.0)
NOWHERE = Choices(nowhere=True)


def gnd_import(*arguments: object) -> Result:
    return CliRunner().invoke(import_drives, ["auto", *map(str, arguments)])


def test_without_a_place_there_is_no_drive(kitti_folder, tmp_path):
    with pytest.raises(ImportDriveError, match=r"nothing says where on the Earth.*--anchor.*--poses.*GNSS.*--nowhere"):
        import_recording("auto", kitti_folder, tmp_path / "a.mcap")
    assert not list(tmp_path.glob("*.mcap*"))


def test_a_drive_from_nowhere_is_marked_and_no_shared_map_takes_it(kitti_folder, tmp_path):
    import_recording("auto", kitti_folder, tmp_path / "a.mcap", choices=NOWHERE)
    assert read_header(tmp_path / "a.mcap").nowhere
    with pytest.raises(NoPlace, match="imported with --nowhere"):
        drive_sources([tmp_path / "a.mcap"])
    again = import_recording("auto", tmp_path / "a.mcap", tmp_path / "b.mcap", choices=NOWHERE)
    assert again.scans == 8
    assert read_header(tmp_path / "b.mcap").nowhere  # importing it again gives it no place
    import_recording("auto", kitti_folder, tmp_path / "c.mcap", anchor=ANCHOR)
    assert not read_header(tmp_path / "c.mcap").nowhere


def test_a_fleet_refuses_a_drive_from_nowhere(kitti_folder, tmp_path):
    from gnd.deploy.fleet_config import FleetConfig
    from gnd.deploy.prepare import prepare_recorded
    from gnd.deploy.run_folder import RunFolder

    import_recording("auto", kitti_folder, tmp_path / "a.mcap", choices=NOWHERE)
    with pytest.raises(NoPlace, match="no shared map may take it"):
        prepare_recorded(FleetConfig(), RunFolder(tmp_path / "run"), Source(drives=(tmp_path / "a.mcap",)))


def test_a_vehicle_refuses_a_drive_from_nowhere(kitti_folder, tmp_path):
    choices = Choices(nowhere=True, stand_ins=True)
    import_recording("auto", kitti_folder, tmp_path / "a.mcap", choices=choices)
    config = AgentConfig("probe", tmp_path / "a.mcap", tmp_path / "work")
    with pytest.raises(NoPlace, match="no shared map may take it"), open_vehicle(config, threading.Event()):
        pass


def same(path: Path) -> Path:
    return path


def linked(path: Path) -> Path:
    (path.parent / "link.mcap").symlink_to(path)
    return path.parent / "link.mcap"


def hard_linked(path: Path) -> Path:
    os.link(path, path.parent / "hard.mcap")
    return path.parent / "hard.mcap"


def roundabout(path: Path) -> Path:
    return path.parent / ".." / path.parent.name / path.name


@pytest.mark.parametrize("name", [same, linked, hard_linked, roundabout])
def test_the_input_is_never_written_over(kitti_folder, tmp_path, name):
    drive = tmp_path / "a.mcap"
    import_recording("auto", kitti_folder, drive, anchor=ANCHOR)
    before = drive.read_bytes()
    with pytest.raises(ImportDriveError, match="never writes over its input"):
        import_recording("auto", drive, name(drive))
    assert drive.read_bytes() == before


def test_a_file_that_is_no_drive_is_not_replaced(kitti_folder, tmp_path):
    (tmp_path / "a.mcap").write_text("somebody's notes")
    with pytest.raises(ImportDriveError, match="exists and is no drive"):
        import_recording("auto", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR)
    for path in (kitti_folder / "times.txt", kitti_folder / "velodyne" / "000000.bin"):
        with pytest.raises(ImportDriveError, match="never writes over its input"):
            check_output(path, kitti_folder)
    with pytest.raises(ImportDriveError, match="no folder"):
        check_output(tmp_path / "missing" / "a.mcap", kitti_folder)
    with pytest.raises(ImportDriveError, match="is a folder"):
        check_output(kitti_folder, tmp_path)


def test_one_bad_file_is_named_and_passed_over(kitti_folder, tmp_path):
    bad = kitti_folder / "velodyne" / "000003.bin"
    bad.write_bytes(bad.read_bytes()[:-5])
    imported = import_recording("auto", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR)
    assert (imported.scans, drive_counts(tmp_path / "a.mcap").scans) == (7, 7)
    assert len(imported.bad) == 1
    assert "000003.bin: 767995 bytes" in imported.bad[0]
    with pytest.raises(ImportDriveError, match=r"000003\.bin"):
        import_recording("auto", kitti_folder, tmp_path / "b.mcap", anchor=ANCHOR, choices=Choices(strict=True))
    assert not (tmp_path / "b.mcap").exists()


def test_without_o_it_is_only_listed(kitti_folder, tmp_path):
    result = gnd_import(kitti_folder)
    assert result.exit_code == 0, result.output
    assert "sequence: 8 scans" in result.output
    assert "place: not known" in result.output
    listed = json.loads(gnd_import(kitti_folder, "--json", "--anchor", "35.6,139.7,40").output)
    assert (listed["scans"], listed["place"]) == (8, [35.6, 139.7, 40.0])
    assert {one["kind"]: one["count"] for one in listed["holds"]} == {"kitti scans": 8, "fixes": 8}
    assert sorted(path.name for path in tmp_path.iterdir()) == ["sequence"]


def test_the_result_says_what_a_mapper_wants_to_know(kitti_folder, tmp_path):
    out = tmp_path / "a.mcap"
    result = gnd_import(kitti_folder, "-o", out, "--json", "--anchor", "35.6,139.7,40,90")
    quality = json.loads(result.stdout)["quality"]
    assert quality["duration_s"] == pytest.approx(0.7)
    assert quality["way_m"] == pytest.approx(3.5, abs=0.1)
    assert quality["gnss_m"] < 0.1
    assert quality["height_m"] == pytest.approx(1.73, abs=0.03)
    assert quality["posed"] == 1.0
    assert 0.005 < quality["thickness_m"] < 0.03  # the room's noise is 1 cm


def test_sensor_mount_and_heading_are_what_was_given(kitti_folder, tmp_path):
    out = tmp_path / "a.mcap"
    result = gnd_import(
        kitti_folder, "-o", out, "--anchor", "35.6,139.7,40,0", "--sensor", "OS1-64", "--mount", "1.5,0.1,1.73,0,0,0"
    )
    assert result.exit_code == 0, result.output
    header = read_header(out)
    assert (header.sensor_model, header.mount) == ("OS1-64", "given")
    assert f"next: gnd map build {out} -o map.sqlite" in result.output
    np.testing.assert_allclose(header.T_vehicle_lidar[:3, 3], [1.5, 0.1, 1.73])


def test_a_mount_as_angles_or_as_a_matrix(tmp_path):
    T = mount_of_text("1,2,3,0,0,90")
    np.testing.assert_allclose(T @ [1, 0, 0, 1], [1, 3, 3, 1], atol=1e-12)
    (tmp_path / "mount.txt").write_text("0.000000 -1.000000 0 1\n1.000000 0 0 2\n0 0 1.000001 3\n")
    np.testing.assert_allclose(mount_of_text(str(tmp_path / "mount.txt")), T, atol=1e-6)
    for text in ("1,2,3", "a,b,c,d,e,f", str(tmp_path / "nothing.txt")):
        with pytest.raises(ImportDriveError, match="--mount"):
            mount_of_text(text)
    (tmp_path / "mirror.txt").write_text("1 0 0 0\n0 -1 0 0\n0 0 1 0\n")
    with pytest.raises(ImportDriveError, match="mirrors"):
        mount_of_text(str(tmp_path / "mirror.txt"))


def with_points(folder: Path, change) -> Path:
    """The folder with every scan's points changed."""
    copy = folder.with_name("changed")
    shutil.copytree(folder, copy)
    for k in range(8):
        write_bin(copy / "velodyne" / f"{k:06d}.bin", change(scan_of(k)))
    return copy


def test_feet_are_found_against_the_fixes_and_taken_when_told(kitti_folder, tmp_path):
    """Over 3.5 m the benchmark's fixes of 2.5 m tell nothing, so they are made good ones here."""
    from dataclasses import replace

    from gnd.vehicle_agent.importer import import_opened, open_recording

    def opened(folder: Path, choices: Choices):
        recording = open_recording("auto", folder, ANCHOR, choices=choices)
        return replace(recording, gnss=tuple(replace(fix, sigma_m=0.02) for fix in recording.gnss))

    feet = with_points(kitti_folder, lambda points: points / 0.3048)
    with pytest.raises(ImportDriveError, match="count ft; give --units ft"):
        import_opened(opened(feet, Choices()), tmp_path / "a.mcap")
    right = import_opened(opened(feet, Choices(unit="ft")), tmp_path / "a.mcap")
    assert right.quality.way_m == pytest.approx(3.5, abs=0.1)


def test_z_downwards_is_found_against_the_ground(kitti_folder, tmp_path):
    flipped = with_points(kitti_folder, lambda points: points * [1.0, 1.0, -1.0])
    import_recording("auto", kitti_folder, tmp_path / "right.mcap", anchor=ANCHOR)
    notes = import_recording("auto", flipped, tmp_path / "a.mcap", anchor=ANCHOR).notes  # KITTI's mount is given
    assert any(note.startswith("warning: the ground lies 1.7") for note in notes)
    for path in (flipped / "calib.txt", flipped / "poses.txt"):
        path.unlink()
    with pytest.raises(ImportDriveError, match=r"ground lies 1\.7\d m \*above\* the LiDAR"):
        import_recording("auto", flipped / "velodyne", tmp_path / "b.mcap", anchor=ANCHOR)


def test_millimetres_are_found_by_their_size(kitti_folder, tmp_path):
    large = with_points(kitti_folder, lambda points: points * 1000.0)
    with pytest.raises(ImportDriveError, match=r"beyond 500 m: other units \(--units mm"):
        import_recording("auto", large, tmp_path / "a.mcap", anchor=ANCHOR)


def test_equal_times_are_named(kitti_folder, tmp_path):
    (kitti_folder / "times.txt").write_text("0\n.1\n.2\n.2\n.4\n.5\n.6\n.7\n")
    with pytest.raises(ImportDriveError, match="scan 3 is not later than the scan before it"):
        import_recording("auto", kitti_folder, tmp_path / "a.mcap", anchor=ANCHOR)
