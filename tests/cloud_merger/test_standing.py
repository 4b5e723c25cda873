"""Who is believed alone: not who is contradicted elsewhere, and nobody without end on one day."""

import itertools
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from merger_world import change_of, report_of, seen_by
from test_agreement import BUILT, GONE, NS, TILES, at, base_of, new_of, observed, shas, take, wall_of

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.erase import erase_vehicle
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.deploy.cli import gnd
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.tile_store import sql_standing
from gnd.tile_store.marks import Marked, contradicted, grouped, over_cap, renamed
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import QUARANTINED, StoreConfig

LAST = TILES[-1]
DAY_NS = 86_400 * 10**9
Changes = Mapping[TileId, Mapping[int, object]]


@pytest.fixture
def store(tmp_path: Path) -> Iterable[SqliteStore]:
    with a_store(tmp_path / "map.sqlite") as store:
        yield store


def a_store(path: Path) -> SqliteStore:
    store = SqliteStore(path, StoreConfig(merge_delay_s=0.0))
    store.put_tiles([Tile(tile, 0, base_of(tile)) for tile in TILES])
    return store


def of(number: int, vehicle: str, changes: Changes) -> list[ChangeReport]:
    """A report of these tiles only."""
    made = []
    for k, (tile, changed) in enumerate(changes.items()):
        told = seen_by(vehicle, changed)  # type: ignore[arg-type]
        change = change_of(base_of(tile), observed(tile), told, tile=tile)
        made.append(at(number, report_of(100 * number + k, change, vehicle=vehicle)))
    return made


def little(tile: TileId, first: int = 0) -> dict[int, object]:
    """Four voxels of a wall, and those above them, gone: so much one vehicle is believed."""
    wall = sorted(wall_of(tile))
    return dict.fromkeys([*wall[first : first + 4], *wall[24 + first : 28 + first]], None)


def reasons(store: SqliteStore, vehicle: str) -> set[tuple[TileId, str]]:
    return {(one.tile, one.reason) for one in store.waiting_changes() if one.vehicle == vehicle}


def changed(store: SqliteStore, tile: TileId) -> int:
    """Voxels of the base that the tile does not hold any more."""
    head = store.get("ndt", tile)
    assert head is not None
    return len(base_of(tile)) - len(head.decode_gaussians().gaussians)


def is_verified(store: SqliteStore) -> bool:
    verifier = Verifier(store, ShardConfig("one", store.path))
    return all(one.status in ("same", "given") for tile in TILES for one in verifier.history("ndt", tile))


def lies(number: int = 1) -> list[ChangeReport]:
    """Much in two tiles, and little in one where nobody else comes."""
    return of(number, "bad", {TILES[0]: GONE[TILES[0]], TILES[1]: BUILT[TILES[1]], LAST: little(LAST)})


def test_who_is_contradicted_elsewhere_is_not_believed_alone(store: SqliteStore) -> None:
    take(store, lies())
    assert changed(store, LAST) == 8
    take(store, of(2, "honest", {TILES[0]: {}, TILES[1]: {}}))
    assert changed(store, LAST) == 0
    assert (LAST, "contradicted") in reasons(store, "bad")
    (word,) = store.lone_words()
    assert (word.vehicle, word.day, word.why) == ("bad", 0, "others deny 96 of 96 claims")
    assert "not believed alone: others deny 96 of 96" in said_of(store, "bad")
    take(store, of(3, "second", {LAST: little(LAST)}))
    assert changed(store, LAST) == 8
    assert is_verified(store)


def journal_of(store: SqliteStore, tile: TileId) -> int:
    """How many numbers its journal has given, to reports and to marks that it is to be merged again."""
    ((given,),) = store.look(lambda c: list(c.execute("SELECT seq FROM journal WHERE tile = ?", (tile.morton,))))  # type: ignore[attr-defined]
    return int(given)


def test_only_where_a_vehicle_claims_something_alone_its_word_is_asked_for(store: SqliteStore) -> None:
    """A tile about which it says what others say, too, is not merged again."""
    take(store, [*lies(), *of(4, "bad", {TILES[2]: {}})])
    before = {tile: journal_of(store, tile) for tile in TILES}
    take(store, of(2, "honest", {TILES[0]: {}, TILES[1]: {}}))
    assert [one.vehicle for one in store.lone_words()] == ["bad"]
    assert journal_of(store, LAST) > before[LAST]
    assert journal_of(store, TILES[2]) == before[TILES[2]]


def test_a_word_that_comes_while_a_tile_is_merged_counts_there(store: SqliteStore) -> None:
    """The merge was begun when nobody had contradicted the vehicle, and nothing was known yet of its claims there."""
    *elsewhere, here = lies()
    take(store, elsewhere)
    store.put_reports(rows_of(here, NS))
    worker = Worker(store, ShardConfig("slow", store.path))
    claims = store.claim("slow", 16, 60.0)
    assert [one.tile for one in claims] == [LAST]
    worker.begin(claims)
    publications = worker.merge(claims)
    take(store, of(2, "honest", {TILES[0]: {}, TILES[1]: {}}))
    assert [one.vehicle for one in store.lone_words()] == ["bad"]
    store.publish(publications)
    assert changed(store, LAST) == 8
    take(store, [])
    assert changed(store, LAST) == 0
    assert is_verified(store)


def test_it_does_not_matter_who_came_first(tmp_path: Path) -> None:
    """Whatever is merged first, the map is the same in the end."""
    found = set()
    told = [*lies(1), *of(2, "honest", {TILES[0]: {}, TILES[1]: {}}), *of(3, "other", {TILES[0]: {}})]
    for number, order in enumerate(itertools.islice(itertools.permutations(told), 0, 720, 103)):
        with a_store(tmp_path / f"{number}.sqlite") as store:
            for one in order:
                take(store, [one])
            found.add((tuple(shas(store)), tuple((one.vehicle, one.why) for one in store.lone_words())))
    assert len(found) == 1


def test_who_agrees_with_others_is_believed_alone(store: SqliteStore) -> None:
    take(store, of(1, "car", {TILES[0]: GONE[TILES[0]], TILES[1]: little(TILES[1]), LAST: little(LAST)}))
    take(store, of(2, "other", {TILES[0]: GONE[TILES[0]], TILES[1]: {}}))
    assert changed(store, LAST) == 8
    assert store.lone_words() == []


def test_an_operator_releases_who_is_not_believed_alone(store: SqliteStore) -> None:
    take(store, [*lies(1), *of(2, "honest", {TILES[0]: {}, TILES[1]: {}})])
    assert changed(store, LAST) == 0
    assert store.release_vehicle("bad")
    take(store, [])
    assert changed(store, LAST) == 8
    assert not store.release_vehicle("bad")


def test_an_erased_vehicle_goes_on_not_being_believed(store: SqliteStore) -> None:
    take(store, [*lies(1), *of(2, "honest", {TILES[0]: {}, TILES[1]: {}})])
    erase_vehicle(store, ShardConfig("one", store.path), "bad")
    assert "bad" not in {one.vehicle for one in (*store.lone_words(), *store.days_alone())}
    assert [one.why for one in store.lone_words()] == ["others deny 96 of 96 claims"]
    assert changed(store, LAST) == 0
    assert is_verified(store)


def on_day(day: int, told: list[ChangeReport]) -> list[ChangeReport]:
    return [replace(one, first_ns=one.first_ns + day * DAY_NS, last_ns=one.last_ns + day * DAY_NS) for one in told]


def test_nobody_changes_more_alone_in_a_day_than_one_may(store: SqliteStore, monkeypatch: pytest.MonkeyPatch) -> None:
    """Eight voxels of each of four tiles, where 20 may be changed: all of them wait, until somebody confirms enough."""
    monkeypatch.setattr(sql_standing, "ALONE_DAY", 20)
    take(store, of(1, "car", {tile: little(tile) for tile in TILES}))
    assert [changed(store, tile) for tile in TILES] == [0, 0, 0, 0]
    assert {reason for _, reason in reasons(store, "car")} == {"day"}
    (word,) = store.lone_words()
    assert (word.day, word.why) == (NS // DAY_NS, "32 voxels changed alone on a day, 0 with others")
    assert "not believed alone on 2023-11-14: 32 voxels" in said_of(store, "car")
    take(store, of(2, "other", {TILES[0]: little(TILES[0])}))
    assert [changed(store, tile) for tile in TILES] == [8, 8, 8, 8]  # 24 alone, 8 with another
    assert store.lone_words() == []
    assert is_verified(store)


def test_the_next_day_counts_for_itself(store: SqliteStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sql_standing, "ALONE_DAY", 20)
    take(store, of(1, "car", {tile: little(tile) for tile in TILES[:3]}))
    assert changed(store, LAST) == 0
    take(store, on_day(1, of(2, "car", {LAST: little(LAST)})), NS + DAY_NS)
    assert changed(store, LAST) == 8
    assert [changed(store, tile) for tile in TILES[:3]] == [0, 0, 0]
    assert is_verified(store)


def test_the_vehicles_of_an_owner_change_no_more_alone_than_a_quarter_of_that_each(
    store: SqliteStore, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Two vehicles of an owner are no more than one; of two owners each may change as much."""
    monkeypatch.setattr(sql_standing, "ALONE_DAY", 20)
    for number, (owner, tiles) in enumerate((("a", TILES[:2]), ("a", TILES[2:3]), ("b", TILES[3:]))):
        store.note_owner(f"v{number}", owner, 0)
        take(store, of(1 + number, f"v{number}", {tile: little(tile) for tile in tiles}))
    assert [changed(store, tile) for tile in TILES] == [0, 0, 0, 8]
    told = {one.vehicle: one.why for one in store.lone_words() if not one.vehicle.startswith("@")}
    why = "24 voxels changed alone on a day, 0 with others by 2 vehicles of its owner"
    assert told == {"v0": why, "v1": why}


def test_new_ground_is_not_counted(store: SqliteStore, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(sql_standing, "ALONE_DAY", 20)
    ground = TileId(TILES[0].morton + 64)
    wall = dict.fromkeys(new_of(ground), (0.0, 0.0, 0.2, 0.2, 0.2, 0.2))
    change = change_of(None, sorted(wall), wall, tile=ground, version=0)
    take(store, [report_of(1, change, vehicle="first")])
    head = store.get("ndt", ground)
    assert head is not None
    assert len(head.decode_gaussians().gaussians) == len(wall)
    assert store.days_alone() == []


def said_of(store: SqliteStore, vehicle: str) -> str:
    result = CliRunner().invoke(gnd, ["vehicles", "why", str(store.path), vehicle])
    assert result.exit_code == 0, result.output
    return " ".join(result.output.split())


def test_marks_are_read_as_they_are_written() -> None:
    words = {"plain", QUARANTINED + "out", contradicted("odd"), over_cap("much", 19_675)}
    words |= {grouped("y", "x"), grouped("x", "x")}
    marked = Marked.of(words)
    assert marked.shifted == {"plain"}
    assert marked.counted_out == {"out"}
    assert marked.contradicted == {"odd"}
    assert marked.over_cap == {("much", 19_675)}
    assert marked.first_of == {"x": "x", "y": "x"}
    assert {renamed(word, "x", "z") for word in words} == words - {grouped("y", "x"), grouped("x", "x")} | {
        grouped("y", "z"),
        grouped("z", "z"),
    }
    assert renamed(over_cap("19675", 19_675), "19675", "z") == over_cap("z", 19_675)
