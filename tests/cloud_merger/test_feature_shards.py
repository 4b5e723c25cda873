"""Feature reports through two real shard processes and a real router: one is killed, nothing is lost, nothing twice."""

import itertools
import signal

import pytest
from feature_cloud import ABSENT, EXIST, change, feature, found, report, seen
from merger_processes import DEADLINE_S, Cloud, in_threads, wait_for

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.features import FeatureMergeParameters
from gnd.cloud_merger.features.kept import FeatureInbox
from gnd.cloud_merger.ownership import owner_of
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.work import Worker
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.gnd_map.features import FeatureTile, apply_features, read_feature_delta
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeAck
from gnd.schemas.keys import change_key, update_keys
from gnd.schemas.updates import TileUpdate
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

LAYER = "signs"
SHARDS = ("left", "right")
FIRST = [TileId((497353963154 & ~1023) + k * 1024 + 5) for k in range(8)]  # the same place of eight districts in a row
TILES = [*FIRST, *(TileId(tile.morton + 1) for tile in FIRST)]
MAP = FeatureTile.of(TILES[0], 1, [feature(1, -4.0, 2.0), feature(2, 5.0, 2.0)]).features


class FeatureCloud(Cloud):
    """The same cloud, watched and fed on a feature layer."""

    def open(self):
        super().open()
        self.bus.subscribe(update_keys(LAYER), self.on_signs, history=True)
        self.signs = []

    def on_signs(self, _key, payload):
        self.signs.append(TileUpdate.decode(payload))

    def send(self, whole, bus=None):
        retry = RetryPolicy(longest_wait_s=0.2, attempt_timeout_s=5.0)
        key = change_key(LAYER, whole.district)
        reply = (bus or self.bus).request(key, whole.encode(), kind="change", retry=retry, timeout_s=DEADLINE_S)
        return ChangeAck.decode(reply)

    def versions(self):
        tiles = [head.tile for head in self.store.heads(LAYER)]
        return {(tile, v.version) for tile in tiles for v in self.store.history(LAYER, tile) if v.version > 1}

    def announced(self):
        return {(update.tile, update.version) for update in list(self.signs)}


@pytest.fixture
def cloud(tmp_path, free_port):
    cloud = FeatureCloud(tmp_path, free_port)
    cloud.open()
    cloud.store.put_tiles([FeatureTile.of(tile, 1, MAP) for tile in TILES], layer=LAYER)
    yield cloud
    cloud.close()


def report_number(n):
    """Over one or two tiles of a district; a sign new, one gone, opinions about the other; five vehicles a district."""
    first = FIRST[n % len(FIRST)]
    tiles = [first, TileId(first.morton + 1)][: 1 + n % 2]
    said = [seen(1, (ABSENT, ABSENT, EXIST)[n % 3]), seen(2, EXIST, (5.0 + 0.02 * (n % 7), 2.0))]
    said.append(found(0.1 * (n % 5), -6.0, sigma_m=0.4))
    changes = [change(*said, base=MAP, tile=tile) for tile in tiles]
    return report(n, *changes, vehicle=f"car-{n // 8 % 5}")


def fault_free(path, reports, received_ns):
    """Head hashes when one worker merges the reports one by one, in order of receipt."""
    with SqliteStore(path, StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([FeatureTile.of(tile, 1, MAP) for tile in TILES], layer=LAYER)
        inbox = FeatureInbox(store, FeatureMergeParameters(), (), reach_tiles=3)
        worker = Worker(store, ShardConfig(store_path=path))
        for one in sorted(reports, key=lambda one: received_ns[one.report_id]):
            store.put_reports(inbox.rows(one, received_ns[one.report_id]))
            while claims := store.claim("one", 16, 30.0):
                store.publish(worker.merge(claims))
        return {head.tile: head.sha for head in store.heads(LAYER)}, store.counts().report_rows


def test_the_test_gives_both_shards_districts():
    assert {owner_of(tile.district, SHARDS) for tile in TILES} == set(SHARDS)


@pytest.mark.slow
def test_a_shard_killed_while_feature_reports_flow_loses_nothing_and_applies_nothing_twice(cloud, tmp_path):
    cloud.start(*SHARDS)
    reports = [report_number(n) for n in range(64)]
    sent = itertools.count()
    acks = []

    def agent(k):
        for one in reports[k::3]:
            if next(sent) == len(reports) // 3:
                cloud.signal("left", signal.SIGKILL)
            acks.append(cloud.send(one))

    in_threads(3, agent)
    assert {ack.report_id for ack in acks} == {one.report_id for one in reports}
    assert {ack.status for ack in acks} <= {"stored", "duplicate"}
    assert cloud.shards["left"].wait(5) == -signal.SIGKILL
    wait_for("all is merged and announced", cloud.is_settled)
    received_ns = {row.report_id: row.received_ns for row in cloud.store.reports(LAYER)}
    heads, n_rows = fault_free(tmp_path / "plain.sqlite", reports, received_ns)
    assert {head.tile: head.sha for head in cloud.store.heads(LAYER)} == heads
    assert (cloud.store.counts().reports, cloud.store.counts().report_rows) == (len(reports), n_rows)
    assert cloud.store.quarantined() == []
    verifier = Verifier(cloud.store, ShardConfig())
    assert {one.status for tile in TILES for one in verifier.history(LAYER, tile)} == {"given", "same"}
    wait_for("the watcher has heard of all", lambda: cloud.versions() <= cloud.announced())
    assert cloud.updates == []  # who watches Gaussians hears nothing of signs
    assert "Traceback" not in cloud.log("right")
    check_deltas(cloud)
    cloud.start("left")  # and when it comes back, reports are duplicates for it too
    assert {cloud.send(one).status for one in reports[:16]} == {"duplicate"}


def check_deltas(cloud):
    """Every announced delta leads from one version to the next."""
    by_version = {(update.tile, update.version): update for update in list(cloud.signs)}
    assert by_version
    for (tile, version), update in by_version.items():
        before = cloud.store.get(LAYER, tile, update.previous_version).decode_features()
        after = cloud.store.get(LAYER, tile, version).decode_features()
        assert update.sha == after.sha
        assert apply_features(before.features, read_feature_delta(update.coded_delta)) == after.features
