"""`gnd regions`: a district moves between two stores, with writers at work, killed and gone on with."""

import json
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

import apsw
import pytest
from click.testing import CliRunner
from store_helpers import EAGER, FAR, TILE, publication, report, tile_of_voxels

from gnd.deploy.map_cli import map_group
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.keys import change_key
from gnd.tile_store.cli import store as store_command
from gnd.tile_store.copying import district as moving
from gnd.tile_store.copying.contents import ALL, OF_DISTRICT, STAYS
from gnd.tile_store.errors import DistrictElsewhere
from gnd.tile_store.location import open_store
from gnd.tile_store.regions_cli import regions
from gnd.tile_store.sqlite_store import SqlStore
from gnd.tile_store.uploads import Answered, Settled, Upload
from gnd.tile_store.values import ReportRow

pytest.importorskip("psycopg", reason="pip install 'gnd-fleet[postgres]'")
HOME, AWAY = TILE.district, FAR.district
HOME_TILES = [TILE, *(one for one in TILE.neighbours() if one.district == HOME)]
NAMES = ["file to postgresql", "postgresql to file", "file to file"]
NewDatabase = Callable[[], str]
Places = tuple[str, str]


@pytest.fixture(autouse=True)
def nobody_is_waited_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """No shard and no tile server runs here that has to notice anything."""
    monkeypatch.setattr(moving, "NOTICED_S", 0.0)


@pytest.fixture(params=NAMES)
def places(request: pytest.FixtureRequest, tmp_path: Path) -> Places:
    """A store with two districts, and one of another region, which owns none."""
    here, there = (
        f"sqlite:{tmp_path}/{name}.db" if kind == "file" else request.getfixturevalue("new_database")()
        for name, kind in zip("ab", request.param.split(" to "), strict=True)
    )
    with open_store(here, EAGER) as store:
        fill(store)
    called("create", there, "east")
    return here, there


def fill(store: SqlStore, n: int = 20) -> None:
    store.put_tiles([tile_of_voxels(tile, 1, 2) for tile in [*HOME_TILES, FAR]], surveyed_ns=1_700_000_000_000_000_000)
    for number in range(n):
        store.put_reports([report(number, tile, f"v{number % 7}") for tile in [*HOME_TILES, FAR]])
    store.put_reports([report(1, TILE, layer="signs")])
    store.put_upload(upload(1), "a")
    store.put_upload(upload(2, AWAY), "a")
    store.quarantine_vehicle("v2", "for this test")
    store.note_owner("v1", "owner", 5)


def upload(number: int, district: Any = HOME) -> Upload:
    return Upload(change_key("ndt", district), b"u%d" % number, report(number).report_id, "v1", "packed", 1)


def called(*words: str) -> Any:
    done = CliRunner().invoke(regions, [*words, "--json"])
    assert done.exit_code == 0, done.output + repr(done.exception)
    return json.loads(done.stdout)


def moved(source: str, target: str, *options: str) -> Any:
    (row,) = called("move", HOME.path, "--from", source, "--to", target, *options)["districts"]
    return row


def refused(*words: str) -> str:
    done = CliRunner().invoke(regions, [*words])
    assert done.exit_code != 0
    return str(done.exception) + done.output


def told(location: str, tiles: list[TileId]) -> dict[str, object]:
    with open_store(location, create=False, read_only=True) as store:
        return {
            "reports": [store.in_play("ndt", tile).reports for tile in tiles],
            "marks": [store.in_play("ndt", tile).mark for tile in tiles],
            "versions": [store.history("ndt", tile) for tile in tiles],
            "bodies": [store.get("ndt", tile) for tile in tiles],
            "heads": [one for one in store.heads() if one.tile in tiles],
            "windows": [one for one in store.windows() if one.tile in tiles],
            "dirty": [(one.layer, one.tile, one.reports) for one in store.dirty_tiles() if one.tile in tiles],
        }


def verified(location: str) -> None:
    done = CliRunner().invoke(map_group, ["verify", location.removeprefix("sqlite:"), "--all-versions"])
    assert done.exit_code == 0, done.output


def test_every_table_moves_or_stays() -> None:
    parts = {part.table for part in OF_DISTRICT}
    assert parts | set(STAYS) == {one.table for one in ALL}, "what becomes of it when a district moves?"
    assert not parts & set(STAYS)


def test_a_district_moves_with_all_that_it_holds(places: Places) -> None:
    source, target = places
    before, rest = told(source, HOME_TILES), told(source, [FAR])
    row = moved(source, target)
    assert row["tiles"] == len(HOME_TILES)
    assert row["digest"]
    assert told(target, HOME_TILES) == before
    assert told(source, [FAR]) == rest
    with open_store(source, EAGER) as old, open_store(target, EAGER) as new:
        assert old.districts() == {AWAY}, "the old store has removed it"
        assert new.districts() == {HOME}
        assert new.upload_counts().by_state == {"waiting": 1}
        assert [one.layer for one in new.dirty_tiles() if one.layer == "signs"] == ["signs"]
        assert "v2" in new.quarantined_vehicles(), "who does not count there does not count here"
        assert new.owners_of(["v1"]) == old.owners_of(["v1"])
        assert new.put_reports([report(0, TILE, "v0"), report(1000)]) == ["duplicate", "stored"]
        assert len(new.claim("m", 100, 60.0)) == len(HOME_TILES) + 1, "leases run by the clock of the new place"
        assert old.put_reports([report(2000, FAR)]) == ["stored"]
    for place in places:
        verified(place)
    again = moved(source, target)
    assert (again["rows"], again["was_resumed"]) == (0, True), "it has moved before"


def test_the_second_half_of_a_report_comes_to_the_new_store(places: Places) -> None:
    """Flags came before the move, the Gaussians that were asked for come after it."""
    source, target = places
    flags = upload(30)
    with open_store(source, EAGER) as old:
        old.put_upload(flags, "m")
        claim = next(one for one in old.claim_uploads("m", 8, 60.0) if one.upload == flags)
        flagged = ReportRow(flags.report_id, "ndt", TILE, "v1", 1, b"flags")
        assert old.settle_upload(Settled(claim, "wanted", (flagged,), wanted=b"mask"))
        halves = old.first_halves(flags.key, flags.report_id)
    moved(source, target)
    second = Upload(flags.key, b"gaussians", flags.report_id, "", "gaussians", 2)
    with open_store(source, EAGER) as old, open_store(target, EAGER) as new:
        with pytest.raises(DistrictElsewhere):
            old.put_upload(second, "m")
        assert old.upload_statuses("v1", [flags.report_id]) == []
        assert [one.state for one in new.upload_statuses("v1", [flags.report_id])] == ["wanted"]
        (half,) = new.first_halves(flags.key, flags.report_id)
        assert (half.wanted, half.journal_id, half.body) == (b"mask", flags.report_id, halves[0].body)
        assert new.put_upload(second, "m") == "stored"
        claim = next(one for one in new.claim_uploads("m", 8, 60.0) if one.upload == second)
        both = ReportRow(flags.report_id, "ndt", TILE, "v1", 1, b"both", part=1)
        assert new.settle_upload(Settled(claim, "released", (both,), first=Answered(half.number, "released")))
        assert [one.state for one in new.upload_statuses("v1", [flags.report_id])] == ["released"]
        rows = [(one.part, one.body) for one in new.reports() if one.report_id == flags.report_id]
        assert rows == [(0, b"flags"), (1, b"both")]


def test_who_does_not_own_a_district_writes_nothing_there(places: Places) -> None:
    source, target = places
    with open_store(target, EAGER) as new:
        refused_by(new, TILE)
    moved(source, target)
    with open_store(source, EAGER) as old:
        refused_by(old, TILE)
        with pytest.raises(DistrictElsewhere):
            old.put_reports([report(1, FAR, "w"), report(1)])
        assert "w" not in {row.vehicle for row in old.reports()}, "all or nothing"
        assert old.put_upload(upload(7, AWAY), "a") == "stored"
    with open_store(target, EAGER) as new:
        refused_by(new, FAR)


def refused_by(store: SqlStore, tile: TileId) -> None:
    with pytest.raises(DistrictElsewhere, match="has moved"):
        store.put_reports([report(77, tile)])
    with pytest.raises(DistrictElsewhere, match="has moved"):
        store.put_upload(upload(5, tile.district), "a")
    with pytest.raises(DistrictElsewhere, match="has moved"):
        store.put_tiles([tile_of_voxels(tile, 5)])


def test_who_does_not_know_of_owners_is_refused_by_the_database(tmp_path: Path) -> None:
    """A writer of another release has its own statements; the triggers are the database's."""
    source, target = f"sqlite:{tmp_path}/a.db", f"sqlite:{tmp_path}/b.db"
    with open_store(source, EAGER) as store:
        fill(store)
    called("create", target, "east")
    moved(source, target)
    plain = apsw.Connection(str(tmp_path / "a.db"))
    for sql in (
        "INSERT INTO notice VALUES ('ndt', {}, 9, 1)",
        "INSERT INTO dirty (layer, tile, seq, waiting, ready_ns) VALUES ('ndt', {}, 1, 1, 1)",
        "INSERT INTO journal VALUES ('ndt', {}, 1, 1, 1)",
        "INSERT INTO tile_head VALUES ('ndt', {}, 1, 1, x'00')",
    ):
        with pytest.raises(apsw.ConstraintError, match="not written to here"):
            plain.execute(sql.format(TILE.morton))
    plain.close()


def test_a_district_moves_on_and_back(places: Places) -> None:
    source, target = places
    moved(source, target)
    with open_store(target, EAGER) as new:
        claim = next(one for one in new.claim("m", 100, 60.0) if (one.layer, one.tile) == ("ndt", TILE))
        new.release("m")
        assert claim.seq
        new.put_reports([report(5000)])
    before = told(target, HOME_TILES)
    assert moved(target, source)["epoch"] == 2
    assert told(source, HOME_TILES) == before
    with open_store(source, EAGER) as old:
        assert old.districts() == {HOME, AWAY}
        assert old.put_reports([report(6000)]) == ["stored"]
    rows = {one["store"]: one for one in called("list", source, target)["stores"]}
    states = {(one["region"], row["state"]) for one in rows.values() for row in one["districts"]}
    assert states == {("main", "owned"), ("east", "moved")}


def test_versions_go_on_where_they_were(places: Places) -> None:
    source, target = places
    with open_store(source, EAGER) as store:
        store.put_tiles([tile_of_voxels(TILE, 3)])
        version = store.history("ndt", TILE)[-1].version
    moved(source, target)
    with open_store(target, EAGER) as store:
        while store.claim("other", 100, 60.0):
            pass
        store.release("other")
        claims = [one for one in store.claim("m", 100, 60.0) if (one.layer, one.tile) == ("ndt", TILE)]
        assert claims
        history = store.history("ndt", TILE)
        assert history[-1].version == version
        assert [one.version for one in history] == list(range(1, version + 1))


def test_nothing_acknowledged_is_lost_while_a_district_moves(places: Places) -> None:
    """Writers go on until they are refused, and send to the other store what was."""
    source, target = places
    acknowledged: list[str] = []
    refusals, is_over = [0], threading.Event()

    def write(which: int) -> None:
        number = 10_000 * (which + 1)
        with open_store(source, EAGER) as old, open_store(target, EAGER) as new:
            while not is_over.is_set():
                number += 1
                rows = [report(number, tile, f"w{which}") for tile in HOME_TILES]
                for store in (old, new):
                    try:
                        store.put_reports(rows)
                    except DistrictElsewhere:
                        refusals[0] += 1
                    else:
                        acknowledged.append(rows[0].report_id)
                        break
                assert old.put_reports([report(number, FAR, f"w{which}")]) == ["stored"]

    threads = [threading.Thread(target=write, args=(which,)) for which in range(2)]
    for thread in threads:
        thread.start()
    try:
        row = moved(source, target)
        time.sleep(0.3)
    finally:
        is_over.set()
        for thread in threads:
            thread.join()
    assert row["changes"], "there were some to copy again"
    assert refusals[0], "somebody came while it moved"
    with open_store(target, create=False) as store:
        kept = [one.report_id for one in store.in_play("ndt", TILE).reports if one.vehicle.startswith("w")]
        numbers = [one.seq for one in store.in_play("ndt", TILE).reports]
    assert sorted(kept) == sorted(acknowledged), "none lost, none twice"
    assert len(set(numbers)) == len(numbers)
    print(f"writes of the district were refused for {row['gap_s']:.3f} s")


@pytest.mark.slow
@pytest.mark.parametrize("places", NAMES[:2], indirect=True)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGKILL])
def test_a_move_that_is_interrupted_goes_on(places: Places, number: signal.Signals) -> None:
    """By Ctrl-C or kill -9, again and again, at whatever step it is."""
    source, target = places
    before = told(source, HOME_TILES)
    command = [sys.executable, "-m", "gnd.deploy.cli", "regions", "move", HOME.path, "--from", source, "--to", target]
    interrupted, pause_s = 0, 0.0
    while pause_s < 4.0:
        running = subprocess.Popen([*command, "--json"], stdout=subprocess.PIPE, stderr=subprocess.PIPE)
        started_s = time.monotonic()
        while running.poll() is None and time.monotonic() - started_s < 60 and not _has_begun(source):
            time.sleep(0.005)
        time.sleep(pause_s)
        pause_s += 0.2
        running.send_signal(number)
        _, errors = running.communicate(timeout=60)
        if running.returncode == 0:
            break
        interrupted += 1
        assert number == signal.SIGINT or not errors, errors
    assert interrupted
    moved(source, target)
    assert told(target, HOME_TILES) == before
    with open_store(source, EAGER, create=False) as store:
        assert store.districts() == {AWAY}
        assert store.put_reports([report(1, FAR, "w")]) == ["stored"]
    for place in places:
        verified(place)


def _has_begun(source: str) -> bool:
    with open_store(source, create=False, read_only=True) as store:
        return HOME.path in store.district_owners().by_path


class Killed(BaseException):
    """A process that ends here."""


@pytest.mark.parametrize(
    "step", ["_copy_early", "_behind_the_fence", "_switch", "_finished", "_require_same", "_remove"]
)
def test_at_each_step_it_can_be_gone_on_with(places: Places, step: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """As after kill -9 when the step begins: nothing of what would tidy up is run."""
    source, target = places
    before = told(source, HOME_TILES)

    def killed(*_args: object, **_named: object) -> None:
        raise Killed

    with monkeypatch.context() as patched:
        patched.setattr(moving, step, killed)
        patched.setattr(moving, "_fence_lifted_on_failure", lambda *_: _Nothing())
        with pytest.raises(Killed):
            CliRunner().invoke(regions, ["move", HOME.path, "--from", source, "--to", target])
    with open_store(source, EAGER) as store:
        assert store.put_reports([report(1, FAR, "w")]) == ["stored"], "other districts go on"
        assert all(one.tile == FAR or step == "_copy_early" for one in store.claim("m", 100, 60.0))
        store.release("m")
    assert moved(source, target)["was_resumed"]
    assert told(target, HOME_TILES) == before


class _Nothing:
    def __enter__(self) -> None: ...

    def __exit__(self, *_exception: object) -> None: ...


def test_a_failure_behind_the_fence_lets_the_source_go_on(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = places
    with monkeypatch.context() as patched:
        patched.setattr(moving, "_switch", lambda *_: 1 / 0)
        assert "division" in refused("move", HOME.path, "--from", source, "--to", target)
    with open_store(source, EAGER) as store:
        assert store.put_reports([report(1, TILE, "w")]) == ["stored"]
    moved(source, target)
    with open_store(target, EAGER) as store:
        assert store.put_reports([report(1, TILE, "w")]) == ["duplicate"]


def test_a_move_can_be_abandoned(places: Places, monkeypatch: pytest.MonkeyPatch) -> None:
    source, target = places
    before = told(source, HOME_TILES)
    with monkeypatch.context() as patched:
        patched.setattr(moving, "_fence_lifted_on_failure", lambda *_: _Nothing())
        patched.setattr(moving, "_switch", lambda *_: (_ for _ in ()).throw(Killed()))
        with pytest.raises(Killed):
            CliRunner().invoke(regions, ["move", HOME.path, "--from", source, "--to", target])
    with open_store(source, EAGER) as store:
        refused_by(store, TILE)
    assert moved(source, target, "--abandon") == {"path": HOME.path, "abandoned": True}
    assert told(source, HOME_TILES) == before
    with open_store(source, EAGER) as old, open_store(target, EAGER) as new:
        assert old.put_reports([report(1, TILE, "w")]) == ["stored"]
        assert new.districts() == frozenset()
        refused_by(new, TILE)
    assert moved(source, target, "--abandon") == {"path": HOME.path, "abandoned": False}
    moved(source, target)
    assert "has moved" in refused("move", HOME.path, "--from", source, "--to", target, "--abandon")


def test_what_is_refused(places: Places, tmp_path: Path) -> None:
    source, target = places
    other = f"sqlite:{tmp_path}/other.db"
    open_store(other).close()
    assert "owns district" in refused("move", HOME.path, "--from", source, "--to", other)
    assert "does not own" in refused("move", HOME.path, "--from", target, "--to", source)
    assert "both ends" in refused("move", HOME.path, "--from", source, "--to", source)
    assert "no such store" in refused("move", HOME.path, "--from", f"sqlite:{tmp_path}/none.db", "--to", target)
    assert "no district" in refused("move", "13033/0302", "--from", source, "--to", target)
    assert "name districts" in refused("move", "--from", source, "--to", target)
    (row,) = called("move", HOME.path, "--from", source, "--to", target, "--dry-run")["districts"]
    assert (row["moves"], row["tiles"]) == (True, len(HOME_TILES))
    with open_store(source, EAGER) as store:
        assert store.put_reports([report(900)]) == ["stored"], "nothing was begun"
        assert not store.district_owners().are_several
    moved(source, target)
    assert "has moved to" in refused("move", HOME.path, "--from", source, "--to", other)


def test_all_districts_of_a_store(places: Places) -> None:
    source, target = places
    rows = called("move", "--all", "--from", source, "--to", target)["districts"]
    assert {row["path"] for row in rows} == {HOME.path, AWAY.path}
    with open_store(source) as old, open_store(target, EAGER) as new:
        assert old.districts() == frozenset()
        assert new.districts() == {HOME, AWAY}


def test_a_store_that_shares_a_map_can_be_copied_as_a_whole(places: Places, tmp_path: Path) -> None:
    source, target = places
    moved(source, target)
    whole = f"sqlite:{tmp_path}/whole.db"
    done = CliRunner().invoke(store_command, ["copy", source, whole])
    assert done.exit_code == 0, done.output
    with open_store(whole, EAGER) as store:
        refused_by(store, TILE)
        assert store.put_reports([report(900, FAR)]) == ["stored"]


def test_a_merge_in_hand_publishes_nothing_of_a_district_that_has_moved(places: Places) -> None:
    source, target = places
    with open_store(source, EAGER) as store:
        claims = {one.tile: one for one in store.claim("m", 100, 60.0) if one.layer == "ndt"}
        work = store.load(claims[TILE])
        moved(source, target)
        assert store.publish([publication(work, 9)])[0].status != "published"
    with open_store(target, EAGER) as store:
        assert [one.version for one in store.history("ndt", TILE)] == [1]
