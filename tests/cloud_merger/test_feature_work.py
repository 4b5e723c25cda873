"""A worker on a store with feature layers beside voxels."""

import pytest
from feature_cloud import ABSENT, EAST, TILE, change, feature, found, published, report, report_id, seen
from merger_world import GROUND, WALL, change_of, gaussians_of, report_of, tile_of_states

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.features import FeatureMergeParameters
from gnd.cloud_merger.features.kept import FeatureInbox
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.features import FeatureTile
from gnd.schemas.changes import split
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import ReportRow, StoreConfig

MAP = published([feature(7, -5.0, 3.0), feature(9, 6.0, -2.0)])


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([FeatureTile.of(TILE, 1, MAP)], layer="signs")
        yield store


@pytest.fixture
def worker(store, tmp_path):
    return Worker(store, ShardConfig(store_path=tmp_path / "map.sqlite"))


@pytest.fixture
def keep(store):
    inbox = FeatureInbox(store, FeatureMergeParameters(), (), reach_tiles=3)
    return lambda *reports: store.put_reports([row for one in reports for row in inbox.rows(one, 0)])


def run(store, worker):
    results = []
    while claims := store.claim("one", 16, 30.0):
        results += store.publish(worker.merge(claims))
    return [one.status for one in results]


def features_of(store, tile=TILE, layer="signs"):
    return store.get(layer, tile).decode_features().features


def test_a_version_says_from_which_reports_each_change_comes(store, worker, keep):
    keep(*(report(n, change(seen(7, ABSENT), found(1.0, 1.0), base=MAP)) for n in (1, 2)))
    assert run(store, worker) == ["published"]
    head = store.get("signs", TILE)
    (new,) = set(head.decode_features().features) - set(MAP)
    both = report_id(1), report_id(2)
    assert store.voxel_provenance("signs", TILE, head.version) == {7: both, new.feature_id: both}
    assert store.provenance("signs", TILE, head.version) == both
    assert head.version == 2


def test_reports_that_change_nothing_are_consumed(store, worker, keep):
    keep(report(1, change(seen(7, ABSENT), found(1.0, 1.0), base=MAP)))
    assert run(store, worker) == ["unchanged"]
    assert (store.counts().waiting, store.dirty_count()) == (0, 0)
    assert features_of(store) == MAP


def test_a_new_layer_gets_its_first_tile_from_two_vehicles(store, worker, keep):
    lamps = [report(n, change(found(1.0, 1.0, kind="streetlight")), layer="streetlights") for n in (1, 2)]
    keep(lamps[0])
    run(store, worker)
    assert store.get("streetlights", TILE) is None
    keep(lamps[1])
    run(store, worker)
    assert [one.kind for one in features_of(store, layer="streetlights")] == ["streetlight"]
    assert features_of(store) == MAP


def test_after_a_rollback_what_was_merged_counts_no_more(store, worker, keep):
    keep(*(report(n, change(seen(7, ABSENT), base=MAP)) for n in (1, 2)))
    run(store, worker)
    assert len(features_of(store)) == 1
    store.rollback("signs", TILE, 1)
    keep(report(3, change(seen(7, ABSENT), base=MAP)))
    run(store, worker)
    assert features_of(store) == MAP


def test_a_thousand_reports_of_one_vehicle_do_not_push_out_those_of_others(store, worker, keep):
    keep(*(report(n, change(found(1.0, 1.0), base=MAP)) for n in (1, 2)))
    run(store, worker)
    before = features_of(store)
    assert len(before) == 3
    talk = change(seen(7, ABSENT), found(-3.0, -3.0), base=MAP, viewed=2**64 - 1)
    keep(*(report(10 + n, talk, vehicle="talker") for n in range(1000)))
    run(store, worker)
    assert features_of(store) == before


def test_what_can_no_longer_be_read_is_left_out_and_told(store, worker, keep):
    keep(*(report(n, change(found(1.0, 1.0), base=MAP)) for n in (1, 2)))
    store.put_reports([ReportRow(report_id(3), "signs", TILE, "car-3", 0, b"nonsense")])
    assert run(store, worker) == ["published"]
    (kept,) = store.quarantined()
    assert report_id(3) in kept.reason


def test_voxels_of_the_same_tile_are_merged_as_ever(store, worker, keep):
    store.put_tiles([tile_of_states({0: GROUND, 1: WALL})])
    keep(*(report(n, change(found(1.0, 1.0), base=MAP)) for n in (1, 2)))
    base = gaussians_of({0: GROUND, 1: WALL})
    voxels = [report_of(n, change_of(base, [0, 1], {1: None})) for n in (1, 2)]
    rows = [ReportRow(one.report_id, "ndt", tile, one.vehicle, 0, body) for one in voxels for tile, body in split(one)]
    store.put_reports(rows)
    assert sorted(run(store, worker)) == ["published", "published"]
    assert store.get("ndt", TILE).decode_gaussians().gaussians.voxel_id.tolist() == [0]
    assert len(features_of(store)) == 3


def test_a_tile_beyond_the_border_that_publishes_nothing_gets_no_version(store, worker, keep):
    keep(*(report(n, change(found(14.0, 0.0, sigma_m=1.0), base=MAP)) for n in (1, 2)))
    assert sorted(run(store, worker)) == ["published", "unchanged"]
    assert store.get("signs", EAST) is None
