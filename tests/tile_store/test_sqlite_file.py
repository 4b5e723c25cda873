"""The SQLite file itself: its settings, what is refused as a store, and what happens when the disk is full."""

import os
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path

import apsw
import pytest
from store_helpers import EAGER, TILE, report, report_id, tile_of_voxels

from gnd.tile_store.errors import StoreBusy, StoreClosed, StoreError, StoreUnavailable
from gnd.tile_store.migrations import APPLICATION_ID, SCHEMA_VERSION
from gnd.tile_store.sqlite_connection import open_writer
from gnd.tile_store.sqlite_store import SqliteStore


def opens_as(path: Path, **options: bool) -> str:
    """The message with which opening fails; it is one line and names the path."""
    with pytest.raises(StoreUnavailable) as caught:
        SqliteStore(path, **options)
    message = str(caught.value)
    assert "\n" not in message
    assert str(path) in message
    return message


def test_the_writer_syncs_every_commit_to_a_write_ahead_log(tmp_path: Path) -> None:
    connection = open_writer(tmp_path / "s.db", create=True, busy_timeout_s=1.0)
    assert connection.pragma("journal_mode") == "wal"
    assert connection.pragma("synchronous") == 2  # FULL
    assert connection.pragma("user_version") == SCHEMA_VERSION
    assert connection.pragma("application_id") == APPLICATION_ID
    tables = connection.execute("SELECT name, strict FROM pragma_table_list WHERE schema = 'main' AND type = 'table'")
    assert all(strict for name, strict in tables if not name.startswith("sqlite_"))
    connection.close()


def test_a_missing_store_is_not_made_by_who_only_reads(tmp_path: Path) -> None:
    assert "gnd map build" in opens_as(tmp_path / "s.db", create=False)
    assert list(tmp_path.iterdir()) == []


def test_a_missing_folder(tmp_path: Path) -> None:
    assert "its folder must exist" in opens_as(tmp_path / "no" / "s.db")


def test_a_folder_in_the_place_of_the_store(tmp_path: Path) -> None:
    assert "cannot be opened" in opens_as(tmp_path)


def test_a_file_that_is_no_database_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    path.write_bytes(b"a picture of a cat" * 100)
    assert "not an SQLite database" in opens_as(path)
    assert path.read_bytes() == b"a picture of a cat" * 100


def test_a_database_of_another_program_is_left_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    other = apsw.Connection(str(path))
    other.execute("CREATE TABLE music (title TEXT)")
    other.close()
    before = path.read_bytes()
    assert "of another program" in opens_as(path)
    assert path.read_bytes() == before


def test_a_store_of_a_newer_release_is_refused(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    SqliteStore(path).close()
    newer = apsw.Connection(str(path))
    newer.pragma("user_version", SCHEMA_VERSION + 1)
    newer.close()
    assert f"store schema {SCHEMA_VERSION + 1}, this release reads up to {SCHEMA_VERSION}" in opens_as(path)


def test_a_truncated_store_is_named(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    with SqliteStore(path) as store:
        store.put_tiles([tile_of_voxels(TILE, *range(2000))])
    path.write_bytes(path.read_bytes()[:8192])
    with (
        pytest.raises(StoreUnavailable, match=r"damaged .* `gnd map restore` puts a backup back"),
        SqliteStore(path) as store,
    ):
        store.get("ndt", TILE)


def test_a_folder_without_write_access(tmp_path: Path) -> None:
    """In a process that is not root: root may write everywhere."""
    folder = tmp_path / "readonly"
    folder.mkdir()
    path = folder / "s.db"
    SqliteStore(path).close()
    for one in (path, folder):
        one.chmod(0o555 if one.is_dir() else 0o444)
    for parent in folder.parents:
        if parent.stat().st_uid == os.getuid() and parent.name.startswith(("pytest-", "popen-", tmp_path.name)):
            parent.chmod(0o755)
    script = (
        "import os, sys\n"
        "from gnd.tile_store.errors import StoreError\n"
        "from gnd.tile_store.sqlite_store import SqliteStore\n"
        "if os.getuid() == 0: os.setuid(65534)\n"
        "for name in sys.argv[1:]:\n"
        "    try: SqliteStore(name)\n"
        "    except StoreError as error: print(error)\n"
    )
    done = subprocess.run(
        [sys.executable, "-c", script, str(path), str(folder / "new.db")], capture_output=True, text=True, check=True
    )
    lines = done.stdout.splitlines()
    assert len(lines) == 2
    assert all("cannot be opened for writing; its folder must exist and be writable" in line for line in lines)
    assert sorted(one.name for one in folder.iterdir()) == ["s.db"]


def test_several_openers_of_a_new_store_make_it_once(tmp_path: Path) -> None:
    failures: list[Exception] = []
    gate = threading.Barrier(8)

    def use(number: int) -> None:
        gate.wait()
        try:
            with SqliteStore(tmp_path / "s.db", EAGER) as store:
                store.put_reports([report(number)])
        except StoreError as error:
            failures.append(error)

    threads = [threading.Thread(target=use, args=(number,)) for number in range(8)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert failures == []
    with SqliteStore(tmp_path / "s.db", create=False) as store:
        assert store.counts().reports == 8


def test_a_writer_that_waits_too_long_says_so_and_nothing_is_lost(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gnd.tile_store.sqlite_store.BUSY_TIMEOUT_S", 0.05)
    path = tmp_path / "s.db"
    with SqliteStore(path) as store:
        other = apsw.Connection(str(path))
        other.execute("BEGIN IMMEDIATE")
        with pytest.raises(StoreBusy, match="write lock"):
            store.put_reports([report(1)])
        other.execute("ROLLBACK")
        other.close()
        assert store.put_reports([report(1)]) == ["stored"]


def test_readers_do_not_wait_for_a_writer(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    with SqliteStore(path) as store:
        store.put_tiles([tile_of_voxels(TILE, 1)])
        other = apsw.Connection(str(path))
        other.execute("BEGIN IMMEDIATE")
        other.execute("DELETE FROM tile_head")
        assert store.get("ndt", TILE) is not None
        other.execute("ROLLBACK")
        other.close()


def test_a_full_disk_is_named_nothing_is_half_written_and_it_goes_on_afterwards(tmp_path: Path) -> None:
    path = tmp_path / "s.db"
    with SqliteStore(path, EAGER) as store:
        store.put_reports([report(1)])
        # The store's own connection gets no more pages, as on a full disk.
        room = store._writer.run(lambda c: c.pragma("page_count"))
        store._writer.run(lambda c: c.pragma("max_page_count", room + 3))
        big = [report(number, body=bytes(5000)) for number in range(2, 12)]
        with pytest.raises(StoreUnavailable, match="disk full"):
            store.put_reports(big)
        assert [row.report_id for row in store.reports()] == [report_id(1)]
        store._writer.run(lambda c: c.pragma("max_page_count", room + 1000))
        assert store.put_reports(big) == ["stored"] * 10


def test_after_closing_every_use_is_refused_and_closing_again_is_harmless(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "s.db")
    store.close()
    store.close()
    with pytest.raises(StoreClosed):
        store.put_reports([report(1)])
    with pytest.raises(StoreClosed):
        store.heads()


def test_calls_in_hand_are_finished_before_closing(tmp_path: Path) -> None:
    store = SqliteStore(tmp_path / "s.db", EAGER)
    acknowledged: list[int] = []

    def send(number: int) -> None:
        try:
            store.put_reports([report(number)])
            acknowledged.append(number)
        except StoreClosed:
            pass

    threads = [threading.Thread(target=send, args=(number,)) for number in range(30)]
    for thread in threads:
        thread.start()
    store.close()
    for thread in threads:
        thread.join()
    with SqliteStore(tmp_path / "s.db") as again:
        assert {row.report_id for row in again.reports()} == {report_id(number) for number in acknowledged}


def test_a_call_that_fails_is_undone_alone(tmp_path: Path) -> None:
    """Calls share a commit; the error of one must not touch the others."""
    with SqliteStore(tmp_path / "s.db", EAGER) as store:
        entered, go = threading.Event(), threading.Event()

        def hold(_connection: apsw.Connection) -> None:
            entered.set()
            assert go.wait(10)

        def fail(connection: apsw.Connection) -> None:
            connection.execute("DELETE FROM report")
            raise ValueError("half way")

        outcomes: dict[str, object] = {}

        def call(name: str, work: object) -> None:
            try:
                outcomes[name] = work()  # type: ignore[operator]
            except ValueError as error:
                outcomes[name] = str(error)

        holder = threading.Thread(target=lambda: store._writer.run(hold))
        holder.start()
        assert entered.wait(10)
        threads = [
            threading.Thread(target=call, args=("before", lambda: store.put_reports([report(1)]))),
            threading.Thread(target=call, args=("bad", lambda: store._writer.run(fail))),
            threading.Thread(target=call, args=("after", lambda: store.put_reports([report(2)]))),
        ]
        for thread in threads:
            thread.start()
        go.set()
        for thread in (holder, *threads):
            thread.join()
        assert outcomes == {"before": ["stored"], "bad": "half way", "after": ["stored"]}
        assert store.counts().reports == 2


def test_calls_that_wait_together_share_one_commit(tmp_path: Path) -> None:
    with SqliteStore(tmp_path / "s.db", EAGER) as store:
        entered, go, commits = threading.Event(), threading.Event(), []

        def hold(connection: apsw.Connection) -> None:
            connection.set_commit_hook(lambda: commits.append(1) is not None)
            entered.set()
            assert go.wait(20)

        holder = threading.Thread(target=lambda: store._writer.run(hold))
        holder.start()
        assert entered.wait(20)
        threads = [threading.Thread(target=store.put_reports, args=([report(number)],)) for number in range(50)]
        for thread in threads:
            thread.start()
        deadline = time.monotonic() + 20
        while len(store._writer._waiting) < 50:
            assert time.monotonic() < deadline
            time.sleep(0.001)
        go.set()
        for thread in (holder, *threads):
            thread.join()
        assert len(commits) == 2  # the holder, then all the others
        assert store.counts().reports == 50


def test_who_is_interrupted_while_it_writes_for_others_leaves_nobody_waiting(tmp_path: Path) -> None:
    with SqliteStore(tmp_path / "s.db", EAGER) as store:
        entered, go, outcomes = threading.Event(), threading.Event(), {}

        def hold(_connection: apsw.Connection) -> None:
            entered.set()
            assert go.wait(20)

        def interrupt(connection: apsw.Connection) -> None:
            connection.execute("DELETE FROM report")
            raise KeyboardInterrupt

        def call(name: str, work: Callable[[], object]) -> None:
            try:
                outcomes[name] = work()
            except BaseException as error:
                outcomes[name] = type(error).__name__

        store.put_reports([report(0)])
        calls = [
            ("holder", lambda: store._writer.run(hold)),
            ("interrupted", lambda: store._writer.run(interrupt)),
            ("behind it", lambda: store.put_reports([report(1)])),
        ]
        threads = [threading.Thread(target=call, args=one, daemon=True) for one in calls]
        threads[0].start()
        assert entered.wait(20)
        for number, thread in enumerate(threads[1:], start=1):
            thread.start()
            while len(store._writer._waiting) < number:
                time.sleep(0.001)
        go.set()
        for thread in threads:
            thread.join(20)
        assert outcomes == {"holder": None, "interrupted": "KeyboardInterrupt", "behind it": "StoreUnavailable"}
        assert store.put_reports([report(2)]) == ["stored"]  # and the next one writes again
        assert store.counts().reports == 2  # nothing was deleted, nothing half written


def test_many_threads_take_turns_at_writing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("gnd.tile_store.sqlite_store.GROUP_MAX", 3)
    with SqliteStore(tmp_path / "s.db", EAGER) as store:

        def work(first: int) -> None:
            for number in range(first, first + 40):
                assert store.put_reports([report(number)]) == ["stored"]

        threads = [threading.Thread(target=work, args=(40 * k,)) for k in range(8)]
        for thread in threads:
            thread.start()
        for thread in threads:
            thread.join(60)
        assert not any(thread.is_alive() for thread in threads)
        assert store.counts().reports == 320
    with pytest.raises(StoreClosed):
        store.put_reports([report(999)])
