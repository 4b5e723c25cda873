"""`gnd map …` as its users call it: numbers for people and for programs, and errors in one line."""

import json
import subprocess
import sys
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from click.testing import CliRunner
from store_helpers import EAGER, EAST, FAR, TILE, merge_once, report, report_id, tile_of_voxels

from gnd.deploy.map_cli import map_group
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.geodesy import LocalFrame
from gnd.schemas.drive import DriveHeader, ReferencePose, Scan
from gnd.schemas.drive_mcap import DriveWriter
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import Publication, Unconfirmed

T0_NS = 1_700_000_000_000_000_000


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """A store with three tiles; that of Figure 2 has been merged once."""
    at = tmp_path / "map.db"
    with SqliteStore(at, EAGER) as store:
        store.put_tiles([tile_of_voxels(tile, 1, 2, 3) for tile in (TILE, EAST, FAR)])
        store.put_reports([report(1)])
        merge_once(store, 2, 3, 4, 5)
    return at


def gnd_map(*arguments: object) -> str:
    """What `gnd map` prints; what it raises is raised here."""
    result = CliRunner().invoke(map_group, list(map(str, arguments)), catch_exceptions=False)
    assert result.exit_code == 0, result.output
    return result.stdout


def as_json(*arguments: object) -> Any:
    return json.loads(gnd_map(*arguments, "--json"))


def refused(*arguments: object) -> str:
    with pytest.raises(GndError) as caught:
        gnd_map(*arguments)
    assert "\n" not in str(caught.value)
    return str(caught.value)


def write_drive(at: Path) -> Path:
    """A vehicle that stands before a wall."""
    anchor = LocalFrame(*TILE.centre_rad, 0.0)
    rng = np.random.default_rng(0)
    with DriveWriter(at, DriveHeader("wall", "car-1", "test", anchor, np.eye(4), "made by a test")) as writer:
        for k in range(3):
            points = np.stack([np.full(3000, 5.3), rng.uniform(-4, 4, 3000), rng.uniform(0, 3, 3000)], axis=1)
            writer.scan(Scan(T0_NS + k * 100_000_000, points.astype(np.float32), np.zeros(3000, np.uint32)))
        for k in range(5):
            writer.reference(ReferencePose(T0_NS + k * 100_000_000, np.eye(4)))
    return at


def test_build_makes_a_store_from_drives(tmp_path: Path) -> None:
    drive, at = write_drive(tmp_path / "wall.mcap"), tmp_path / "new.db"
    built = as_json("build", drive, "--store", at)
    assert (built["drives"], built["scans"], built["points"]) == (1, 3, 9000)
    assert built["gaussians"] > 20
    assert {one.name for one in tmp_path.iterdir()} == {"wall.mcap", "new.db"}
    told = as_json("info", at, "--deep")
    assert (told["tiles"], told["gaussians"]) == (built["tiles"], built["gaussians"])
    assert 9000 / 2 < told["points"] < 9000 * 2  # on a lattice the number of points is one of two octaves
    assert told["bytes_a_voxel"] == told["body_bytes"] / told["gaussians"]
    assert sum(told["codecs"].values()) == told["tiles"]
    again = as_json("build", drive, "-o", at)
    assert again["versions_published"] == 0
    assert "gaussians" in gnd_map("build", drive, "-o", at, "--layer", "ndt_other")
    plain = as_json("build", drive, "-o", at, "--layer", "ndt_other", "--codec", "float")
    assert plain["versions_published"] == plain["tiles"]
    measured = as_json("info", at, "--layer", "ndt_other", "--deep")
    assert (measured["layers"], measured["points"]) == (["ndt", "ndt_other"], 9000)
    assert measured["bytes_a_voxel"] > told["bytes_a_voxel"]
    assert "bytes a Gaussian" in gnd_map("info", at, "--deep")
    wrong = CliRunner().invoke(map_group, ["build", str(drive), "-o", str(at), "--codec", "zip"])
    assert wrong.exit_code == 2
    assert "'zip' is not one of 'archive', 'standard', 'compact', 'float'" in wrong.stderr


def test_a_build_that_fails_leaves_nothing_behind(tmp_path: Path) -> None:
    (tmp_path / "broken.mcap").write_bytes(b"\x89MCAP0\r\n" + bytes(100))
    assert "broken.mcap" in refused("build", tmp_path / "broken.mcap", "-o", tmp_path / "new.db")
    assert [one.name for one in tmp_path.iterdir()] == ["broken.mcap"]
    assert "the folder" in refused("build", tmp_path / "broken.mcap", "-o", tmp_path / "no" / "new.db")


def test_info_in_numbers_and_as_a_table(path: Path) -> None:
    told = as_json("info", path, "--deep")
    assert (told["tiles"], told["districts"], told["gaussians"]) == (3, 2, 10)
    quick = as_json("info", path)
    assert quick.items() <= told.items()
    assert "gaussians" not in quick
    assert (told["lowest_version"], told["highest_version"], told["layers"]) == (1, 2, ["ndt"])
    assert told["store"]["versions"] == 4
    assert as_json("info", path, "--region", "13033")["tiles"] == 2
    table = gnd_map("info", path)
    assert "3 in 2 districts" in table
    assert "1 over 1 tiles, 0 to merge" in table


@pytest.mark.parametrize("name", ["map.pcd", "map.ply", "map.geojson"])
def test_export_writes_the_region(path: Path, tmp_path: Path, name: str) -> None:
    told = as_json("export", path, tmp_path / name, "--region", "13033/03021")
    assert (told["tiles"], told["gaussians"]) == (2, 7)
    assert told["size_bytes"] == (tmp_path / name).stat().st_size
    assert "7 Gaussians of 2 tiles" in gnd_map("export", path, tmp_path / name, "--region", "13033")


def test_diff_of_two_stores(path: Path, tmp_path: Path) -> None:
    other = tmp_path / "other.db"
    with SqliteStore(other) as store:
        store.put_tiles([tile_of_voxels(TILE, 1, 2), tile_of_voxels(FAR, 1, 2, 3)])
    told = as_json("diff", other, path)
    assert (told["new"], told["deleted"], told["tiles_same"]) == (6, 1, 1)
    assert "2 tiles differ, 1 are the same; voxels: 6 new, 1 deleted, 0 modified" in gnd_map("diff", other, path)
    assert "0 tiles differ, 3 are the same" in gnd_map("diff", path, path)


def test_diff_of_two_versions_of_a_tile(path: Path) -> None:
    for arguments in (["--versions", "1..2"], []):
        told = as_json("diff", path, "--tile", TILE.morton, *arguments)
        assert (told["new"], told["deleted"], told["same"]) == (2, 1, 2)
    assert as_json("diff", path, "--tile", TILE.path, "--versions", "2..1")["new"] == 1


def test_diff_since_a_time(path: Path) -> None:
    told = as_json("diff", path, "--since", "2001-01-01")
    assert (told["new"], len(told["tiles"])) == (10, 3)
    assert as_json("diff", path, "--since", "2199-01-01T00:00:00Z")["tiles"] == []


def test_history_names_the_reports_of_each_version(path: Path) -> None:
    told = as_json("history", path, TILE.path)
    first, second = told["versions"]
    assert (first["kind"], first["reports"]) == ("base", [])
    assert (second["kind"], second["merger"], second["reports"]) == ("merged", "m1", [report_id(1)])
    assert second["sha"] == tile_of_voxels(TILE, 2, 3, 4, 5).sha.hex()
    table = gnd_map("history", path, f"{TILE.morton}")
    assert "merged" in table
    assert second["sha"][:12] in table


def test_rollback_publishes_the_old_content(path: Path) -> None:
    assert as_json("rollback", path, TILE.path, 1)["tiles"][0]["version"] == 3
    assert "1 of 1 tiles have changed" in gnd_map("rollback", path, TILE.path, "--to", 2)
    kinds = [version["kind"] for version in as_json("history", path, TILE.path)["versions"]]
    assert kinds == ["base", "merged", "rollback", "rollback"]
    with SqliteStore(path) as store:
        assert [notice.version for notice in store.notices()] == [2, 3, 4]


def test_gc_removes_old_versions(path: Path) -> None:
    for voxel in range(3):
        with SqliteStore(path) as store:
            store.put_tiles([tile_of_voxels(EAST, voxel)])
    assert as_json("gc", path, "--keep-versions", 2)["versions"] == 2
    assert "0 versions removed" in gnd_map("gc", path, "--keep", 2)
    assert "nothing was removed" in refused("gc", path)


def test_quarantine_tells_and_saves_what_was_refused(path: Path, tmp_path: Path) -> None:
    with SqliteStore(path) as store:
        store.quarantine(b"nonsense", "Malformed: 8 bytes are not a ChangeReport", "gnd/v1/change/x")
    (row,) = as_json("quarantine", path, "--save", tmp_path / "bad")["quarantined"]
    assert (row["bytes"], row["reason"]) == (8, "Malformed: 8 bytes are not a ChangeReport")
    assert (tmp_path / "bad" / f"{row['sha256']}.bin").read_bytes() == b"nonsense"
    assert "Malformed" in gnd_map("quarantine", path)
    assert "cannot write" in refused("quarantine", path, "--save", path / "x")


def test_what_cannot_be_is_said_in_one_line_and_nothing_is_made(path: Path, tmp_path: Path) -> None:
    before = sorted(tmp_path.iterdir())
    missing = tmp_path / "missing.db"
    assert "no such store" in refused("info", missing)
    assert "no such store" in refused("diff", path, missing)
    assert "not a path" in refused("history", path, "13033/03021")
    assert "is not in" in refused("history", path, TILE.neighbours()[0].path)
    assert "has no version 9 (newest: 2)" in refused("rollback", path, TILE.path, 9)
    assert "has 1 versions; two are needed" in refused("diff", path, "--tile", EAST.path)
    assert "has no version 7" in refused("diff", path, "--tile", TILE.path, "--versions", "1..7")
    assert "not like 3..5" in refused("diff", path, "--tile", TILE.path, "--versions", "1-7")
    assert "give either OTHER" in refused("diff", path)
    assert "give either OTHER" in refused("diff", path, path, "--versions", "1..2")
    assert "not like 2026" in refused("diff", path, "--since", "yesterday")
    assert "no tiles in layer" in refused("info", path, "--layer", "signs")
    assert "no tiles in layer" in refused("export", path, tmp_path / "x.pcd", "--region", "13000")
    assert "unknown export format 'shp'" in refused("export", path, tmp_path / "x.shp")
    assert "base-4 digits" in refused("info", path, "--region", "9")
    assert sorted(tmp_path.iterdir()) == before


def test_the_command_line_turns_errors_into_one_line_and_exit_code_2(tmp_path: Path) -> None:
    command = [sys.executable, "-m", "gnd.deploy.cli", "map", "info", str(tmp_path / "missing.db")]
    done = subprocess.run(command, capture_output=True, text=True)
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr == f"gnd: {tmp_path / 'missing.db'}: no such store; `gnd map build` makes one\n"


def test_status_of_a_map_that_waits_for_nothing_is_one_line(path: Path) -> None:
    assert "nothing waits for confirmation" in gnd_map("status", path)
    told = as_json("status", path)
    lag = told.pop("merge_lag_s")
    assert 0 <= lag["p50"] <= lag["p95"] <= lag["max"]
    assert told == {
        "shards": [],
        "queue": {"tiles": 0, "report_parts": 0, "overdue_s": 0.0, "waiting_s": 0.0},
        "set_aside": [],
        "waiting_for_confirmation": {"tiles": 0, "voxels": 0, "parked": 0, "season": 0, "claims": []},
        "named_vehicles": [],
        "to_merge": [],
        "uploads": {},
        "windows": {"tiles": 1, "reports_in_open": 1, "folded": 0, "most_behind": 0},
        "quarantined": 0,
        "quarantined_bytes": 0,
    }


def test_status_tells_what_waits_for_whom(path: Path) -> None:
    with SqliteStore(path, EAGER) as store:
        store.put_reports([report(7), report(8, tile=EAST)])
        (claim,) = [one for one in store.claim("m", 2, 30.0) if one.tile == TILE]
        waiting = (Unconfirmed("car-7", (report_id(7),), 120, 300, "share"),)
        store.publish([Publication(claim, 2, None, report_ids=(report_id(7),), waiting=waiting)])
        store.quarantine(b"nonsense", "why", "where")
        since_ns = next(row.received_ns for row in store.reports() if row.report_id == report_id(7))
    told = as_json("status", path)
    assert told["quarantined"] == 1
    (to_merge,) = told["to_merge"]
    assert (to_merge["tile"], to_merge["reports"], to_merge["is_leased"]) == (EAST.path, 1, True)
    totals = told["waiting_for_confirmation"]
    assert (totals["tiles"], totals["voxels"]) == (1, 120)
    (claim_told,) = totals["claims"]
    assert claim_told["since_ns"] == since_ns
    assert (claim_told["tile"], claim_told["vehicle"], claim_told["seen"]) == (TILE.path, "car-7", 300)
    shown = gnd_map("status", path)
    assert all(text in shown for text in ("car-7", TILE.path, "120", "1 messages in quarantine", "1 tiles to merge"))
