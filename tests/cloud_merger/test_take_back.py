"""What a vehicle has published is taken back when it does not count any more, from closed windows, too."""

from collections.abc import Iterable
from pathlib import Path

import pytest
from test_agreement import GONE, NOTHING, NS, TILES, UNTOUCHED, base_of, new_of, says, shas, take, wait_and_take

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import rows_of
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.tile import Tile
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

LATER = NS + 2 * 3600 * 10**9
LATER_STILL = NS + 4 * 3600 * 10**9
FEW = {tile: dict.fromkeys(new_of(tile)[:8], (0.0, 0.0, 0.2, 0.2, 0.2, 0.2)) for tile in TILES}
"""So few new voxels of a tile that one vehicle is believed."""


@pytest.fixture
def store(tmp_path: Path) -> Iterable[SqliteStore]:
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([Tile(tile, 0, base_of(tile)) for tile in TILES])
        yield store


def found_out(store: SqliteStore) -> list[bytes]:
    """What a vehicle published in a window that is closed; later two others contradict what it claims then."""
    take(store, says(1, "sleeper", FEW))
    published = shas(store)
    assert published != UNTOUCHED
    take(store, [*says(2, "a", NOTHING), *says(3, "b", NOTHING)], LATER)
    take(store, says(140, "sleeper", GONE), LATER_STILL)
    assert all(one.folded for one in store.windows())
    # a report without any change confirms what is published and is not merged: the last one claims a voxel
    one_voxel = {tile: dict.fromkeys(new_of(tile)[-1:], (0.0, 0.0, 0.2, 0.2, 0.2, 0.2)) for tile in TILES}
    take(store, [*says(141, "a", NOTHING), *says(142, "b", one_voxel)], LATER_STILL)
    assert store.quarantined_vehicles() == {"sleeper"}
    return published


def assert_verified(store: SqliteStore) -> None:
    verifier = Verifier(store, ShardConfig("one", store.path))
    for tile in TILES:
        states = {info.version: verifier.version("ndt", tile, info.version) for info in store.history("ndt", tile)}
        assert {one.status for one in states.values()} <= {"same", "given"}, states


def test_what_a_sleeper_published_in_closed_windows_is_taken_back(store: SqliteStore) -> None:
    found_out(store)
    assert shas(store) == UNTOUCHED
    assert_verified(store)  # every version, also those of when it still counted


def test_who_is_released_has_its_closed_windows_replayed(store: SqliteStore) -> None:
    take(store, says(1, "car", FEW))
    take(store, says(2, "other", FEW), LATER)
    published = shas(store)
    store.quarantine_vehicle("car", "its owner asks for it")
    store.quarantine_vehicle("other", "its owner asks for it")
    wait_and_take(store)
    assert shas(store) == UNTOUCHED
    assert store.release_vehicle("car")
    assert store.release_vehicle("other")
    wait_and_take(store)
    assert shas(store) == published
    assert_verified(store)


def test_what_retention_has_removed_the_reports_of_stays(store: SqliteStore) -> None:
    """Others' words were folded with it: they are not lost for one vehicle's sake, and the map says so."""
    take(store, says(1, "sleeper", FEW))
    take(store, [*says(2, "a", FEW), *says(3, "b", FEW)], LATER)
    published = shas(store)
    store.transact(lambda c, _now: c.execute("DELETE FROM report WHERE vehicle = 'sleeper' AND window = 1").fetchall())
    store.quarantine_vehicle("a", "a test")
    wait_and_take(store)
    assert shas(store) == published


def test_a_merge_that_was_begun_before_somebody_was_quarantined_is_not_published(store: SqliteStore) -> None:
    for one in says(1, "car", FEW):
        store.put_reports(rows_of(one, NS))
    worker = Worker(store, ShardConfig("one", store.path, store=StoreConfig(merge_delay_s=0.0)))
    claims = store.claim("one", 16, 60.0)
    worker.begin(claims)
    publications = worker.merge(claims)
    store.quarantine_vehicle("car", "in between")
    assert {one.status for one in store.publish(publications)} == {"stale"}
    wait_and_take(store)
    assert shas(store) == UNTOUCHED
