"""Who is contradicted by others: tests of reports, accounts, quarantine, and the map without the quarantined."""

import time
from collections.abc import Iterable, Mapping
from dataclasses import replace
from pathlib import Path

import pytest
from click.testing import CliRunner
from merger_world import BALL, GROUND, WALL, change_of, gaussians_of, report_of, seen_by

from gnd.cloud_merger import agreement
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.merge import MergeParameters
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.deploy.cli import gnd
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.grid import VoxelGrid
from gnd.gnd_map.tile import Tile, content_sha
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.tile_store import sql_trust
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import QUARANTINED, StoreConfig, VehicleTrust

FIRST = 497353963154
TILES = [TileId(FIRST + number) for number in range(4)]
NS = 1_700_000_000_000_000_000
CAR = (0.0, 0.0, 0.0, 0.25, 0.25, 0.2)
WIDE = 24  # voxels of a wall
USUAL = MergeParameters()


def wall_of(tile: TileId) -> list[int]:
    """Voxels of a wall of a tile, two floors high: nothing that parks has such a shape."""
    grid = VoxelGrid.of(tile)
    return sorted(int(grid.voxel_id(3 + n % WIDE, 10, 40 + n // WIDE)) for n in range(2 * WIDE))


def ground_of(tile: TileId) -> list[int]:
    grid = VoxelGrid.of(tile)
    return sorted(int(grid.voxel_id(x, y, 39)) for x in range(3, 3 + WIDE) for y in (7, 8, 9, 10))


def base_of(tile: TileId) -> Gaussians:
    return gaussians_of(dict.fromkeys(wall_of(tile), WALL) | dict.fromkeys(ground_of(tile), GROUND))


def observed(tile: TileId) -> list[int]:
    return sorted({*wall_of(tile), *ground_of(tile), *new_of(tile)})


def new_of(tile: TileId) -> list[int]:
    """Voxels in which the map holds nothing: another wall."""
    grid = VoxelGrid.of(tile)
    return sorted(int(grid.voxel_id(3 + n % WIDE, 13, 40 + n // WIDE)) for n in range(2 * WIDE))


def says(number: int, vehicle: str, changed: Mapping[TileId, Mapping[int, object]]) -> list[ChangeReport]:
    """What a vehicle says of all tiles: these changes, all else is as in the base."""
    found = []
    for k, tile in enumerate(TILES):
        told = seen_by(vehicle, changed.get(tile, {}))  # type: ignore[arg-type]
        change = change_of(base_of(tile), observed(tile), told, tile=tile)
        found.append(at(number, report_of(100 * number + k, change, vehicle=vehicle)))
    return found


def at(number: int, report: ChangeReport) -> ChangeReport:
    """Vehicles drive a minute after each other, in the order of their numbers."""
    return replace(report, first_ns=NS + (60 * number - 20) * 10**9, last_ns=NS + 60 * number * 10**9)


@pytest.fixture
def store(tmp_path: Path) -> Iterable[SqliteStore]:
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([Tile(tile, 0, base_of(tile)) for tile in TILES])
        yield store


def take(
    store: SqliteStore, reports: Iterable[ChangeReport], received_ns: int = NS, merge: MergeParameters = USUAL
) -> None:
    """Put reports and merge until nothing waits."""
    for one in reports:
        store.put_reports(rows_of(one, received_ns, together=merge.together))
    config = ShardConfig("one", store.path, merge=merge, store=StoreConfig(merge_delay_s=0.0))
    worker = Worker(store, config)
    while claims := store.claim("one", 16, 60.0):
        worker.begin(claims)
        worker.settle_some(claims)


def wait_and_take(store: SqliteStore) -> None:
    """The commands leave the usual pause before a tile is merged."""
    while store.dirty_tiles():
        time.sleep(0.05)
        take(store, [])


def shas(store: SqliteStore) -> list[bytes]:
    return [head.sha for head in store.heads("ndt")]


GONE = {tile: dict.fromkeys(wall_of(tile), None) for tile in TILES}
BUILT = {tile: dict.fromkeys(new_of(tile), BALL) for tile in TILES}
NOTHING: dict[TileId, dict[int, object]] = {}
UNTOUCHED = [content_sha(tile, base_of(tile)) for tile in TILES]


def test_who_deletes_what_others_see_is_named_and_counts_no_more(store: SqliteStore) -> None:
    take(store, says(1, "bad", GONE))
    take(store, [*says(2, "a", NOTHING), *says(3, "b", NOTHING), *says(4, "c", BUILT)])
    assert store.quarantined_vehicles() == {"bad"}
    (bad,) = [one for one in store.vehicle_trusts() if one.vehicle == "bad"]
    assert (bad.tested, bad.refuted, bad.refuted_claims) == (4, 4, 4 * 2 * WIDE)
    assert bad.by == "agreement"
    assert "4 of 4 tiles" in bad.why or "3 of 3 tiles" in bad.why
    assert shas(store) == UNTOUCHED
    assert {one.reason for one in store.waiting_changes() if one.vehicle == "bad"} == {"quarantined"}


def test_what_has_just_changed_names_nobody(store: SqliteStore) -> None:
    """Others came before: that they saw a wall does not contradict who comes later and sees none."""
    take(store, [*says(1, "a", NOTHING), *says(2, "b", NOTHING), *says(3, "late", GONE)])
    assert store.quarantined_vehicles() == frozenset()
    assert shas(store) == UNTOUCHED  # one voice against two


def test_who_invents_is_named(store: SqliteStore) -> None:
    take(store, [*says(2, "a", NOTHING), *says(3, "b", NOTHING), *says(1, "bad", BUILT)])
    assert store.quarantined_vehicles() == {"bad"}
    assert shas(store) == UNTOUCHED


@pytest.mark.parametrize("is_counted", [True, False])
def test_who_errs_about_little_of_what_it_sees_is_not_named(
    store: SqliteStore, monkeypatch: pytest.MonkeyPatch, is_counted: bool
) -> None:
    """Where nothing has changed all that an honest vehicle claims is wrong: a tenth of each tile here, edges say."""
    if not is_counted:
        monkeypatch.setattr(agreement, "REFUTED_SEEN", 0.0)
        monkeypatch.setattr(sql_trust, "REFUTED_SEEN", 0.0)
    edges = {tile: dict.fromkeys(wall_of(tile)[:14], None) for tile in TILES}
    take(store, [*says(1, "rough", edges), *(one for n, name in enumerate("abc", 2) for one in says(n, name, NOTHING))])
    (rough,) = [one for one in store.vehicle_trusts() if one.vehicle == "rough"]
    assert (rough.tested, rough.claims, rough.refuted_claims, rough.seen) == (4, 56, 56, 4 * len(base_of(TILES[0])))
    assert rough.refuted == (0 if is_counted else 4)
    assert store.quarantined_vehicles() == (frozenset() if is_counted else {"rough"})
    assert shas(store) == UNTOUCHED


def test_who_invents_little_but_everywhere_is_named(store: SqliteStore) -> None:
    """As little as the edges of the other one: but nothing that others see makes it look as if something had come."""
    some = {tile: dict.fromkeys(new_of(tile)[:14], BALL) for tile in TILES}
    take(store, [*says(1, "bad", some), *(one for n, name in enumerate("abc", 2) for one in says(n, name, NOTHING))])
    assert store.quarantined_vehicles() == {"bad"}
    assert shas(store) == UNTOUCHED


@pytest.mark.parametrize(
    ("refuted", "claims", "wrong", "quotes", "missed", "seen", "bad"),
    [
        (3, 42, 42, 0, 0, 500, False),  # all that it claims is wrong, and that is little of what it has seen
        (3, 42, 42, 0, 0, 400, True),
        (2, 42, 42, 0, 0, 400, False),
        (3, 100, 42, 60, 20, 400, False),  # most of its statements hold
        (4, 42, 42, 0, 0, 5000, True),  # in half of its tiles
        (3, 0, 0, 42, 42, 5000, True),  # it never sees what has changed
        (3, 42, 42, 0, 0, 0, True),  # by a release that did not note what was seen
    ],
)
def test_who_is_wrong_in_few_tiles_of_many_is_out_if_it_is_much(
    refuted: int, claims: int, wrong: int, quotes: int, missed: int, seen: int, bad: bool
) -> None:
    assert sql_trust.is_bad(VehicleTrust("v", 8, refuted, claims, wrong, quotes, missed, False, seen=seen)) == bad


def test_who_says_that_nothing_has_changed_is_named_by_three(store: SqliteStore) -> None:
    take(store, [*says(1, "a", GONE), *says(2, "b", GONE), *says(5, "old", NOTHING)])
    assert store.quarantined_vehicles() == frozenset()
    take(store, says(4, "c", GONE))
    assert store.quarantined_vehicles() == {"old"}
    assert [set(head.decode_gaussians().gaussians.voxel_id) for head in heads(store)] == [
        set(ground_of(tile)) for tile in TILES
    ]


def heads(store: SqliteStore) -> list[object]:
    return [store.get("ndt", tile) for tile in TILES]


def test_one_contradiction_names_nobody(store: SqliteStore) -> None:
    """One vehicle against one other: nobody knows who is right, so nobody is named, and the change waits."""
    take(store, [*says(1, "a", NOTHING), *says(2, "bad", GONE)])
    assert store.quarantined_vehicles() == frozenset()
    assert store.vehicle_trusts() == []
    assert shas(store) == UNTOUCHED


def test_a_vehicle_is_no_witness_of_itself(store: SqliteStore) -> None:
    reports = [replaced for number in range(2, 14) for replaced in says(number, "bad", GONE)]
    take(store, [*says(1, "a", NOTHING), *reports])
    assert store.quarantined_vehicles() == frozenset()
    assert shas(store) == UNTOUCHED  # twelve reports of one vehicle are one vote


def test_road_works_name_nobody(store: SqliteStore) -> None:
    """Four honest vehicles see that a wall has gone in every tile, a fifth has seen the street before."""
    take(store, says(1, "before", NOTHING), NS)
    later = NS + 2 * 3600 * 10**9
    take(store, [one for number, name in enumerate("abcd", 2) for one in says(number, name, GONE)], later)
    assert store.quarantined_vehicles() == frozenset()
    assert all(one.refuted == 0 for one in store.vehicle_trusts())


def test_one_wrong_tile_is_forgiven(store: SqliteStore) -> None:
    once = {TILES[0]: GONE[TILES[0]]}
    take(store, [*says(2, "a", NOTHING), *says(3, "b", NOTHING), *says(1, "once", once)])
    assert store.quarantined_vehicles() == frozenset()
    assert shas(store) == UNTOUCHED


def test_three_that_lie_first_name_none_of_those_who_come_after(store: SqliteStore) -> None:
    """Also not while only as many have come as have lied."""
    take(store, [one for number, name in enumerate("xyz", 1) for one in says(number, name, GONE)])
    take(store, [one for number, name in enumerate("abc", 4) for one in says(number, name, NOTHING)])
    assert store.quarantined_vehicles() == frozenset()
    take(store, [one for number, name in enumerate("de", 7) for one in says(number, name, NOTHING)])
    assert store.quarantined_vehicles() <= set("xyz")
    assert shas(store) == UNTOUCHED


def test_the_order_of_arrival_decides_nothing(tmp_path: Path) -> None:
    fleet = [says(3, "a", NOTHING), says(1, "bad", GONE), says(4, "b", NOTHING), says(2, "worse", BUILT)]
    ends = []
    for k, order in enumerate(([0, 2, 1, 3], [2, 3, 0, 1], [1, 0, 2, 3])):
        with SqliteStore(tmp_path / f"{k}.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
            store.put_tiles([Tile(tile, 0, base_of(tile)) for tile in TILES])
            for number in order:
                take(store, fleet[number])
            ends.append((shas(store), store.quarantined_vehicles()))
    assert ends == [(UNTOUCHED, {"bad", "worse"})] * 3


def test_every_version_is_recomputed_with_who_counted_then(store: SqliteStore) -> None:
    take(store, says(1, "bad", {tile: dict(list(gone.items())[:8]) for tile, gone in GONE.items()}))
    take(store, [*says(3, "a", NOTHING), *says(4, "b", NOTHING), *says(2, "bad", GONE), *says(5, "c", BUILT)])
    assert store.quarantined_vehicles() == {"bad"}
    verifier = Verifier(store, ShardConfig("one", store.path))
    for tile in TILES:
        for info in store.history("ndt", tile):
            assert verifier.version("ndt", tile, info.version).status in ("same", "given"), info


def test_an_operator_quarantines_and_releases(store: SqliteStore, tmp_path: Path) -> None:
    take(store, [*says(1, "a", GONE), *says(2, "b", GONE)])
    changed = shas(store)
    assert changed != UNTOUCHED
    run = CliRunner()
    path = str(store.path)
    done = run.invoke(gnd, ["vehicles", "quarantine", path, "a", "--why", "camera of the owner was stolen"])
    assert done.exit_code == 0, done.output
    wait_and_take(store)
    assert shas(store) == UNTOUCHED  # what is left is one vehicle's word, and too much for one
    assert "camera of the owner was stolen" in run.invoke(gnd, ["vehicles", "list", path]).output
    assert "does not count since" in run.invoke(gnd, ["vehicles", "why", path, "a"]).output
    assert run.invoke(gnd, ["vehicles", "release", path, "a"]).exit_code == 0
    wait_and_take(store)
    assert shas(store) == changed


def test_who_is_released_is_pardoned_once(store: SqliteStore) -> None:
    take(store, [*says(2, "a", NOTHING), *says(3, "b", NOTHING), *says(1, "bad", GONE)])
    assert store.quarantined_vehicles() == {"bad"}
    assert store.release_vehicle("bad")
    take(store, [])
    assert store.quarantined_vehicles() == frozenset()
    assert shas(store) == UNTOUCHED
    take(store, [*says(15, "a", NOTHING), *says(16, "b", NOTHING), *says(14, "bad", GONE)])
    assert store.quarantined_vehicles() == {"bad"}
    assert not store.release_vehicle("nobody")


def test_names_that_cannot_be_vehicles_mark_the_quarantined() -> None:
    with pytest.raises(Exception, match="vehicle"):
        report_of(1, change_of(base_of(TILES[0]), observed(TILES[0]), {}, tile=TILES[0]), vehicle=QUARANTINED + "a")


def test_what_parks_is_nobodys_fault(store: SqliteStore) -> None:
    """A vehicle sees cars in every tile that are gone when others pass: it is not contradicted by that."""
    cars = {}
    for tile in TILES:
        grid = VoxelGrid.of(tile)
        parked = [int(grid.voxel_id(x0 + x, 7 + y, 40)) for x0 in (4, 14) for x in range(4) for y in range(2)]
        cars[tile] = dict.fromkeys(parked, CAR)
    seen = {tile: sorted({*observed(tile), *cars[tile]}) for tile in TILES}

    def all_say(number: int, vehicle: str, changed: Mapping[TileId, Mapping[int, object]]) -> list[ChangeReport]:
        changes = [
            change_of(base_of(tile), seen[tile], changed.get(tile, {}), tile=tile)  # type: ignore[arg-type]
            for tile in TILES
        ]
        return [at(number, report_of(100 * number + k, one, vehicle=vehicle)) for k, one in enumerate(changes)]

    take(store, [*all_say(2, "a", NOTHING), *all_say(3, "b", NOTHING), *all_say(1, "honest", cars)])
    assert all(one.refuted == 0 for one in store.vehicle_trusts())
    assert store.quarantined_vehicles() == frozenset()
