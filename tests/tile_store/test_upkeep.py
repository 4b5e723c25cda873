"""What an operator does: backup, restore, check, retention, rollback by time, reading where nothing can be written."""

import json
import os
import subprocess
import sys
import threading
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import apsw
import numpy as np
import pytest
from click.testing import CliRunner
from store_helpers import EAGER, EAST, FAR, TILE, Clock, merge_once, publication, report, tile_of_voxels

from gnd.deploy.map_cli import map_group
from gnd.gnd_map.errors import GndError
from gnd.gnd_map.features import Feature, FeatureTile, hit
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile
from gnd.tile_store.backup import copy_store
from gnd.tile_store.check import check_store
from gnd.tile_store.connection import change
from gnd.tile_store.errors import StoreDamaged, StoreError, StoreUnavailable
from gnd.tile_store.migrations import SCHEMA_VERSION
from gnd.tile_store.retention import Retained, retain
from gnd.tile_store.rollback import RollbackTarget, plan, roll_back
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

T0_NS = 1_700_000_000_000_000_000
DAY_S = 86_400.0


def command(*arguments: object, code: int = 0) -> str:
    result = CliRunner().invoke(map_group, list(map(str, arguments)), catch_exceptions=False)
    assert result.exit_code == code, result.output
    return result.stdout


def as_json(*arguments: object, code: int = 0) -> Any:
    return json.loads(command(*arguments, "--json", code=code))


def refused(*arguments: object) -> str:
    with pytest.raises(GndError) as caught:
        command(*arguments)
    return str(caught.value)


def large_tile() -> Tile:
    """One that needs several pages."""
    n = 2000
    mean_m = np.random.default_rng(5).uniform(0.1, 0.9, (n, 3)).astype(np.float32)
    cov_m2 = np.tile(np.array([0.01, 0, 0, 0.01, 0, 0.01], np.float32), (n, 1))
    counts = np.full(n, 50, np.int32)
    return Tile(FAR, 0, Gaussians(np.arange(n, dtype=np.int32), counts, counts // 5, mean_m, cov_m2))


@pytest.fixture
def path(tmp_path: Path) -> Path:
    """Three tiles, one of them large; that of Figure 2 merged once; a report waits."""
    path = tmp_path / "map.sqlite"
    with SqliteStore(path, EAGER) as store:
        store.put_tiles([tile_of_voxels(TILE, 1, 2, 3), tile_of_voxels(EAST, 1), large_tile()])
        store.put_reports([report(1)])
        merge_once(store, 2, 3)
        store.put_reports([report(2, EAST)])
    return path


def damage(path: Path) -> None:
    """Break the chain of pages in the middle of the large tile's body, as a failing disk would."""
    with SqliteStore(path, read_only=True) as store:
        head = store.get("ndt", FAR)
    assert head is not None
    raw = bytearray(path.read_bytes())
    at = raw.index(head.body[len(head.body) // 2 :][:64]) // 4096 * 4096
    raw[at : at + 4] = b"\xff" * 4
    path.write_bytes(raw)


# Backup and restore


def test_a_backup_is_the_store_of_one_instant_while_others_write(path: Path, tmp_path: Path) -> None:
    stop, copies = threading.Event(), []
    with SqliteStore(path, EAGER) as store:

        def write() -> None:
            for n in range(10, 100_000):
                if stop.is_set():
                    return
                store.put_reports([report(n, TILE), report(n, EAST)])  # both or none

        writer = threading.Thread(target=write)
        writer.start()
        for n in range(5):
            copies.append(tmp_path / f"copy{n}.sqlite")
            store.backup(copies[-1])
        stop.set()
        writer.join()
    parts = []
    for one in copies:
        assert sorted(other.name for other in tmp_path.glob(f"{one.name}*")) == [one.name]
        with SqliteStore(one, read_only=True) as copy:
            rows = list(copy.reports())
            of_tiles = [{row.report_id for row in rows if row.tile == tile} for tile in (TILE, EAST)]
            assert of_tiles[0] - {report(1).report_id} == of_tiles[1] - {report(2).report_id}
            parts.append(len(rows))
    assert parts == sorted(parts)
    assert parts[-1] > parts[0]


def test_a_restored_store_has_the_map_and_the_reports_and_no_leases(path: Path, tmp_path: Path) -> None:
    with SqliteStore(path, EAGER) as store:
        assert len(store.claim("m1", 10, 1e6)) == 1
        store.join("m1-of-another-name")
        told = json.loads(command("backup", path, tmp_path / "b", "--json"))
    assert (told["versions"], told["report_parts"]) == (4, 2)
    assert as_json("restore", tmp_path / "b", tmp_path / "again.sqlite")["size_bytes"] == told["size_bytes"]
    with SqliteStore(tmp_path / "again.sqlite", EAGER) as store:
        assert [head.version for head in store.heads()] == [1, 2, 1]
        assert [claim.tile for claim in store.claim("m2", 10, 10.0)] == [EAST]
        assert store.shards() == []


def test_nothing_is_overwritten_and_nothing_is_left_behind(path: Path, tmp_path: Path) -> None:
    before = sorted(tmp_path.iterdir())
    assert "exists; nothing is overwritten" in refused("restore", path, path)
    assert "the folder" in refused("backup", path, tmp_path / "no" / "b")
    assert "no such store" in refused("backup", tmp_path / "missing", tmp_path / "b")
    (tmp_path / "text").write_text("no database, but text that is long enough to have a header of 100 bytes" * 3)
    assert "not a tile store" in refused("restore", tmp_path / "text", tmp_path / "b")
    (tmp_path / "b-wal").write_bytes(b"log of a store that was here")
    assert "b-wal: exists" in refused("backup", path, tmp_path / "b")
    assert sorted(tmp_path.iterdir()) == sorted([*before, tmp_path / "text", tmp_path / "b-wal"])


def test_a_damaged_store_is_not_backed_up_as_if_it_were_whole(path: Path, tmp_path: Path) -> None:
    damage(path)
    assert "damages, first" in refused("backup", path, tmp_path / "b")
    assert not (tmp_path / "b").exists()


# Check


def test_a_whole_store_is_said_to_be_whole(path: Path) -> None:
    told = as_json("check", path)
    assert told == {"schema": SCHEMA_VERSION, "tiles": 3, "reports": 2, "damages": [], "is_whole": True}
    assert "whole; 4 tiles and 2 report parts" in command("check", path, "--all-versions")


def test_a_damaged_page_is_named_by_its_tile_and_the_others_can_be_read(path: Path) -> None:
    damage(path)
    told = as_json("check", path, code=1)
    assert [one["name"] for one in told["damages"] if one["kind"] == "tile"] == [f"ndt {FAR.path} version 1"]
    assert FAR.path in command("check", path, code=1)
    with SqliteStore(path) as store:
        assert store.get("ndt", TILE) is not None
        with pytest.raises(StoreDamaged, match="gnd map check"):
            store.get("ndt", FAR)


def test_a_body_that_is_not_what_its_hash_says_is_named(path: Path) -> None:
    with apsw.Connection(str(path)) as connection:
        other = connection.execute("SELECT body FROM tile_version WHERE tile = ? AND version = 2", (TILE.morton,)).get
        change = "UPDATE tile_version SET body = ? WHERE tile = ? AND version = 1"
        connection.execute(change, (other, TILE.morton))
    assert check_store(path).damages == ()  # the newest version is whole
    (damaged,) = check_store(path, all_versions=True).damages
    assert (damaged.name, damaged.why) == (f"ndt {TILE.path} version 1", "its content is not what its hash says")


# Retention


def test_only_reports_that_count_no_more_go(tmp_path: Path) -> None:
    clock = Clock()
    with SqliteStore(tmp_path / "s", EAGER, now_ns=clock, steady_ns=clock) as store:
        store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
        store.put_reports([report(1)])
        merge_once(store, 1, 2)
        store.rollback("ndt", TILE, 1)
        store.put_reports([report(2), report(3, EAST)])
        merge_once_of_all(store)
        store.put_reports([report(4)])
        clock.advance(10 * DAY_S)
        store.put_reports([report(5)])
        assert retain(store, keep_days=11).reports == 0
        assert retain(store, keep_days=9) == Retained(reports=1, report_bytes=4)
        assert [row.report_id for row in store.reports()] == [report(n).report_id for n in (2, 3, 4, 5)]
        with pytest.raises(StoreError, match="must not be negative"):
            retain(store, keep_days=-1)


def merge_once_of_all(store: SqliteStore) -> None:
    store.publish([publication(store.load(claim), 7) for claim in store.claim("m", 10, 10.0)])


def test_reports_that_are_folded_go_only_when_asked_for(tmp_path: Path) -> None:
    clock = Clock()
    with SqliteStore(tmp_path / "s", EAGER, now_ns=clock, steady_ns=clock) as store:
        store.put_tiles([tile_of_voxels(TILE, 1), tile_of_voxels(EAST, 1)])
        store.put_reports([report(1), report(2, EAST)])
        merge_once_of_all(store)
        window = store.windows()[0].window
        memory = {"layer": "ndt", "tile": TILE.morton, "window": window, "epoch": 1, "codec_id": 1}
        store.transact(lambda c, _now: change(c, "put_memory", memory | {"body": b"", "memory": b""}))
        store.put_reports([report(3)])
        clock.advance(10 * DAY_S)
        assert retain(store, keep_days=9).reports == 0
        assert retain(store, keep_days=9, folded=True).reports == 1  # EAST is not folded, the newest waits
        assert [row.report_id for row in store.reports()] == [report(2).report_id, report(3).report_id]


def test_the_quarantine_has_a_bound_and_the_oldest_go(tmp_path: Path) -> None:
    clock = Clock()
    config = StoreConfig(quarantine_mb=0.1)
    with SqliteStore(tmp_path / "s", config, now_ns=clock, steady_ns=clock) as store:
        for n in range(300):
            clock.advance(1.0)
            store.quarantine(n.to_bytes(2, "big") * 500, f"reason {n}", "source")
        state = store.queue_state()
        kept = store.quarantined()
        assert 50_000 < state.quarantined_bytes <= 100_000
        assert state.quarantined == len(kept) == store.counts().quarantined
        assert state.quarantined_bytes == sum(len(o.body) + len(o.reason) + len(o.source) for o in kept)
        assert kept[-1].reason == "reason 299"
        assert [o.received_ns for o in kept] == sorted(o.received_ns for o in kept)
        store.quarantine(b"x" * 200_000, "larger than all that may be kept")
        assert store.queue_state().quarantined_bytes <= 100_000
        store.quarantine(b"after", "it goes on")
        clock.advance(2 * DAY_S)
        store.quarantine(b"today", "new")
        assert retain(store, keep_days=1).quarantined > 0
        assert [o.body for o in store.quarantined()] == [b"today"]
        assert retain(store, quarantine_mb=0).quarantined == 1
    with pytest.raises(StoreError, match="quarantine_mb = 0 lies outside > 0"):
        StoreConfig(quarantine_mb=0)


# Rollback


@pytest.fixture
def timed(tmp_path: Path) -> Iterator[tuple[SqliteStore, list[int]]]:
    """TILE with versions 1 to 4, EAST that comes at the second time, and the four times."""
    clock, times = Clock(), []
    with SqliteStore(tmp_path / "timed", EAGER, now_ns=clock, steady_ns=clock) as store:
        for n in range(4):
            store.put_tiles([tile_of_voxels(TILE, n)])
            if n == 1:
                store.put_tiles([tile_of_voxels(EAST, 1)])
            times.append(clock.ns)
            clock.advance(10.0)
        yield store, times


def test_a_region_goes_back_to_a_time_and_says_so_before(timed: tuple[SqliteStore, list[int]]) -> None:
    store, times = timed
    steps = plan(store, "ndt", "13033", RollbackTarget(at_ns=times[0]))
    assert [(s.tile, s.from_version, s.to_version, s.action) for s in steps] == [
        (TILE, 4, 1, "rollback"),
        (EAST, 1, 0, "empty"),
    ]
    assert [head.version for head in store.heads()] == [4, 1]  # nothing has happened
    assert roll_back(store, "ndt", "13033", RollbackTarget(at_ns=times[0])) == steps
    heads = {head.tile: store.get("ndt", head.tile) for head in store.heads()}
    assert [one.decode_gaussians().gaussians.voxel_id.tolist() for one in heads.values() if one] == [[0], []]
    assert {one.kind for one in heads.values() if one} == {"rollback"}
    assert [one.action for one in plan(store, "ndt", "", RollbackTarget(at_ns=times[0]))] == ["same", "same"]
    assert [one.action for one in plan(store, "ndt", "", RollbackTarget(at_ns=2**62))] == ["same", "same"]


def test_what_retention_has_removed_is_not_guessed(timed: tuple[SqliteStore, list[int]]) -> None:
    store, times = timed
    store.transact(lambda c, _now: c.execute("DELETE FROM tile_version WHERE tile = ? AND version = 2", (TILE.morton,)))
    assert plan(store, "ndt", TILE, RollbackTarget(at_ns=times[1]))[0].action == "unknown"
    assert plan(store, "ndt", TILE, RollbackTarget(at_ns=times[2]))[0].action == "rollback"
    assert roll_back(store, "ndt", TILE, RollbackTarget(at_ns=times[1]))[0].action == "unknown"
    assert store.heads()[0].version == 4
    with pytest.raises(StoreError, match="has no version 2"):
        roll_back(store, "ndt", TILE, RollbackTarget(version=2))


def test_a_feature_tile_that_was_not_there_yet_becomes_empty(tmp_path: Path) -> None:
    with SqliteStore(tmp_path / "s") as store:
        cov_m2 = np.array([0.04, 0.0, 0.0, 0.04, 0.0, 1e4])
        sign = Feature(1, "traffic_sign", np.array([[1.0, -2.0, 30.25]]), cov_m2, hit(0.9))
        store.put_tiles([FeatureTile.of(TILE, 0, [sign])], layer="signs")
        assert roll_back(store, "signs", "", RollbackTarget(at_ns=1))[0].action == "empty"
        head = store.get("signs", TILE)
        assert head is not None
        assert head.decode_features().features == ()


def test_rollback_on_the_command_line(path: Path) -> None:
    told = as_json("rollback", path, "13033/", "--to", "2001-01-01", "--dry-run")
    assert [(one["action"], one["version"]) for one in told["tiles"]] == [("empty", 2), ("empty", 1)]
    assert "2 of 2 tiles would change" in command("rollback", path, "13033/", "--to", "2001-01-01", "--dry-run")
    assert as_json("rollback", path, TILE.path, "--to", 1)["tiles"][0]["version"] == 3
    assert "0 of 3 tiles would change" in command("rollback", path, "/", "--to", "2199-01-01", "--dry-run")
    assert "may be the number of a tile" in refused("rollback", path, "13033", "--to", "2001-01-01")
    assert "--folded needs --keep-days" in refused("gc", path, "--folded")
    assert "goes back to a time" in refused("rollback", path, "13033/", "--to", 1)
    assert "ends in a slash" in refused("rollback", path, "13033/03021", "--to", "2001-01-01")
    assert "give --to" in refused("rollback", path, TILE.path)
    assert "give --to" in refused("rollback", path, TILE.path, 1, "--to", 1)
    assert "not like 2026" in refused("rollback", path, TILE.path, "--to", "yesterday")
    assert "no tiles in layer" in refused("rollback", path, "0000/", "--to", "2001-01-01")


# Set aside


def test_tiles_set_aside_are_shown_and_taken_up_again(path: Path) -> None:
    with SqliteStore(path, EAGER) as store:
        (claim,) = store.claim("m1", 10, 10.0)
        store.begin([claim], 10.0)
        store.set_aside(claim, "StoreDamaged: page 7")
    assert "StoreDamaged: page 7" in command("status", path)
    assert [one["tile"] for one in as_json("status", path)["set_aside"]] == [EAST.path]
    assert "is not set aside" in refused("retry", path, TILE.path)
    assert as_json("retry", path, EAST.path)["tiles"] == 1
    assert "no tile is set aside" in command("retry", path)
    assert as_json("status", path)["queue"]["tiles"] == 1


# Where nothing can be written

AS_NOBODY = (
    "import os, sys\n"
    "import gnd.deploy.map_cli, gnd.gnd_map.content, numba\n"
    "if os.getuid() == 0: os.setgroups([]); os.setgid(65534); os.setuid(65534)\n"
    "from gnd.deploy.cli import main\n"
    "sys.argv = ['gnd', *sys.argv[1:]]\n"
    "main()\n"
)


def as_nobody(*arguments: object) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-c", AS_NOBODY, "map", *map(str, arguments)], capture_output=True, text=True
    )


def lock_folder(folder: Path) -> None:
    for one in folder.iterdir():
        one.chmod(0o444)
    folder.chmod(0o555)
    for parent in folder.parents:
        if parent.stat().st_uid == os.getuid() and parent.name.startswith(("pytest-", "popen-", "test_")):
            parent.chmod(0o755)


def test_a_store_in_a_folder_without_write_permission_can_be_read(path: Path, tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir()
    path.rename(folder / "map.sqlite")
    lock_folder(folder)
    for one in ("info", "status", "check", "quarantine"):
        done = as_nobody(one, folder / "map.sqlite", "--json")
        assert done.returncode == 0, done.stderr
        assert json.loads(done.stdout)
    done = as_nobody("export", folder / "map.sqlite", folder.parent / "x.pcd")
    assert "x.pcd" in done.stderr  # it was read; nobody may write there
    done = as_nobody("gc", folder / "map.sqlite", "--keep", "1")
    assert (done.returncode, done.stdout) == (2, "")
    assert "cannot be opened for writing" in done.stderr
    assert sorted(one.name for one in folder.iterdir()) == ["map.sqlite"]


def test_a_log_that_cannot_be_read_without_writing_is_no_old_map(path: Path, tmp_path: Path) -> None:
    folder = tmp_path / "locked"
    folder.mkdir()
    with SqliteStore(path) as store:
        store.put_tiles([tile_of_voxels(EAST, 5)])
        for suffix in ("", "-wal"):  # as a crash leaves them, without the -shm
            (folder / f"map.sqlite{suffix}").write_bytes(Path(f"{path}{suffix}").read_bytes())
    lock_folder(folder)
    done = as_nobody("info", folder / "map.sqlite")
    assert done.returncode == 2
    assert "its log map.sqlite-wal is not yet part of it" in done.stderr


def test_what_would_write_is_refused_where_a_store_is_only_read(path: Path) -> None:
    with SqliteStore(path, read_only=True) as store:
        assert len(store.heads()) == 3
        with pytest.raises(StoreUnavailable, match="opened for reading only"):
            store.put_reports([report(9)])
        with pytest.raises(StoreUnavailable, match="opened for reading only"):
            store.claim("m1", 1, 1.0)
    with pytest.raises(StoreUnavailable, match="no such store"):
        SqliteStore(path.with_name("typo"), read_only=True)
    assert not path.with_name("typo").exists()


def test_a_copy_that_is_damaged_on_the_way_does_not_get_its_name(
    path: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_arguments: object) -> None:
        raise StoreError("1 damages, first tile ...")

    monkeypatch.setattr("gnd.tile_store.backup.require_whole", fail)
    with pytest.raises(StoreError, match="1 damages"):
        copy_store(path, tmp_path / "b")
    assert [one.name for one in tmp_path.iterdir() if "b" in one.name.split(".")[0]] == []
