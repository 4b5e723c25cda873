"""Update notices survive the shard that published the version; late watchers get the last one."""

import threading
from dataclasses import replace

import pytest
from merger_processes import Cloud, wait_for
from merger_world import (
    BALL,
    GROUND,
    NEIGHBOUR,
    POLE,
    TILE,
    VOXEL_BY_VOXEL,
    WALL,
    change_of,
    gaussians_of,
    report_of,
    tile_of_states,
)

from gnd.cloud_merger.announce import NOTICE_DELTA_BYTES, NOTICE_DELTA_VOXELS, encoded, update_of
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.merger import run_shard
from gnd.cloud_merger.ownership import owner_of
from gnd.cloud_merger.work import Worker
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.gnd_map.codec import LATTICES, snap
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile import Tile, TileDelta
from gnd.schemas.changes import split
from gnd.schemas.keys import alive_key, update_key
from gnd.schemas.limits import MAX_TILE_BODY_BYTES
from gnd.schemas.updates import TileUpdate, updated
from gnd.tile_store.errors import StoreUnavailable
from gnd.tile_store.values import ReportRow, StoreConfig

STATES = {0: GROUND, 1: WALL}
BASE = gaussians_of(STATES)


def on_standard(states):
    """A tile on the lattice of most maps."""
    return Tile(TILE, 1, snap(gaussians_of(states), LATTICES["standard"]))


@pytest.fixture
def cloud(tmp_path, free_port):
    cloud = Cloud(tmp_path, free_port)
    cloud.open()
    cloud.store.put_tiles([tile_of_states(STATES)])
    yield cloud
    cloud.close()


@pytest.fixture
def shard(cloud):
    """A shard in a thread of this process."""
    stop = threading.Event()
    config = ShardConfig(
        store_path=cloud.path,
        connect=(cloud.endpoint,),
        poll_s=0.02,
        store=StoreConfig(merge_delay_s=0.0),
        confirmation=VOXEL_BY_VOXEL,
    )
    thread = threading.Thread(target=run_shard, args=(config, stop))

    def start():
        thread.start()
        wait_for("the shard lives", lambda: "merger-1" in cloud.living)

    yield start
    stop.set()
    if thread.ident is not None:
        thread.join(10)
        assert not thread.is_alive()
        wait_for("its sign of life is gone", lambda: "merger-1" not in cloud.living)


def publish_without_notice(cloud, number, changed):
    """What a shard leaves that is killed between commit and notice."""
    report = report_of(number, change_of(BASE, [0, 1, 2], changed))
    cloud.store.put_reports([ReportRow(report.report_id, "ndt", tile, "car", 0, body) for tile, body in split(report)])
    wait_for("the tile is ready", lambda: (claims := cloud.store.claim("dead", 1, 30.0)) and publish(cloud, claims))


def publish(cloud, claims):
    config = ShardConfig(store_path=cloud.path, confirmation=VOXEL_BY_VOXEL)
    (result,) = cloud.store.publish(Worker(cloud.store, config).merge(claims))
    assert result.status == "published"
    return True


def test_a_notice_that_a_dead_shard_owed_is_sent_by_the_next(cloud, shard):
    publish_without_notice(cloud, 1, {2: POLE})
    publish_without_notice(cloud, 2, {1: None, 2: POLE})
    shard()
    wait_for("both are announced", lambda: len(cloud.updates) == 2)
    first, second = cloud.updates
    assert [(u.version, u.previous_version, u.reason) for u in (first, second)] == [(2, 1, "merged"), (3, 2, "merged")]
    assert first.previous_sha == tile_of_states(STATES).sha
    assert updated(second, updated(first, tile_of_states(STATES))) == cloud.store.get("ndt", TILE).decode()
    assert [update.voxels for update in (first, second)] == [(1, 0), (0, 1)]  # the pole is like what it was
    wait_for("none is owed", cloud.is_settled)


def test_a_notice_of_an_owner_that_lives_but_does_not_announce_is_sent_by_another(cloud, shard):
    """Its worker is being started, is stopped, or has no room on its disk."""
    names = (f"ghost-{n}" for n in range(99))
    owner = next(name for name in names if owner_of(TILE.district, {"merger-1", name}) == name)
    cloud.bus.declare_alive(alive_key("merger", owner))
    publish_without_notice(cloud, 1, {2: POLE})
    shard()
    wait_for("it is announced", lambda: [update.version for update in cloud.updates] == [2])
    wait_for("none is owed", cloud.is_settled)


def test_the_leases_of_a_shard_that_has_gone_are_freed_at_once(cloud, shard):
    cloud.store.join("ghost")
    ghost = cloud.bus.declare_alive(alive_key("merger", "ghost"))
    report = report_of(1, change_of(BASE, [0, 1, 2], {2: POLE}))
    cloud.store.put_reports([ReportRow(report.report_id, "ndt", TILE, "car", 0, report.encode())])
    wait_for("the ghost has the tile", lambda: cloud.store.claim("ghost", 1, 3600.0))
    shard()
    assert not cloud.updates
    ghost.close()
    wait_for("the shard has merged it", lambda: cloud.updates)


def test_a_rollback_is_announced(cloud, shard):
    shard()
    cloud.send(report_of(1, change_of(BASE, [0, 1, 2], {2: POLE})))
    wait_for("version 2", lambda: len(cloud.updates) == 1)
    cloud.store.rollback("ndt", TILE, 1)
    wait_for("version 3", lambda: len(cloud.updates) == 2)
    update = cloud.updates[1]
    assert (update.version, update.reason, update.sha) == (3, "rollback", tile_of_states(STATES).sha)
    assert update.voxels == (0, 1)
    assert updated(update, cloud.store.get("ndt", TILE, 2).decode()).gaussians == BASE


def test_a_late_watcher_gets_the_last_notice(cloud, shard):
    shard()
    cloud.send(report_of(1, change_of(BASE, [0, 1, 2], {2: POLE})))
    wait_for("version 2", lambda: len(cloud.updates) == 1)
    heard = []
    with open_bus(BusConfig(connect=(cloud.endpoint,))) as late:
        late.subscribe(update_key("ndt", TILE), lambda _key, payload: heard.append(payload), history=True)
        wait_for("the late watcher has heard", lambda: heard)
    assert TileUpdate.decode(heard[0]) == cloud.updates[0]


def stored_versions(cloud):
    return cloud.store.get("ndt", TILE, 1), cloud.store.get("ndt", TILE, 2)


def test_a_version_on_a_lattice_is_announced_by_a_coded_delta_and_one_of_floats_in_columns(cloud):
    neighbour = replace(on_standard(STATES), tile_id=NEIGHBOUR)
    cloud.store.put_tiles([neighbour])
    after = replace(neighbour, gaussians=on_standard({1: BALL}).gaussians)
    cloud.store.put_tiles([after, tile_of_states({1: WALL})])
    coded, plain = (
        update_of(cloud.store.get("ndt", tile, 2), cloud.store.get("ndt", tile, 1)) for tile in (NEIGHBOUR, TILE)
    )
    assert (coded.delta, coded.voxels, plain.coded_delta, plain.voxels) == (None, (1, 1), b"", (0, 1))
    assert updated(TileUpdate.decode(coded.encode()), neighbour).gaussians == after.gaussians
    assert updated(TileUpdate.decode(plain.encode()), tile_of_states(STATES)).gaussians == gaussians_of({1: WALL})


def test_a_damaged_body_is_announced_without_a_delta(cloud):
    publish_without_notice(cloud, 1, {2: POLE})
    one, two = stored_versions(cloud)
    damaged = type(one)(**{**{name: getattr(one, name) for name in one.__slots__}, "body": one.body[:-1]})
    update = update_of(two, damaged)
    assert (update.has_delta, update.sha, update.previous_sha) == (False, two.sha, one.sha)
    assert update_of(two, one).has_delta
    assert update_of(two, None).previous_version == 0


def test_a_large_delta_is_left_out_and_counted(cloud):
    """A notice goes to everybody: who holds the tile asks for what has changed."""
    publish_without_notice(cloud, 1, {2: POLE})
    one, two = stored_versions(cloud)
    pole = gaussians_of({2: POLE})

    def notice(n):
        voxel_id = gaussians_of(dict.fromkeys(range(n))).voxel_id
        put = Gaussians(voxel_id, *(column.repeat(n, axis=0) for column in pole.columns[1:]))
        return TileUpdate(TILE, "ndt", 2, 1, two.sha, one.sha, "merged", TileDelta(gaussians_of({}).voxel_id, put))

    small, large, fullest = (encoded(notice(n)) for n in (5, 20, 90_000))
    assert TileUpdate.decode(small) == notice(5)
    assert [TileUpdate.decode(one).has_delta for one in (large, fullest)] == [False, False]
    assert [TileUpdate.decode(one).voxels for one in (large, fullest)] == [(20, 0), (90_000, 0)]
    assert max(map(len, (large, fullest))) < 120
    assert len(small) < 120 + NOTICE_DELTA_BYTES
    coded = replace(notice(5), delta=None, coded_delta=bytes(MAX_TILE_BODY_BYTES), put_voxels=5)
    assert not TileUpdate.decode(encoded(coded)).has_delta


def test_a_change_of_many_voxels_is_not_even_encoded(cloud, monkeypatch):
    many = on_standard(dict.fromkeys(range(NOTICE_DELTA_VOXELS + 10), WALL))
    cloud.store.put_tiles([replace(many, tile_id=NEIGHBOUR)])
    cloud.store.put_tiles([replace(on_standard({0: WALL}), tile_id=NEIGHBOUR)])
    monkeypatch.setattr("gnd.cloud_merger.announce.encode_content_delta", lambda *_: pytest.fail("it was encoded"))
    update = update_of(cloud.store.get("ndt", NEIGHBOUR, 2), cloud.store.get("ndt", NEIGHBOUR, 1))
    assert (update.has_delta, update.voxels) == (False, (0, NOTICE_DELTA_VOXELS + 9))


def test_a_shard_without_a_store_says_so(tmp_path):
    with pytest.raises(StoreUnavailable, match=r"nowhere\.sqlite"):
        run_shard(ShardConfig(store_path=tmp_path / "nowhere.sqlite"), threading.Event())
