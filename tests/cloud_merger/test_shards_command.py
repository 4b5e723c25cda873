"""`gnd shards` over a real store: who lives, what each has, what waits."""

import json

import pytest
from click.testing import CliRunner
from merger_processes import Cloud, wait_for
from merger_world import GROUND, POLE, TILE, change_of, gaussians_of, report_of, tile_of_states

from gnd.cloud_merger.ownership import shared_out
from gnd.cloud_merger.shards_cli import shards
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import split
from gnd.tile_store import values
from gnd.tile_store.errors import StoreError
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig

STATES = {0: GROUND}
TILES = [TileId((TILE.morton & ~1023) + k * 1024 + 5) for k in range(8)]


@pytest.fixture
def path(tmp_path):
    """A store with a tile in each of eight districts."""
    path = tmp_path / "map.sqlite"
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([tile_of_states(STATES, tile) for tile in TILES])
    return path


def told(path):
    done = CliRunner().invoke(shards, [str(path), "--json"], catch_exceptions=False)
    assert done.exit_code == 0
    return json.loads(done.stdout)


def districts_of(path):
    """How many districts each shard has that has any."""
    return {one["owner"]: one["districts"] for one in told(path)["shards"] if one["districts"]}


def put_report(store, tile):
    report = report_of(1, change_of(gaussians_of(STATES), [0, 2], {2: POLE}, tile=tile))
    rows = [ReportRow(report.report_id, "ndt", one, report.vehicle, 0, body) for one, body in split(report)]
    store.put_reports(rows)


def test_without_shards_nobody_has_anything(path):
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        put_report(store, TILES[0])
    assert told(path) == {"shards": [], "districts": 8, "largest_share": None, "waiting_tiles": 1}
    assert "no shard lives" in CliRunner().invoke(shards, [str(path)]).stdout


def test_shards_share_the_districts_and_what_waits_is_its_owners(path):
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        for name in ("one", "two"):
            store.join(name)
        put_report(store, TILES[0])
        values = told(path)
    assert (values["districts"], values["largest_share"], values["waiting_tiles"]) == (8, 1.0, 1)
    owner = shared_out({tile.district for tile in TILES}, {"one", "two"})[TILES[0].district]
    assert {one["owner"]: one["districts"] for one in values["shards"]} == {"one": 4, "two": 4}
    assert {one["owner"]: one["tiles_to_merge"] for one in values["shards"] if one["tiles_to_merge"]} == {owner: 1}
    assert all((one["overdue_s"] > 0) == (one["owner"] == owner) for one in values["shards"])


def test_a_shard_that_is_silent_has_no_districts(path, monkeypatch):
    with SqliteStore(path) as store:
        store.join("gone")
    monkeypatch.setattr(values, "SHARD_SILENT_S", 0.0)
    (gone,) = told(path)["shards"]
    assert (gone["owner"], gone["is_alive"], gone["districts"]) == ("gone", False, 0)
    assert "silent" in CliRunner().invoke(shards, [str(path)]).stdout


def test_no_store_is_one_line(tmp_path):
    with pytest.raises(StoreError, match=r"nothing\.sqlite"):
        CliRunner().invoke(shards, [str(tmp_path / "nothing.sqlite")], catch_exceptions=False)


@pytest.mark.slow
def test_real_shards_are_seen_and_a_killed_one_leaves_its_districts_to_the_other(tmp_path, free_port):
    cloud = Cloud(tmp_path, free_port)
    cloud.open()
    try:
        cloud.store.put_tiles([tile_of_states(STATES, tile) for tile in TILES])
        cloud.start("one", "two")
        wait_for("each has four", lambda: districts_of(cloud.path) == {"one": 4, "two": 4})
        cloud.kill("one")
        wait_for("two has eight", lambda: districts_of(cloud.path) == {"two": 8})
    finally:
        cloud.close()
