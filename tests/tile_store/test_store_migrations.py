"""Stores of older releases; `data/store_schema_1.sqlite.gz` was made by the one before schemas had steps (5cb8027)."""

import gzip
import shutil
from dataclasses import replace
from pathlib import Path

import apsw
import pytest
from store_helpers import EAGER, EAST, FAR, TILE, report, report_id, tile_of_voxels

from gnd.gnd_map.day import UNKNOWN_DAY, day_of
from gnd.tile_store import migrations
from gnd.tile_store.errors import StoreError, StoreUnavailable
from gnd.tile_store.migrations import SCHEMA_VERSION, STEPS
from gnd.tile_store.sql import statements
from gnd.tile_store.sqlite_store import SqliteStore

OLD = Path(__file__).parent / "data" / "store_schema_1.sqlite.gz"


@pytest.fixture
def old(tmp_path: Path) -> Path:
    path = tmp_path / "old.sqlite"
    with gzip.open(OLD) as packed, path.open("wb") as file:
        shutil.copyfileobj(packed, file)
    return path


def version_of(path: Path) -> int:
    with apsw.Connection(str(path)) as connection:
        return int(connection.pragma("user_version"))


def schema(path: Path) -> list[tuple[str, ...]]:
    with apsw.Connection(str(path)) as connection:
        return sorted(connection.execute("SELECT type, name, tbl_name FROM sqlite_schema").fetchall())


def test_the_steps_are_numbered_in_order_and_have_their_statements() -> None:
    assert [number for number, _ in STEPS] == list(range(1, SCHEMA_VERSION + 1))
    assert all(name in statements("sqlite") for _, name in STEPS)


def test_an_old_store_becomes_a_new_one_and_keeps_everything(old: Path, tmp_path: Path) -> None:
    assert version_of(old) == 1
    with SqliteStore(old, EAGER) as store:
        assert [(head.tile, head.version) for head in store.heads()] == [(FAR, 1), (TILE, 2), (EAST, 1)]
        head = store.get("ndt", TILE)
        assert head is not None
        assert head.decode().sha == tile_of_voxels(TILE, 2, 3, 4).sha
        assert store.provenance("ndt", TILE, 2) == (report_id(1),)
        base = store.get("ndt", TILE, version=1)
        assert base is not None
        assert base.day == day_of(1_700_000_000_000_000_000 - 10**15)
        assert [one.reason for one in store.quarantined()] == ["Malformed: 8 bytes are not a ChangeReport"]
        assert (store.counts().report_rows, store.counts().waiting) == (4, 3)
    assert version_of(old) == SCHEMA_VERSION
    fresh = tmp_path / "fresh.sqlite"
    SqliteStore(fresh).close()
    assert schema(old) == schema(fresh)


def test_leases_of_the_old_queue_by_the_time_of_day_are_over(old: Path) -> None:
    with SqliteStore(old, EAGER) as store:
        claims = store.claim("m1", 10, 10.0)
        assert {claim.tile for claim in claims} == {EAST, FAR}  # EAST was leased for a day
        store.put_reports([report(9, TILE)])
        assert [claim.tile for claim in store.claim("m1", 10, 10.0)] == [TILE]


def test_reports_from_before_they_had_parts_are_known(old: Path) -> None:
    with SqliteStore(old) as store:
        wanted = [report(2, EAST), replace(report(2, EAST), part=1)]
        assert store.put_reports(wanted) == ["duplicate", "stored"]
        assert sorted(row.part for row in store.reports() if row.report_id == report_id(2)) == [0, 1]


def test_a_store_that_has_got_journals_before_schemas_had_steps_is_taken_on(old: Path) -> None:
    sql = statements("sqlite")
    with apsw.Connection(str(old)) as connection:
        connection.execute(sql["schema_of_parts"])
        connection.execute(sql["schema_of_journal"])
    with SqliteStore(old) as store:
        assert len(store.put_reports([report(7)])) == 1
    assert version_of(old) == SCHEMA_VERSION


def test_a_store_of_a_release_without_days_and_accounts_gets_room_for_them(old: Path) -> None:
    with apsw.Connection(str(old)) as connection:
        connection.execute("DROP TRIGGER survey_goes; DROP TABLE survey; DROP TABLE waiting_change")
        connection.execute("DROP TABLE shift_test; DROP TABLE shifted_vehicle; DROP TABLE course_said")
    with SqliteStore(old) as store:
        head = store.get("ndt", EAST)
        assert head is not None
        assert head.day == UNKNOWN_DAY
        assert (store.waiting_changes(), store.vehicle_accounts()) == ([], [])


def test_a_step_that_fails_leaves_the_store_as_it_was(old: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    before = schema(old)
    broken = {**statements("sqlite"), "schema_of_operations": "CREATE TABLE half (x); SELECT nonsense"}
    monkeypatch.setattr(migrations, "statements", lambda _dialect: broken)
    with pytest.raises(StoreError, match="nonsense"):
        SqliteStore(old)
    assert (version_of(old), schema(old)) == (1, before)


def test_an_old_store_that_may_not_be_written_says_what_to_do(old: Path) -> None:
    with pytest.raises(StoreUnavailable, match=f"store schema 1, this release reads {SCHEMA_VERSION} and may"):
        SqliteStore(old, read_only=True)
    assert version_of(old) == 1


def test_a_newer_store_is_refused_and_not_touched(old: Path) -> None:
    with apsw.Connection(str(old)) as connection:
        connection.pragma("user_version", SCHEMA_VERSION + 1)
    wanted = f"store schema {SCHEMA_VERSION + 1}, this release reads up to {SCHEMA_VERSION}; use the gnd that wrote it"
    with pytest.raises(StoreUnavailable, match=wanted):
        SqliteStore(old)
    assert version_of(old) == SCHEMA_VERSION + 1
