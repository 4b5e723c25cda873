"""Staged release without a bus: what goes on trial, what vehicles tell, what is decided, doubted and cleared."""

import json
from dataclasses import replace

import pytest
from merger_world import POLE, TILE, WALL_AGAIN, gaussians_of, tile_of_states
from release_world import (
    BASE,
    START_NS,
    STATES,
    Listener,
    cars_of,
    merge_all,
    on_trial,
    payload,
    reported,
    visit,
    worker_of,
)

from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.errors import MergerError
from gnd.cloud_merger.ownership import Members
from gnd.cloud_merger.release.collector import HealthCollector
from gnd.cloud_merger.release.doubts import clear_and_reenter
from gnd.cloud_merger.release.keeper import ReleaseKeeper, looks_taken
from gnd.cloud_merger.release.parameters import ReleaseParameters
from gnd.cloud_merger.verify import Verifier
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.errors import BadValue, SchemaError
from gnd.schemas.health import HealthReport, TileHealth
from gnd.schemas.keys import health_key
from gnd.tile_store import releasing
from gnd.tile_store import sql_trials as trials
from gnd.tile_store.released import released
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

WITH_POLE = gaussians_of({**STATES, 2: POLE})
WELL, BADLY = [800] * 8, [400] * 6


@pytest.fixture
def clock():
    return [START_NS]


@pytest.fixture
def store(tmp_path, clock):
    with SqliteStore(tmp_path / "map.sqlite", StoreConfig(merge_delay_s=0.0), now_ns=lambda: clock[0]) as store:
        store.put_tiles([tile_of_states(STATES)])
        yield store


@pytest.fixture
def worker(store):
    return worker_of(store)


@pytest.fixture
def keeper(store, clock):
    return ReleaseKeeper(store, Members("one"), lambda: clock[0])


@pytest.fixture
def trial(store, worker):
    reported(store, 1, "reporter-1")
    reported(store, 2, "reporter-2")
    merge_all(store, worker)
    return on_trial(store)


def others_fare_well(store, trial, listener=None):
    return (listener or Listener(store)).hear_all(trial, "old", [790 + k for k in range(30)])


def statuses(store):
    verifier = Verifier(store, ShardConfig(store_path=store.path))
    return [one.status for one in verifier.history("ndt", TILE)]


def test_releases_are_staged_only_where_that_is_asked_for(store):
    reported(store, 1)
    merge_all(store, worker_of(store, ReleaseParameters()))
    assert store.trials("ndt") == {}
    assert [one.version for one in store.notices()] == [2]
    with pytest.raises(MergerError, match="share"):
        ReleaseParameters(share=0.8)


def test_a_good_version_is_released_to_all(store, trial, keeper):
    keeper.work()
    assert released(store, "ndt", TILE).version == 1
    others_fare_well(store, trial)
    Listener(store).hear_all(trial, "new", WELL)
    keeper.work()
    assert released(store, "ndt", TILE).version == 2
    assert released(store, "ndt", TILE).decode().gaussians == WITH_POLE
    assert [one.version for one in store.notices()] == [2]
    assert statuses(store) == ["given", "same"]


def test_a_bad_version_is_withdrawn_and_everybody_gets_the_old_content(store, trial, keeper):
    others_fare_well(store, trial)
    Listener(store).hear_all(trial, "new", BADLY)
    keeper.work()
    head = released(store, "ndt", TILE)
    assert (head.version, head.kind, head.decode().gaussians) == (3, "rollback", BASE)
    assert store.doubted_vehicles("ndt", TILE) == {"reporter-1", "reporter-2"}
    (known,) = store.look(lambda c: trials.of_tile(c, "ndt", TILE))
    assert (known.state, json.loads(known.verdict)["new"]["told"]) == ("withdrawn", 6)
    assert statuses(store) == ["given", "same", "given"]


def test_doubted_vehicles_alone_change_the_tile_no_more_and_others_do(store, trial, keeper, worker):
    releasing.withdraw(store, trial, "test", "worse")
    reported(store, 3, "reporter-1", base=BASE, version=3)
    reported(store, 4, "reporter-2", base=BASE, version=3)
    merge_all(store, worker)
    assert store.get("ndt", TILE).version == 3
    reported(store, 5, "stranger", base=BASE, version=3)
    merge_all(store, worker)
    assert on_trial(store).version == 4
    assert store.get("ndt", TILE).decode().gaussians == WITH_POLE
    assert statuses(store) == ["given", "same", "given", "same"]


def test_a_later_version_that_passes_its_trial_clears_the_doubts(store, trial, keeper, worker):
    releasing.withdraw(store, trial, "test", "by mistake")
    for number, car in enumerate(("reporter-1", "stranger"), 3):
        reported(store, number, car, base=BASE, version=3)
    merge_all(store, worker)
    again = on_trial(store)
    others_fare_well(store, again)
    Listener(store).hear_all(again, "new", WELL)
    keeper.work()
    assert released(store, "ndt", TILE).version == 4
    assert store.doubted_vehicles("ndt", TILE) == frozenset()
    assert store.look(lambda c: trials.steered(c, "ndt", TILE))[-1].why.startswith("version 4 passed")


def test_a_later_version_that_says_something_else_clears_nothing(store, trial, keeper, worker):
    releasing.withdraw(store, trial, "test", "worse")
    reported(store, 3, "stranger", changed={1: None}, base=BASE, version=3)
    merge_all(store, worker)
    again = on_trial(store)
    others_fare_well(store, again)
    Listener(store).hear_all(again, "new", WELL)
    keeper.work()
    assert released(store, "ndt", TILE).version == 4
    assert store.doubted_vehicles("ndt", TILE) == {"reporter-1", "reporter-2"}


def test_an_operator_clears_doubts_and_the_reports_count_again(store, trial, worker, clock):
    releasing.withdraw(store, trial, "test", "by mistake")
    merge_all(store, worker)
    assert store.get("ndt", TILE).version == 3
    assert clear_and_reenter(store, ("ndt", TILE), "operator", "looked at it", lambda: clock[0]) == 2
    merge_all(store, worker)
    assert store.get("ndt", TILE).version == 4
    assert store.get("ndt", TILE).decode().gaussians == WITH_POLE
    assert statuses(store) == ["given", "same", "given", "same"]


def test_reports_that_wait_when_a_version_is_withdrawn_are_not_lost(store, trial, worker):
    reported(store, 9, "stranger", changed={1: WALL_AGAIN, 3: POLE})
    merge_all(store, worker)
    assert store.get("ndt", TILE).version == 2
    releasing.withdraw(store, trial, "test", "worse")
    merge_all(store, worker)
    assert 3 in store.get("ndt", TILE).decode().gaussians.voxel_id


def test_a_paused_trial_is_not_decided_and_goes_on_when_resumed(store, trial, keeper):
    releasing.hold(store, trial, "me", "looking", paused=True)
    others_fare_well(store, trial)
    Listener(store).hear_all(trial, "new", WELL)
    keeper.work()
    assert on_trial(store).state == "paused"
    releasing.hold(store, trial, "me", "looked", paused=False)
    keeper.work()
    assert store.trials("ndt") == {}


def test_a_version_that_nobody_tried_is_released_when_its_time_is_over(store, trial, keeper, clock):
    clock[0] += 23 * 3_600_000_000_000
    keeper.work()
    assert on_trial(store).is_open
    clock[0] += 2 * 3_600_000_000_000
    keeper.work()
    assert released(store, "ndt", TILE).version == 2


def test_the_looks_that_were_taken_outlive_the_shard(store, trial, clock):
    others_fare_well(store, trial)
    Listener(store).hear_all(trial, "new", [400, 410, 395, 800])
    ReleaseKeeper(store, Members("one"), lambda: clock[0]).work()
    looks = looks_taken(on_trial(store))
    assert (looks.worse, looks.silent) == (1, 1)
    ReleaseKeeper(store, Members("one"), lambda: clock[0]).work()
    assert looks_taken(on_trial(store)) == looks


def test_only_the_owner_of_a_district_judges_its_trials(store, trial, clock):
    members = Members("one")
    others_fare_well(store, trial)
    Listener(store).hear_all(trial, "new", WELL)
    rivals = [f"rival-{k}" for k in range(8)]
    for rival in rivals:
        members.note(rival, alive=True)
    assert not members.is_mine(TILE.district)
    ReleaseKeeper(store, members, lambda: clock[0]).work()
    assert on_trial(store).is_open


def test_who_speaks_of_another_version_than_its_own_is_not_heard(store, trial):
    listener = Listener(store)
    (first,), (other,) = cars_of(trial, "new", 1), cars_of(trial, "old", 1)
    listener.hear(first, visit(trial, "old"))
    listener.hear(other, visit(trial, "new"))
    listener.hear(first, replace(visit(trial, "new"), version=77))
    assert listener.collector.counts == {"other": 3}
    assert store.look(lambda c: trials.health(c, trial)) == []


def test_the_old_content_under_an_older_number_counts_as_the_old_version(store, worker, clock):
    store.rollback("ndt", TILE, 1)  # version 2 has the content of version 1
    reported(store, 1, base=BASE, version=2)
    merge_all(store, worker)
    trial = on_trial(store)
    assert (trial.version, trial.base_version) == (3, 2)
    listener = Listener(store)
    (other,) = cars_of(trial, "old", 1)
    listener.hear(other, replace(visit(trial, "old"), version=1))
    assert listener.collector.counts == {"kept": 1}


def test_late_telemetry_and_telemetry_of_unknown_tiles_change_nothing(store, trial):
    listener = Listener(store)
    releasing.release(store, trial, "test", "well")
    for car in cars_of(trial, "new", 3):
        listener.hear(car, visit(trial, "new"))
    assert listener.collector.counts == {"settled": 3}
    listener.hear("car-1", replace(visit(trial, "new"), tile=TileId(TILE.morton + 1)))
    assert listener.collector.counts == {"settled": 4}


def test_telemetry_that_comes_twice_counts_once(store, trial):
    listener = Listener(store)
    (car,) = cars_of(trial, "new", 1)
    for _ in range(3):
        listener.hear(car, visit(trial, "new"))
    assert listener.collector.counts == {"kept": 1, "older": 2}
    assert len(store.look(lambda c: trials.health(c, trial))) == 1


@pytest.mark.parametrize(
    "said",
    [
        {"fit_permille": 1001},
        {"matched_permille": 4_000_000_000},
        {"elsewhere_permille": -1},
        {"gated": 16},
        {"scans": 0},
        {"version": 0},
    ],
)
def test_numbers_that_cannot_be_are_refused(trial, said):
    with pytest.raises(SchemaError):
        replace(visit(trial, "new"), **said)


def test_forged_and_broken_messages_are_refused_and_counted(store, trial):
    from gnd.schemas.generated import health_report_pb2, tile_health_pb2

    listener = Listener(store)
    (car,) = cars_of(trial, "new", 1)
    row = tile_health_pb2.TileHealth(index=TILE.morton & 1023, version=2, scans=9, fit_permille=60_000)
    forged = health_report_pb2.HealthReport(major=1, layer="ndt", district=TILE.morton >> 10, t_ns=1, tiles=[row])
    good = payload(visit(trial, "new"))
    for body in (forged.SerializeToString(), b"", b"\xff" * 40, good[:-3], b"\x08\x02" + good[2:], good * 600):
        listener.collector.take(health_key(car), body)
    assert listener.collector.counts == {"refused": 6}
    listener.collector.take("gnd/v1/health/../x", good)
    assert listener.collector.counts == {"refused": 7}


def test_a_health_report_is_what_its_bytes_say():
    tile = TileHealth(TILE, 3, 20, 900, 812, 850, 10, 1, 1, left=True)
    report = HealthReport("ndt", TILE.district, START_NS, (tile,))
    assert HealthReport.decode(report.encode()) == report
    assert len(report.encode()) < 60
    with pytest.raises(BadValue, match="ascend"):
        HealthReport("ndt", TILE.district, START_NS, (tile, tile))
    with pytest.raises(BadValue, match="another"):
        HealthReport("ndt", TileId(TILE.morton + 1024).district, START_NS, (tile,))


def test_a_vehicle_that_floods_costs_no_writes_and_others_are_heard(store, trial):
    now_s = [0.0]
    collector = HealthCollector(store, lambda: now_s[0])
    first, second = cars_of(trial, "new", 2)
    for k in range(100):
        collector.take(health_key(first), payload(visit(trial, "new"), START_NS + k))
    collector.take(health_key(second), payload(visit(trial, "new")))
    assert collector.counts["flooding"] > 85
    assert {one.vehicle for one in store.look(lambda c: trials.health(c, trial))} == {first, second}
    now_s[0] += 60.0
    collector.take(health_key(first), payload(visit(trial, "new", fit_permille=1), START_NS + 1000))
    assert {one.fit for one in store.look(lambda c: trials.health(c, trial))} == {800, 1}
