"""`gnd store copy`: both directions, with writers at work, killed and gone on with; nothing lost, all rows equal."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

import apsw
import pytest
from click.testing import CliRunner
from store_helpers import EAGER, TILE, report, tile_of_voxels

from gnd.deploy.map_cli import map_group
from gnd.tile_store.cli import store as store_command
from gnd.tile_store.copying.contents import ALL, OF_THE_PLACE
from gnd.tile_store.errors import StoreMoved, StoreUnavailable
from gnd.tile_store.location import open_store
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.uploads import Upload

pytest.importorskip("psycopg", reason="pip install 'gnd-fleet[postgres]'")
NewDatabase = Callable[[], str]
Places = tuple[str, str]
_NUMBERS = count()


@pytest.fixture(params=["to postgresql", "to sqlite"])
def places(request: pytest.FixtureRequest, new_database: NewDatabase, tmp_path: Path) -> Places:
    """Where a store is, and where it goes."""
    file, database = f"sqlite:{tmp_path}/store.db", new_database()
    return (file, database) if request.param == "to postgresql" else (database, file)


def fill(store: SqlStore, n: int = 40) -> None:
    tiles = [TILE, *TILE.neighbours()]
    store.put_tiles([tile_of_voxels(tile, [1, 2]) for tile in tiles], surveyed_ns=1_700_000_000_000_000_000)
    for number in range(n):
        store.put_reports([report(number, tile, f"v{number % 7}") for tile in tiles])
        store.put_upload(Upload("k", b"u%d" % number, report(number).report_id, f"v{number % 7}", "packed", 1), "a")
    store.quarantine(b"junk", "not a message", "somewhere")
    store.note_owner("v1", "owner", 5)
    store.quarantine_vehicle("v2", "for this test")
    store.rollback("ndt", TILE, 1)


def copied(source: str, target: str, *options: str) -> dict[str, object]:
    done = CliRunner().invoke(store_command, ["copy", source, target, "--json", *options])
    assert done.exit_code == 0, done.output + repr(done.exception)
    answer: dict[str, object] = json.loads(done.stdout)
    return answer


def refused(source: str, target: str) -> str:
    done = CliRunner().invoke(store_command, ["copy", source, target])
    assert done.exit_code != 0
    return str(done.exception)


def told(location: str) -> dict[str, object]:
    with open_store(location, create=False, read_only=True) as store:
        return {
            "reports": list(store.reports()),
            "heads": store.heads(),
            "versions": [store.history("ndt", one.tile) for one in store.heads()],
            "bodies": [store.get("ndt", one.tile) for one in store.heads()],
            "windows": store.windows(),
            "dirty": store.dirty_tiles(),
            "refused": store.quarantined(),
            "trust": store.vehicle_trusts(),
            "owners": store.owners_of(["v1"]),
            "counts": store.counts(),
            "uploads": store.upload_counts().by_state,
        }


def test_every_table_is_copied_or_of_the_place(tmp_path: Path) -> None:
    open_store(tmp_path / "a.db").close()
    file = apsw.Connection(str(tmp_path / "a.db"))
    tables = {name for (name,) in file.execute("SELECT name FROM sqlite_schema WHERE type = 'table'")}
    file.close()
    assert tables - {one.table for one in ALL} - set(OF_THE_PLACE) == set(), "who copies it?"


def test_a_store_moves_with_all_that_it_holds(places: Places) -> None:
    source, target = places
    with open_store(source, EAGER) as store:
        fill(store)
    before = told(source)
    answer = copied(source, target)
    assert told(target) == before
    assert answer["digest"], "compared row by row"
    with open_store(target, EAGER, create=False) as store:
        assert store.put_reports([report(0, TILE, "v0"), report(1000)]) == ["duplicate", "stored"]
        assert store.claim("m", 100, 60.0), "leases run by the clock of the new place"
    for path in places:
        done = CliRunner().invoke(map_group, ["verify", path.removeprefix("sqlite:"), "--all-versions"])
        assert done.exit_code == 0, done.output


def test_a_store_that_has_moved_says_where(places: Places) -> None:
    source, target = places
    with open_store(source, EAGER) as store:
        fill(store, 2)
        copied(source, target)
        shown = target.removeprefix("sqlite:")
        with pytest.raises(StoreMoved, match="moved to .*" + shown[-12:].replace("?", ".")):
            store.put_reports([report(77)])
        with pytest.raises(StoreMoved):
            store.put_upload(Upload("k", b"new", report(5).report_id, "v", "packed", 1), "a")
        with pytest.raises(StoreMoved):
            store.put_tiles([tile_of_voxels(TILE, [5])])
        with pytest.raises(StoreMoved):
            store.transact(lambda c, _: c.change("touch"))  # of the health check
        with pytest.raises(StoreMoved):
            store.join("shard-0")
        assert len(store.heads()) == len(TILE.neighbours()) + 1, "it can still be read"
    assert "has moved to" in refused(source, target)
    copied(source, target, "--abandon")
    with open_store(source, EAGER) as store:
        assert store.put_reports([report(77)]) == ["stored"]


def test_and_back(new_database: NewDatabase, tmp_path: Path) -> None:
    first, database, second = f"sqlite:{tmp_path}/a.db", new_database(), f"sqlite:{tmp_path}/b.db"
    with open_store(first, EAGER) as store:
        fill(store, 3)
    copied(first, database)
    with open_store(database, EAGER) as store:
        store.put_reports([report(500)])
    before = told(database)
    copied(database, second)
    assert told(second) == before


def test_nothing_acknowledged_is_lost_while_it_moves(places: Places) -> None:
    """Writers go on until they are told where it has moved, and send there what was refused."""
    source, target = places
    acknowledged: list[tuple[int, str]] = []
    with open_store(source, EAGER) as store:
        fill(store, 120)
    is_over = threading.Event()

    def write(which: int) -> None:
        opened, number = open_store(source, EAGER), 10_000 * (which + 1)
        while not is_over.is_set():
            number += 1
            tiles = [TILE, *TILE.neighbours()]
            try:
                opened.put_reports([report(number, tile, f"w{which}") for tile in tiles])
            except StoreMoved:
                opened.close()
                break
            acknowledged.append((number, f"w{which}"))
        opened.close()

    threads = [threading.Thread(target=write, args=(which,)) for which in range(2)]
    for thread in threads:
        thread.start()
    try:
        answer = copied(source, target)
    finally:
        is_over.set()
        for thread in threads:
            thread.join()
    assert acknowledged
    with open_store(target, create=False) as store:
        kept = {row.report_id for row in store.reports()}
        numbers = {one: [row.seq for row in store.in_play("ndt", one).reports] for one in [TILE]}
    assert {report(number, TILE, vehicle).report_id for number, vehicle in acknowledged} <= kept
    assert all(len(set(some)) == len(some) for some in numbers.values())
    assert answer["changes"], "there were some to copy again"
    assert told(source)["reports"] == told(target)["reports"]


@pytest.mark.slow
@pytest.mark.parametrize("is_asked", [True, False])
def test_a_copy_that_is_interrupted_goes_on(places: Places, is_asked: bool) -> None:
    """By Ctrl-C or kill -9, again and again, at whatever step it is."""
    source, target = places
    with open_store(source, EAGER) as store:
        fill(store, 150)
    command = [sys.executable, "-m", "gnd.deploy.cli", "store", "copy", source, target, "--json"]
    interrupted = 0
    for pause_s in (0.02, 0.1, 0.3, 0.6):
        running = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        started_s = time.monotonic()
        while running.poll() is None and time.monotonic() - started_s < 60 and not _has_begun(source):
            time.sleep(0.005)
        time.sleep(pause_s)
        running.send_signal(signal.SIGINT if is_asked else signal.SIGKILL)
        running.communicate(timeout=60)
        if running.returncode == 0:
            break
        interrupted += 1
        with open_store(source, EAGER) as store:
            try:
                store.put_reports([report(3000 + interrupted)])
            except StoreMoved:
                break  # it was killed behind the fence
    assert interrupted
    before = told(source)
    if running.returncode != 0:
        answer = copied(source, target)
        assert answer["was_resumed"]
    assert told(target) == before


def _has_begun(source: str) -> bool:
    try:
        with open_store(source, create=False, read_only=True) as store:
            return bool(store.look(lambda c: c.fetch("copy_has_begun")))
    except StoreUnavailable:
        return False


def test_what_is_refused(places: Places, tmp_path: Path, new_database: NewDatabase) -> None:
    source, target = places
    with open_store(source, EAGER) as store:
        fill(store, 1)
    with open_store(target, EAGER) as store:
        store.put_reports([report(1)])
    before = told(target)
    assert "holds a store" in refused(source, target) or "exists" in refused(source, target)
    assert told(target) == before
    with open_store(source, EAGER) as store:
        assert store.put_reports([report(8)]) == ["stored"], "nothing was begun"
    assert "no such store" in refused(f"sqlite:{tmp_path}/none.db", f"sqlite:{tmp_path}/x.db")
    assert "no" in refused(source, new_database().replace("/test_", "/none_"))
