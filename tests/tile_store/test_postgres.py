"""What is PostgreSQL's own: the same tables as SQLite's, several processes that write at a time, and clear errors."""

import socket
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from pathlib import Path
from typing import Any

import apsw
import pytest
from postgres_server import PostgresServer
from store_helpers import EAGER, TILE, Clock, PostgresMaker, report, tile_of_voxels

from gnd.tile_store import postgres_connection
from gnd.tile_store.errors import StoreUnavailable
from gnd.tile_store.location import file_of, open_store, shown
from gnd.tile_store.migrations import SCHEMA_VERSION
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.uploads import Settled, Upload
from gnd.tile_store.values import NS_PER_S

psycopg = pytest.importorskip("psycopg", reason="pip install 'gnd-fleet[postgres]'")
from gnd.tile_store.postgres_connection import SQL, DatabaseClock, _require_new_enough, connect  # noqa: E402
from gnd.tile_store.postgres_connection import shown as shown_conninfo  # noqa: E402
from gnd.tile_store.postgres_store import PostgresStore  # noqa: E402
from gnd.tile_store.postgres_wire import PostgresWire  # noqa: E402

NewDatabase = Callable[[], str]
KINDS = {"INTEGER": "bigint", "TEXT": "text", "BLOB": "bytea", "REAL": "double precision"}


def test_both_schemas_have_the_same_columns(new_database: NewDatabase, tmp_path: Path) -> None:
    SqliteStore(tmp_path / "a.db").close()
    file = apsw.Connection(str(tmp_path / "a.db"))
    tables = [name for (name,) in file.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")]
    found = {
        (table, name, KINDS[kind])
        for table in tables
        for _, name, kind, *_ in file.execute(f"PRAGMA table_info({table})")
    }
    file.close()
    with psycopg.connect(new_database()) as connection:
        columns = (
            "SELECT table_name, column_name, data_type FROM information_schema.columns WHERE table_schema = 'public'"
        )
        theirs = set(connection.execute(columns).fetchall())
    own = {
        one for one in theirs if one[0] in ("store_schema", "feature_source") or one[:2] == ("trial_steered", "number")
    }
    assert theirs - own == found, "a step of SQLite's schema that PostgreSQL's has not, or the reverse"


def test_every_statement_can_be_prepared(new_database: NewDatabase) -> None:
    """Also those that no test of the store runs; `+` of two numbers has to be told which."""
    with psycopg.connect(new_database(), autocommit=True) as connection:
        for name, statement in SQL.items():
            if name.startswith("schema") or name == "end_of_a_copy":  # of SQLite's files
                continue
            kinds = ["bigint" if one in ("steady", "delay") else "unknown" for one in statement.names]
            if name == "insert_uploads":
                kinds = [
                    f"{'bytea' if n in ('sha', 'body') else 'bigint' if n.endswith('_ns') else 'text'}[]"
                    for n in statement.names
                ]
            told = f" ({', '.join(kinds)})" if kinds else ""
            connection.execute(f"PREPARE p_{name}{told} AS {statement.sql}".encode())


def test_reports_of_two_processes_get_their_numbers_one_after_the_other(new_database: NewDatabase) -> None:
    """In opposite orders: without locks in one order a deadlock, without any the same number twice."""
    url = new_database()
    tiles = (TILE, *TILE.neighbours()[:3])
    stores = [PostgresMaker(url).open(EAGER) for _ in range(2)]
    failed: list[Exception] = []

    def send(which: int) -> None:
        try:
            for number in range(25):
                rows = [report(number, tile, f"v{which}") for tile in (tiles if which else tiles[::-1])]
                assert stores[which % 2].put_reports(rows) == ["stored"] * 4
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=send, args=(which,)) for which in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    for tile in tiles:
        journal = stores[0].in_play("ndt", tile)
        assert sorted(row.seq for row in journal.reports) == list(range(1, 101))
    for store in stores:
        store.close()


def test_gaussians_and_flags_that_two_processes_settle_at_once_do_not_miss_each_other(
    new_database: NewDatabase,
) -> None:
    url = new_database()
    one, two = (PostgresMaker(url).open(EAGER) for _ in range(2))
    for number in range(12):
        row = report(number)
        flags = Upload("k", b"f%d" % number, row.report_id, "v1", "packed", 1)
        half = Upload("k", b"g%d" % number, row.report_id, "", "gaussians", 1)
        one.put_upload(flags, "a")
        one.put_upload(half, "a")
        claims = {claim.upload.form: claim for claim in one.claim_uploads("a", 8, 60.0)}
        settled = [Settled(claims["packed"], "wanted", (row,), b"mask"), Settled(claims["gaussians"], "early")]
        with ThreadPoolExecutor(2) as threads:
            done = [threads.submit(store.settle_upload, what) for store, what in zip((one, two), settled, strict=True)]
        assert done[0].result()
        if not done[1].result():
            two.postpone_upload(claims["gaussians"], 0.0)
        (again,) = two.claim_uploads("a", 8, 60.0)
        assert again.upload.form == "gaussians", "it waits for ever otherwise"
        assert two.settle_upload(Settled(again, "released", (replace(row, part=1),)))
    one.close()
    two.close()


def test_a_report_of_many_tiles_takes_two_ways_to_the_server(
    new_database: NewDatabase, monkeypatch: pytest.MonkeyPatch
) -> None:
    ways: list[int] = []
    run = PostgresWire.run

    def counted(wire: PostgresWire, commands: Sequence[Any]) -> Any:
        ways.append(len(commands))
        return run(wire, commands)

    tiles = (TILE, *TILE.neighbours()[:7])
    with PostgresStore(new_database()) as store:
        for number in range(2):
            rows = tuple(report(number, tile) for tile in tiles)
            store.put_upload(Upload("k", b"%d" % number, rows[0].report_id, "v1", "packed", 1), "a")
            (claim,) = store.claim_uploads("a", 8, 60.0)
            monkeypatch.setattr(PostgresWire, "run", counted)
            ways.clear()
            assert store.settle_upload(Settled(claim, "released", rows))
            monkeypatch.setattr(PostgresWire, "run", run)
        assert ways == [4, 3], "BEGIN, locks, where they go, settled; entered, Gaussians woken, COMMIT"
        store.put_tiles([tile_of_voxels(TILE, [1])])
        monkeypatch.setattr(PostgresWire, "run", counted)
        ways.clear()
        assert store.get("ndt", TILE) is not None
        assert ways == [1]


def test_leases_run_by_the_clock_of_the_database(new_database: NewDatabase) -> None:
    url = new_database()
    with PostgresStore(url) as one, PostgresStore(url) as two:
        one.put_reports([report(1)])
        one.join("m1")
        (seen,) = two.shards()
        assert seen.is_alive
        with psycopg.connect(url) as connection:
            ((ahead_s,),) = connection.execute(
                "SELECT abs(extract(epoch FROM clock_timestamp())::float8 - beat_ns / 1e9::float8) FROM shard"
            ).fetchall()
        assert ahead_s < 60.0, "not a monotonic clock of this machine"


@pytest.mark.parametrize("back_s", [600, 1])
def test_what_waits_by_a_clock_that_goes_back_is_free(
    new_database: NewDatabase, monkeypatch: pytest.MonkeyPatch, back_s: int
) -> None:
    """The host of the database was fast, and is set right; its dead shards would hold what they had for as long."""
    monkeypatch.setattr(postgres_connection, "CLOCK_READ_EVERY_S", 0.0)
    fast = DatabaseClock.read_with

    def read_fast(clock: DatabaseClock, raw: Any) -> None:
        fast(clock, raw)
        clock._ahead_ns += back_s * NS_PER_S

    url, upload = new_database(), Upload("k", b"flags", report(1).report_id, "v1", "packed", 1)
    store = PostgresStore(url, EAGER)
    with monkeypatch.context() as wrong:
        wrong.setattr(DatabaseClock, "read_with", read_fast)
        store.put_reports([report(2)])
        assert len(store.claim("dead", 1, 5.0)) == 1
        store.put_upload(upload, "dead")
        assert len(store.claim_uploads("dead", 1, 5.0)) == 1
    store.dirty_count()  # the clock is read
    held = store.claim("lives", 1, 5.0), store.claim_uploads("lives", 1, 5.0)
    assert [len(one) for one in held] == ([1, 1] if back_s > 2 else [0, 0])
    assert store.claim("other", 1, 5.0) == [], "once, not whenever it is looked"
    store.close()


def test_a_lost_connection_is_made_again(new_database: NewDatabase) -> None:
    with PostgresStore(new_database()) as store:
        store.put_reports([report(1)])
        with psycopg.connect(store_url(store), autocommit=True) as other:
            other.execute(
                "SELECT pg_terminate_backend(pid) FROM pg_stat_activity"
                " WHERE datname = current_database() AND pid <> pg_backend_pid()"
            )
        assert store.put_reports([report(1), report(2)]) == ["duplicate", "stored"]
        assert store.counts().reports == 2


def store_url(store: PostgresStore) -> str:
    return store.location


@pytest.mark.parametrize(
    ("change", "says"),
    [
        (lambda url: url.replace("host=/", "host=/nowhere/"), "no server answers there"),
        (lambda url: url.replace("/test_", "/missing_"), "no such database; createdb makes one"),
        (lambda url: url.replace("gnd@", "stranger@"), "does not know the user"),
        (lambda url: "service=nobody-has-this", "no such service"),
        (lambda url: "host=", "postgresql"),
    ],
)
def test_what_stands_against_a_connection_is_said_in_one_line(
    new_database: NewDatabase, change: Callable[[str], str], says: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("PGHOST", "/nowhere")
    with pytest.raises(StoreUnavailable, match=says) as caught:
        PostgresStore(change(new_database()))
    assert "\n" not in str(caught.value)


def test_of_two_hosts_the_one_that_takes_writes_is_found(postgres: PostgresServer, new_database: NewDatabase) -> None:
    url = new_database().replace("?host=", "?host=/nowhere,") + "&target_session_attrs=read-write"
    with PostgresStore(url) as store:
        store.put_tiles([tile_of_voxels(TILE, 1, 2)])
        assert store.location.endswith(f"?host=/nowhere,{postgres.folder}")
    told = "postgresql://gnd@db-a:5432,db-b:5433/gnd"
    assert shown_conninfo(f"{told}?target_session_attrs=read-write&password=secret") == told
    assert shown_conninfo("host=a,b port=5432 dbname=d") == "postgresql://a:5432,b:5432/d"
    assert shown_conninfo("host=a dbname=d") == "postgresql://a/d"


def test_a_silent_host_holds_nobody_up_and_one_that_takes_over_meanwhile_is_found(
    postgres: PostgresServer, new_database: NewDatabase
) -> None:
    url = new_database()
    name = url.split("/")[3].split("?")[0]
    with socket.create_server(("127.0.0.1", 0)) as silent:  # the kernel accepts, nobody answers
        port = silent.getsockname()[1]
        both = f"{url.replace('?host=', '?host=127.0.0.1,')}&port={port},5432&target_session_attrs=read-write"
        since_s = time.monotonic()
        PostgresStore(both + "&connect_timeout=30").close()
        postgres.sql(f"ALTER DATABASE {name} SET default_transaction_read_only = on")
        with pytest.raises(StoreUnavailable, match=r"read-only.*timeout|timeout.*read-only"):
            connect(both + "&connect_timeout=2", DatabaseClock())
        later = threading.Timer(0.2, postgres.sql, [f"ALTER DATABASE {name} RESET default_transaction_read_only"])
        later.start()
        PostgresStore(both + "&connect_timeout=30").close()
        later.join()
        assert time.monotonic() - since_s < 25.0, "30 s are what the silent host takes"


def test_a_wrong_password_is_said_and_never_shown(postgres: PostgresServer, new_database: NewDatabase) -> None:
    url = new_database()
    postgres.sql("CREATE ROLE locked LOGIN PASSWORD 'right'")
    rules = postgres.data / "pg_hba.conf"
    before = rules.read_text()
    rules.write_text("local all locked scram-sha-256\n" + before)
    postgres.sql("SELECT pg_reload_conf()")
    try:
        with pytest.raises(StoreUnavailable, match="the password was not accepted") as caught:
            open_store(url.replace("gnd@", "locked:wr0ng@"))
        assert "wr0ng" not in str(caught.value)
        with pytest.raises(StoreUnavailable, match="has no right to this"):
            open_store(url.replace("gnd@", "locked:right@"))
    finally:
        rules.write_text(before)
        postgres.sql("SELECT pg_reload_conf()")


def test_a_store_of_a_newer_release_or_another_program_is_left_alone(
    postgres: PostgresServer, new_database: NewDatabase
) -> None:
    url = new_database()
    maker = PostgresMaker(url)
    maker.sql("UPDATE store_schema SET version = 999")
    with pytest.raises(StoreUnavailable, match=f"store schema 999, this release reads up to {SCHEMA_VERSION}"):
        maker.open()
    maker.sql("DROP TABLE store_schema")
    with pytest.raises(StoreUnavailable, match="tables of another program"):
        maker.open()
    with pytest.raises(StoreUnavailable, match="an empty database, not a tile store"):
        PostgresStore(postgres.url("postgres"), create=False)
    with pytest.raises(StoreUnavailable, match="PostgreSQL 13 is too old; 15 or newer"):
        _require_new_enough(130_010, "here")


def test_who_only_reads_writes_nothing(new_database: NewDatabase) -> None:
    url = new_database()
    with PostgresMaker(url).open() as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
    with PostgresStore(url, read_only=True) as store:
        assert [one.tile for one in store.heads()] == [TILE]
        with pytest.raises(StoreUnavailable, match="opened for reading only"):
            store.put_tiles([tile_of_voxels(TILE, 2)])


def test_of_several_processes_one_makes_the_schema(postgres: PostgresServer) -> None:
    postgres.sql("CREATE DATABASE raced")
    failed: list[Exception] = []

    def open_it() -> None:
        try:
            PostgresStore(postgres.url("raced")).close()
        except Exception as error:
            failed.append(error)

    threads = [threading.Thread(target=open_it) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failed == []
    postgres.sql("DROP DATABASE raced")


def test_locations() -> None:
    assert file_of(Path("a/b.db")) == file_of("a/b.db") == file_of("sqlite:a/b.db") == Path("a/b.db")
    for url in ("postgresql://u@h/d", "postgres://h/d", "postgresql:service=gnd"):
        assert file_of(url) is None
    assert shown("postgresql://u:secret@h/d?password=secret&x=1") == "postgresql://u@h/d&x=1"
    assert shown("postgresql:host=h password=secret dbname=d") == "postgresql:host=h dbname=d"
    assert shown(Path("a.db")) == "a.db"


def test_the_clock_of_a_test_is_the_queue_s(new_database: NewDatabase) -> None:
    clock = Clock()
    with PostgresMaker(new_database()).open(EAGER, clock) as store:
        store.put_reports([report(1)])
        assert len(store.claim("m1", 1, 5.0)) == 1
        clock.advance(5.0)
        assert len(store.claim("m2", 1, 5.0)) == 1
