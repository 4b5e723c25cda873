"""`gnd localise` on a simulated drive: every file it writes, what it prints, and what it refuses."""

import csv
import json
import math
import signal
import threading
from itertools import pairwise
from pathlib import Path

import numpy as np
import pytest
from changed_street import SCANS
from localised_street import Ran, changed, localise, moved_north, refusal
from mcap.reader import make_reader

from gnd.deploy.cli import gnd
from gnd.gnd_map.motion import Trajectory
from gnd.gnd_map.se3 import T_inverse
from gnd.schemas.drive import DriveItem, GnssFix, ReferencePose, Scan
from gnd.schemas.drive_mcap import load_track, read_header
from gnd.schemas.trajectory_files import read_kitti, read_tum
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.localise_drive.command import ended_by_ctrl_c
from gnd.vehicle_agent.localise_drive.outputs import NAMES
from gnd.vehicle_agent.localise_drive.run import localise_drive
from gnd.vehicle_agent.localise_drive.stretches import stretches_of
from gnd.vehicle_agent.localise_drive.tiles import StoreMap


def offsets_m(found: Trajectory, true: Trajectory) -> np.ndarray:
    """Distance of each pose from the other at the same time."""
    T = T_inverse(true.at(found.t_ns)) @ found.T_dst_vehicle
    return np.linalg.norm(T[:, :3, 3], axis=1)


def mcap_counts(path: Path) -> dict[str, int]:
    """Messages by topic."""
    with path.open("rb") as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    return {c.topic: summary.statistics.channel_message_counts.get(c.id, 0) for c in summary.channels.values()}


def test_every_file_is_there_and_every_picture_is_one(ran: Ran) -> None:
    assert {path.name for path in ran.out.iterdir()} == set(NAMES)
    for path in ran.out.glob("*.png"):
        assert path.read_bytes().startswith(b"\x89PNG\r\n")


def test_poses_are_near_the_drives_own_reference_in_its_own_frame(ran: Ran) -> None:
    track = load_track(ran.drive).reference
    true = Trajectory(track.t_ns, track.T_map_vehicle)
    refined, online = read_tum(ran.out / "poses.tum"), read_tum(ran.out / "online.tum")
    assert len(refined) >= 0.5 * SCANS
    assert offsets_m(refined, true).max() < 0.15
    assert offsets_m(online, true).max() < 0.25


def test_the_reference_stands_beside_the_poses_time_by_time(ran: Ran) -> None:
    refined, reference = read_tum(ran.out / "poses.tum"), read_tum(ran.out / "reference.tum")
    track = load_track(ran.drive).reference
    assert set(refined.t_ns) <= set(reference.t_ns)
    assert offsets_m(reference, Trajectory(track.t_ns, track.T_map_vehicle)).max() < 1e-8


def test_kitti_and_tum_say_the_same(ran: Ran) -> None:
    tum, kitti = read_tum(ran.out / "poses.tum"), read_kitti(ran.out / "poses.kitti", ran.out / "times.txt")
    assert np.array_equal(tum.t_ns, kitti.t_ns)
    assert np.allclose(tum.T_dst_vehicle, kitti.T_dst_vehicle, atol=1e-8)
    reference = read_kitti(ran.out / "reference.kitti", ran.out / "times.txt")
    assert offsets_m(reference, kitti).max() < 0.15


def test_errors_of_the_summary_are_those_of_the_files(ran: Ran) -> None:
    refined, reference = read_tum(ran.out / "poses.tum"), read_tum(ran.out / "reference.tum")
    error = T_inverse(reference.at(refined.t_ns)) @ refined.T_dst_vehicle
    found = ran.summary["errors"]["refined"]
    assert found["longitudinal_m"]["p95"] == pytest.approx(np.quantile(np.abs(error[:, 0, 3]), 0.95), abs=1e-5)
    assert found["lateral_m"]["max"] == pytest.approx(np.abs(error[:, 1, 3]).max(), abs=1e-5)
    heading_deg = np.degrees(np.arctan2(error[:, 1, 0], error[:, 0, 0]))
    assert found["heading_deg"]["max"] == pytest.approx(np.abs(heading_deg).max(), abs=1e-5)
    assert found["lateral_m"]["within_limits"] is (found["lateral_m"]["p95"] <= 0.15)


def test_the_summary_counts_and_is_printed(ran: Ran) -> None:
    found = ran.summary
    assert (found["scans"], found["finished"], found["damage"]) == (SCANS, True, "")
    assert found["scans_localised"] == len(read_tum(ran.out / "poses.tum"))
    assert found["localised_share"] == pytest.approx(found["scans_localised"] / SCANS, abs=1e-4)
    assert found["scans_localised"] + found["scans_dropped"] == SCANS
    assert 0 < len(found["tiles_used"]) <= 40
    assert set(found["tiles_used"].values()) == {1}
    assert found == json.loads((ran.out / "summary.json").read_text())
    assert "refined, longitudinal" in ran.stdout
    assert "good" in ran.stdout


def test_the_health_timeline_covers_the_drive_without_gaps(ran: Ran) -> None:
    health = json.loads((ran.out / "health.json").read_text())
    stretches = health["stretches"]
    assert sum(one["scans"] for one in stretches) == SCANS
    assert all(a["to_s"] == b["from_s"] for a, b in pairwise(stretches))
    assert stretches[0]["from_s"] == 0.0
    assert stretches[-1]["to_s"] == ran.summary["duration_s"]
    assert health["shares"] == ran.summary["health"]


def test_the_table_has_a_row_a_pose_on_the_earth(ran: Ran) -> None:
    with (ran.out / "track.csv").open() as stream:
        rows = list(csv.DictReader(stream))
    refined = read_tum(ran.out / "poses.tum")
    assert [int(row["t_ns"]) for row in rows] == refined.t_ns.tolist()
    lat, lon, _ = read_header(ran.drive).anchor.geodetic_from_enu(refined.T_dst_vehicle[:, :3, 3])
    assert float(rows[-1]["latitude_deg"]) == pytest.approx(math.degrees(lat[-1]), abs=2e-9)
    assert float(rows[-1]["longitude_deg"]) == pytest.approx(math.degrees(lon[-1]), abs=2e-9)
    x_axis = refined.T_dst_vehicle[0, :2, 0]
    assert float(rows[0]["heading_deg"]) == pytest.approx(
        90.0 - math.degrees(math.atan2(x_axis[1], x_axis[0])), abs=1e-3
    )
    assert all(row["health"] in {"good", "degraded"} for row in rows)


def test_lines_by_health_lie_on_the_earth(ran: Ran) -> None:
    collection = json.loads((ran.out / "track.geojson").read_text())
    lines = [f for f in collection["features"] if f["geometry"]["type"] == "LineString"]
    anchor = read_header(ran.drive).anchor
    lon, lat, _ = lines[0]["geometry"]["coordinates"][0]
    assert abs(lat - math.degrees(anchor.lat_rad)) < 0.01
    assert abs(lon - math.degrees(anchor.lon_rad)) < 0.01
    assert {f["properties"]["health"] for f in collection["features"]} <= {"good", "degraded", "lost"}


def test_the_mcap_holds_all_three_tracks(ran: Ran) -> None:
    counts = mcap_counts(ran.out / "poses.mcap")
    assert counts["/refined/pose"] == ran.summary["scans_localised"]
    assert counts["/tf"] == 0  # the drive has its own
    assert counts["/online/pose"] == len(read_tum(ran.out / "online.tum"))
    assert counts["/reference/path"] == 1


def test_a_drive_without_reference_has_no_errors(ran: Ran, tmp_path: Path) -> None:
    (tmp_path / "out").mkdir()
    (tmp_path / "out" / "errors.png").write_bytes(b"of an earlier run")
    bare = changed(ran.drive, tmp_path / "bare.mcap", lambda i: None if isinstance(i, ReferencePose) else i)
    done = localise(
        bare, ran.store, "--out", str(tmp_path / "out"), "--format", "tum,kitti,mcap", "--no-plots", "--json", "-"
    )
    assert done.exit_code == 0, done.output
    assert json.loads(done.stdout)["errors"] is None
    names = {path.name for path in (tmp_path / "out").iterdir()}
    assert names == {
        "poses.tum", "online.tum", "poses.kitti", "times.txt", "poses.mcap", "health.json", "summary.json",
    }  # fmt: skip
    assert mcap_counts(tmp_path / "out" / "poses.mcap")["/tf"] == len(read_tum(tmp_path / "out" / "poses.tum"))
    refined, same = read_tum(ran.out / "poses.tum"), read_tum(tmp_path / "out" / "poses.tum")
    # The graph's threads add in the order in which they end: the last written digit may differ.
    assert np.abs(refined.T_dst_vehicle - same.T_dst_vehicle).max() < 1e-8


def test_poses_of_single_scans_alone_are_others(ran: Ran, tmp_path: Path) -> None:
    done = localise(ran.drive, ran.store, "--out", str(tmp_path), "--without-submaps", "--no-plots", "--format", "tum")
    assert done.exit_code == 0, done.output
    assert json.loads((tmp_path / "summary.json").read_text())["submaps"] is False
    with_submaps, without = read_tum(ran.out / "poses.tum"), read_tum(tmp_path / "poses.tum")
    assert len(without) == len(with_submaps)
    assert not np.array_equal(without.T_dst_vehicle, with_submaps.T_dst_vehicle)


def test_a_damaged_recording_keeps_what_came_before(ran: Ran, tmp_path: Path) -> None:
    data = bytearray(ran.drive.read_bytes())
    data[len(data) * 2 // 3] ^= 0xFF
    (tmp_path / "damaged.mcap").write_bytes(data)
    said = refusal(tmp_path / "damaged.mcap", ran.store, "--out", str(tmp_path / "out"), "--no-plots")
    assert "damaged.mcap" in said
    assert "holds what came before" in said
    summary = json.loads((tmp_path / "out" / "summary.json").read_text())
    assert summary["finished"] is False
    assert 0 < summary["scans"] < SCANS
    assert len(read_tum(tmp_path / "out" / "poses.tum")) == summary["scans_localised"]


def test_the_first_ctrl_c_ends_it_and_the_second_is_pythons_own() -> None:
    with ended_by_ctrl_c() as stop:
        signal.raise_signal(signal.SIGINT)
        assert stop.is_set()
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    assert signal.getsignal(signal.SIGINT) is signal.default_int_handler


def test_a_stopped_drive_gives_what_is_there(ran: Ran) -> None:
    stop = threading.Event()

    def progress(done: int, total: int) -> None:
        assert total == SCANS
        if done == 12:
            stop.set()

    with SqliteStore(ran.store, create=False) as store:
        found = localise_drive(ran.drive, StoreMap(store), progress=progress, stop=stop)
    assert (found.counts.scans, found.counts.finished, len(found.moments)) == (12, False, 12)


@pytest.mark.parametrize(
    ("more", "message"),
    [
        (("--layer", "signs"), "the map has no tiles in layer signs; its layers: ndt"),
        (("--at", "2001-01-01"), "existed at 2001-01-01T00:00:00 UTC"),
        (("--at", "yesterday"), "time 'yesterday' is not like"),
        (("--format", "tum,las"), "'las' is not known; known are tum, kitti, mcap, geojson"),
    ],
)
def test_options_that_cannot_be_are_refused(ran: Ran, tmp_path: Path, more: tuple[str, ...], message: str) -> None:
    assert message in refusal(ran.drive, ran.store, "--out", str(tmp_path / "out"), *more)


def test_a_drive_elsewhere_is_told_where_the_map_is(ran: Ran, tmp_path: Path) -> None:
    away = changed(ran.drive, tmp_path / "away.mcap", moved_north)
    said = refusal(away, ran.store, "--out", str(tmp_path / "out"))
    assert "no tiles here: the drive is at 38.1" in said
    assert "the nearest of the map's" in said
    assert "63.5 km away" in said


def test_scans_that_stop_coming_are_a_gap_of_the_timeline(ran: Ran, tmp_path: Path) -> None:
    """Scans between 1.5 and 3 s are missing; wheels and satellites go on."""
    start_ns = load_track(ran.drive).motion.t_ns[0]

    def holed(item: DriveItem) -> DriveItem | None:
        missing = isinstance(item, Scan) and 1.5 < (item.t_ns - start_ns) * 1e-9 < 3.0
        return None if missing else item

    hole = changed(ran.drive, tmp_path / "hole.mcap", holed)
    with SqliteStore(ran.store, create=False) as store:
        found = localise_drive(hole, StoreMap(store))
    gaps = [one for one in stretches_of(found.moments) if one.cause == "gap"]
    assert len(gaps) == 1
    assert gaps[0].health != "good"
    assert gaps[0].scans == 0
    assert 1.5 < gaps[0].from_s < gaps[0].to_s < 3.2
    assert sum(one.scans for one in stretches_of(found.moments)) == found.counts.scans


def test_a_drive_without_scans_is_refused(ran: Ran, tmp_path: Path) -> None:
    none = changed(ran.drive, tmp_path / "none.mcap", lambda i: None if isinstance(i, Scan) else i)
    assert "has no scans" in refusal(none, ran.store, "--out", str(tmp_path / "out"))


def test_a_drive_without_gnss_is_refused(ran: Ran, tmp_path: Path) -> None:
    blind = changed(ran.drive, tmp_path / "blind.mcap", lambda i: None if isinstance(i, GnssFix) else i)
    assert "has no GNSS fix" in refusal(blind, ran.store, "--out", str(tmp_path / "out"))


def test_recordings_and_missing_files_are_told_what_to_do(ran: Ran, tmp_path: Path) -> None:
    out = ("--out", str(tmp_path / "out"))
    assert f"`gnd import auto {tmp_path} -o {tmp_path.name}.mcap`" in refusal(tmp_path, ran.store, *out)
    assert "no such drive" in refusal(tmp_path / "none.mcap", ran.store, *out)
    assert "no such store; `gnd map build` makes one" in refusal(ran.drive, tmp_path / "none.sqlite", *out)
    assert "not a tile store" in refusal(ran.drive, ran.drive, *out)
    (tmp_path / "file").write_text("")
    assert "cannot make the folder" in refusal(ran.drive, ran.store, "--out", str(tmp_path / "file" / "out"))


def test_the_command_is_in_the_table() -> None:
    assert "localise" in gnd.list_commands(None)  # type: ignore[arg-type]
