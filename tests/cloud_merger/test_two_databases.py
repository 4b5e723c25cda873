"""One sequence of reports into SQLite and into PostgreSQL: the same versions, hashes and accounts, and both verify."""

import json
from collections.abc import Callable

import pytest
from click.testing import CliRunner
from merger_world import BALL, POLE, TILE, gaussians_of
from test_agreement import NS, TILES, base_of
from test_groups import some, two_tiles
from test_standing import lies, of
from test_windows import BASE, Cloud, crowd

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.work import Worker
from gnd.deploy.map_cli import map_group
from gnd.gnd_map.tile import Tile
from gnd.gnd_map.tile_id import TileId
from gnd.tile_store.errors import ImpossiblePlace
from gnd.tile_store.location import open_store
from gnd.tile_store.places import ReportPlace, put_place
from gnd.tile_store.retention import retain
from gnd.tile_store.values import StoreConfig


class CloudOver(Cloud):
    """The cloud of `test_windows` over another store."""

    def __init__(self, path, location):
        super().__init__(path)
        self.store.close()
        path.unlink()
        opened = open_store(location, StoreConfig(merge_delay_s=0.0))
        opened._now_ns = lambda: self.now_ns
        self.store = opened
        self.config = ShardConfig(store_path=location, confirmation=self.config.confirmation)
        self.store.put_tiles([Tile(TILE, 1, gaussians_of(BASE))])


def busy(cloud):
    """Windows that close and fold, a stale vehicle, one that all others contradict, and a rollback."""
    stale = gaussians_of(BASE)
    for number, vehicle in enumerate(("anna", "liar", *crowd(3, "night0"))):
        cloud.store.note_owner(vehicle, f"owner {number % 2}", cloud.now_ns)
    for n in range(3):
        cloud.sees([*crowd(2, f"day{n}"), "anna"], {3: BALL, 4: BALL, 5: BALL}, base=stale, later_s=300)
        cloud.sees(["anna", *crowd(3, f"night{n}")], {n: None}, observed=[n], later_s=4000)
        cloud.sees(["liar"], {1: POLE}, later_s=10)
    cloud.store.quarantine_vehicle("liar", "for this test")
    cloud.merges()
    cloud.store.rollback("ndt", TILE, 3)
    cloud.sees(crowd(3, "late"), {2: None}, later_s=100)


def told(store):
    """All that has come of the reports, and when."""
    return {
        "versions": store.history("ndt", TILE),
        "heads": store.heads(),
        "reports": list(store.reports()),
        "provenance": [store.voxel_provenance("ndt", TILE, one.version) for one in store.history("ndt", TILE)],
        "basis": [store.basis("ndt", TILE, one.version) for one in store.history("ndt", TILE)],
        "windows": store.windows(),
        "closed": store.closed_windows("ndt", TILE),
        "trust": store.vehicle_trusts(),
        "accounts": store.vehicle_accounts(),
        "waiting": store.waiting_changes(),
        "counts": store.counts(),
        "owners": store.owners_of(["anna", "liar", *crowd(3, "night0")]),
        "refuted": store.refuted_tests(),
        "alone": store.days_alone(),
        "unheard": store.unheard_vehicles(),
        "unsigned": store.unsigned(),
        "notices": store.notices(),
    }


@pytest.mark.slow
def test_the_same_reports_make_the_same_map(new_database: Callable[[], str], tmp_path) -> None:
    url = new_database()
    found = []
    for location in (tmp_path / "map.sqlite", url):
        cloud = CloudOver(tmp_path / "unused.sqlite", location)
        try:
            busy(cloud)
            found.append(told(cloud.store))
            assert set(cloud.verified()) <= {"given", "same"}
        finally:
            cloud.store.close()
    sqlite, postgres = found
    assert sqlite["versions"][-1].version > 5
    assert any(one.kind == "merged" for one in sqlite["versions"])
    assert len(sqlite["owners"]) == 5
    for name, value in sqlite.items():
        assert postgres[name] == value, name
    for location in (str(tmp_path / "map.sqlite"), url):
        done = CliRunner().invoke(map_group, ["verify", location, "--all-versions", "--json"])
        assert done.exit_code == 0, done.output
        assert json.loads(done.stdout)["identical"]


def test_an_erased_vehicle_leaves_no_name_in_a_database(new_database: Callable[[], str], tmp_path) -> None:
    url = new_database()
    cloud = CloudOver(tmp_path / "unused.sqlite", url)
    cloud.store.note_owner("anna", "her firm", cloud.now_ns)
    cloud.sees(["anna", *crowd(3)], {3: BALL})
    cloud.store.close()
    done = CliRunner().invoke(map_group, ["erase", url, "vehicle:anna"])
    assert done.exit_code == 0, done.output
    assert "until VACUUM FULL" in done.output
    with open_store(url, create=False) as store:
        names = {one.vehicle for one in store.reports()}
        assert "anna" not in names
        assert not store.owners_of(["anna"])
        assert len(store.owners_of(names)) == 1
    done = CliRunner().invoke(map_group, ["verify", url, "--all-versions", "--json"])
    assert json.loads(done.stdout)["identical"]


def test_commands_take_a_database_wherever_they_take_a_file(new_database: Callable[[], str], tmp_path) -> None:
    url = new_database()
    cloud = CloudOver(tmp_path / "unused.sqlite", url)
    cloud.sees(crowd(3), {3: BALL})
    cloud.store.close()
    run = CliRunner()
    for command in ("info", "status", "check", "verify", "quarantine", "gc", "retry"):
        done = run.invoke(map_group, [command, url, "--json", *(["--keep", "5"] if command == "gc" else [])])
        assert done.exit_code == 0, (command, done.output, done.exception)
        json.loads(done.stdout)
    done = run.invoke(map_group, ["rollback", url, TILE.path, "1", "--json"])
    assert done.exit_code == 0, done.output
    done = run.invoke(map_group, ["backup", url, str(tmp_path / "copy.sqlite")])
    assert "a database has" in str(done.exception)
    with open_store(url, create=False) as store:
        assert [one.kind for one in store.history("ndt", TILE)][-1] == "rollback"


@pytest.mark.slow
def test_the_same_vehicles_are_not_believed_alone_and_have_one_vote(new_database: Callable[[], str], tmp_path) -> None:
    found = []
    for location in (tmp_path / "map.sqlite", new_database()):
        with open_store(location, StoreConfig(merge_delay_s=0.0)) as store:
            store.put_tiles([Tile(tile, 0, base_of(tile)) for tile in TILES])
            worker = Worker(store, ShardConfig("one", location, store=StoreConfig(merge_delay_s=0.0)))
            honest = of(2, "honest", {TILES[0]: {}, TILES[1]: {}})
            for one in [*lies(1), *honest, *two_tiles(some(1), "wxyz", 3)]:
                store.put_reports(rows_of(one, NS))
            while claims := store.claim("one", 16, 60.0):
                worker.begin(claims)
                worker.settle_some(claims)
            words = [(one.vehicle, one.day, one.why) for one in store.lone_words()]
            assert {"bad"} <= {vehicle for vehicle, _, _ in words}
            assert {"w", "x", "y", "z"} == {name for one in store.pairs_of_groups() for name in (one.one, one.other)}
            shas = [head.sha for head in store.heads("ndt")]
            found.append((shas, words, store.pairs_of_groups(), store.days_alone(), store.unheard_vehicles()))
            store.transact(lambda c, _now: put_place(c, "car", ReportPlace.of("a", NS, [TILES[0]])))
            far = TileId.from_indices(TILES[0].lon_index + 1000, TILES[0].lat_index)
            with pytest.raises(ImpossiblePlace):
                store.transact(lambda c, _now, far=far: put_place(c, "car", ReportPlace.of("b", NS, [far])))
            assert retain(store, keep_days=0.0).versions == 0
            assert store.look(lambda c: c.fetch("places_of_vehicle", {"vehicle": "car", "n": 9})) == []
    assert found[0] == found[1]
