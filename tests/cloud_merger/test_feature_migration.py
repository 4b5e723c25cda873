"""A store of the release before feature layers had windows: `store_schema_7.sqlite.gz` was made by 07f04d4.

Its layer of signs: three reports before a rollback, 40 of one talker, three vehicles that say that sign 7 is gone and
that there is a new one, and one report that waits. Its voxels: two windows of `test_windows`.
"""

import gzip
import shutil
from pathlib import Path

import pytest
from feature_cloud import EXIST, TILE, change, feature, found, published, report, seen

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.features import FeatureMergeParameters
from gnd.cloud_merger.features.kept import FeatureInbox
from gnd.cloud_merger.features.memory import LayerMemory
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

OLD = Path(__file__).parents[1] / "tile_store" / "data" / "store_schema_7.sqlite.gz"
MAP = published([feature(7, -5.0, 3.0), feature(9, 6.0, -2.0)])
START_NS = 1_800_000_000_000_000_000


@pytest.fixture
def path(tmp_path):
    path = tmp_path / "map.sqlite"
    with gzip.open(OLD) as packed, path.open("wb") as file:
        shutil.copyfileobj(packed, file)
    return path


@pytest.fixture
def store(path):
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        yield store


def merges(store):
    worker = Worker(store, ShardConfig(store_path=store.path))
    while claims := store.claim("one", 4, 30.0):
        store.publish(worker.merge(claims))


def hears(store, number, *said, vehicle, later_s=0):
    inbox = FeatureInbox(store, FeatureMergeParameters(), (), reach_tiles=3)
    store.put_reports(inbox.rows(report(number, change(*said, base=MAP), vehicle=vehicle), START_NS + later_s * 10**9))
    merges(store)


def head(store):
    return store.get("signs", TILE).decode_features().features


def test_what_counted_of_a_layer_is_its_first_window_and_what_did_not_counts_no_more(store):
    before = head(store)
    rows = store.in_play("signs", TILE).reports
    vehicles = [row.vehicle for row in rows]
    assert {row.window for row in rows} == {0}
    assert (len(rows), vehicles.count("talker"), vehicles.count("waits")) == (20, 16, 1)
    assert not any(vehicle.startswith("old") for vehicle in vehicles)
    merges(store)
    assert head(store) == before


def test_its_layer_is_folded_and_goes_on(store):
    before = head(store)
    (new,) = {one.feature_id for one in before} - {9}
    hears(store, 1000, seen(9), vehicle="next")
    hears(store, 1001, found(2.1, 2.0), vehicle="another", later_s=7200)
    assert [row.vehicle for row in store.in_play("signs", TILE).reports] == ["another"]
    memory = LayerMemory.decode(store.in_play("signs", TILE).memory.memory)
    assert {one.feature_id for one in memory.tracks if one.is_published} == {9, new}
    assert {one.feature_id for one in head(store)} == {9, new}
    for k in range(5):
        hears(store, 1010 + k, seen(7, EXIST), vehicle=f"back-{k}", later_s=10_000 * (k + 1))
    assert {one.feature_id for one in head(store)} == {7, 9, new}


def test_its_versions_are_verified_as_far_as_can_be(store):
    hears(store, 1000, found(-9.0, 9.0), vehicle="a")
    hears(store, 1001, found(-9.0, 9.0), vehicle="b", later_s=7200)
    verifier = Verifier(store, ShardConfig(store_path=store.path))
    signs = list(verifier.history("signs", TILE))
    assert [one.status for one in signs] == ["given", "unknown", "unknown", "given", "unknown", "unknown", "same"]
    assert signs[-1].assumed == ""
    assert "older than the windows" in signs[1].reason
    (tile,) = [one.tile for one in store.heads("ndt")]
    voxels = list(verifier.history("ndt", tile))
    assert {one.status for one in voxels} == {"given", "same"}
    assert all(one.assumed for one in voxels if one.status == "same")
