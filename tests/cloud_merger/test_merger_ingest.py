import contextlib
import dataclasses
import threading

import numpy as np
import pytest
from merger_world import GROUND, NEIGHBOUR, POLE, TILE, WALL, change_of, gaussians_of, report_of, tile_of_states
from upload_desk import NOW, Desk

from gnd.cloud_merger import expander, served
from gnd.cloud_merger.checking import IngestLimits
from gnd.cloud_merger.errors import MergerError
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeReport
from gnd.schemas.keys import change_key
from gnd.schemas.packed import decode_upload
from gnd.tile_store.errors import StoreClosed
from gnd.tile_store.sqlite_store import SqliteStore

BASE = gaussians_of({0: GROUND, 1: WALL})
KEY = change_key("ndt", TILE.district)
FAR = TileId(TILE.morton + (1 << 20))  # some 39 km away


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([tile_of_states({0: GROUND, 1: WALL}, tile) for tile in (TILE, NEIGHBOUR)])
        yield store


@pytest.fixture
def desk(store):
    return Desk(store)


def good(number=1, tile=TILE, **values):
    return report_of(number, dataclasses.replace(change_of(BASE, [0, 1, 2], {2: POLE}, tile=tile), **values))


def with_gaussian(**columns):
    pole = gaussians_of({2: POLE})
    values = [columns.get(name, getattr(pole, name)) for name in ("voxel_id", "count", "cells", "mean_m", "cov_m2")]
    return good(changed=Gaussians(*values))


def test_bytes_are_kept_before_they_are_acknowledged_and_nothing_of_them_is_read(store, desk):
    report = report_of(1, *(change_of(BASE, [0, 1, 2], {2: POLE}, tile=tile) for tile in sorted((TILE, NEIGHBOUR))))
    ack = desk.ack(KEY, report.encode())
    assert (ack.report_id, ack.status, ack.reason) == (report.report_id, "stored", "")
    assert (store.upload_counts().by_state, store.upload_counts().oldest_waiting_ns) == ({"waiting": 1}, NOW)
    assert (store.counts().report_rows, store.dirty_count()) == (0, 0)
    assert desk.state(report.vehicle, report.report_id).status == "waiting"


def test_a_report_comes_into_the_journal_tile_by_tile_and_is_released(store, desk):
    report = report_of(1, *(change_of(BASE, [0, 1, 2], {2: POLE}, tile=tile) for tile in sorted((TILE, NEIGHBOUR))))
    assert desk.send(KEY, report.encode()).status == "released"
    assert desk.told == [(report.vehicle, desk.state(report.vehicle, report.report_id))]
    rows = list(store.reports())
    assert [row.tile for row in rows] == sorted((TILE, NEIGHBOUR))
    assert {row.received_ns for row in rows} == {NOW}
    parts = [ChangeReport.decode(row.body).tiles for row in rows]
    assert [part for (part,) in parts] == list(report.tiles)
    assert [row.base_sha for row in rows] == [change.base_sha for change in report.tiles]
    assert store.dirty_count() == 2


def test_the_same_report_again_is_a_duplicate_and_wakes_nobody(store):
    stored, journaled = [], []
    desk = Desk(store, on_stored=lambda: stored.append(1), on_journaled=lambda: journaled.append(1))
    assert desk.ack(KEY, good().encode()).status == "stored"
    assert desk.ack(KEY, good().encode()).status == "duplicate"
    desk.work()
    assert desk.ack(KEY, good().encode()).status == "duplicate"
    desk.work()
    assert store.counts().report_rows == 1
    assert (len(stored), len(journaled)) == (1, 1)


@pytest.mark.parametrize(
    ("report", "reason"),
    [
        (report_of(1, change_of(None, [0], {0: POLE}, tile=FAR)), "is not on the map of layer ndt"),
        (report_of(1, change_of(BASE, [0], {}, tile=FAR)), "is not on the map of layer ndt"),
        (with_gaussian(mean_m=np.array([[0.1, -0.9, 0.0]], np.float32)), "mean of 0.9 m from the voxel's centre"),
        (with_gaussian(cov_m2=np.array([[0.01, 0, 0, 0.6, 0, 0.01]], np.float32)), "variance of 0.6 m²"),
        (with_gaussian(cells=np.array([1001], np.int32), count=np.array([5000], np.int32)), "1001 occupied sub-cells"),
        (with_gaussian(cells=np.array([30], np.int32), count=np.array([21], np.int32)), "9 sub-cells more than points"),
        (good(pose_sigma_m=0.8), "pose known to 0.8 m"),
        (good(pose_sigma_rad=0.2), "0.2 rad"),
    ],
)
def test_an_absurd_report_is_quarantined_with_its_reason_and_nothing_else_is_touched(store, desk, report, reason):
    payload = report.encode()
    key = change_key("ndt", report.district)
    told = desk.send(key, payload)
    assert (told.report_id, told.status) == (report.report_id, "quarantined")
    assert reason in told.reason
    assert desk.state(report.vehicle, report.report_id) == told
    (kept,) = store.quarantined()
    assert (kept.body, kept.reason, kept.source) == (payload, told.reason, key)
    assert (store.counts().report_rows, store.dirty_count()) == (0, 0)


def test_the_other_tiles_of_an_absurd_report_wait_in_quarantine_with_it(store, desk):
    bad = dataclasses.replace(change_of(BASE, [0], {}, tile=NEIGHBOUR), pose_sigma_m=0.8)
    report = report_of(1, *sorted((change_of(BASE, [0, 1, 2], {2: POLE}), bad), key=lambda change: change.tile))
    assert desk.send(KEY, report.encode()).status == "quarantined"
    assert store.counts().report_rows == 0


@pytest.mark.parametrize("payload", [b"", b"\xff" * 100, good().encode()[:-7], b"\0" * (9 << 20)])
def test_bytes_that_are_no_report_are_quarantined_instead_of_acknowledged(store, desk, payload):
    ack = desk.ack(KEY, payload)
    assert (ack.report_id, ack.status) == ("", "quarantined")
    assert store.quarantined()[0].body == payload
    assert store.upload_counts().by_state == {}


@pytest.mark.parametrize(
    "key",
    [change_key("ndt", FAR.district), change_key("signs", TILE.district), "gnd/v1/change/ndt/9", "gnd/v2/change/x"],
)
def test_a_report_on_the_wrong_key_is_quarantined_instead_of_acknowledged(store, desk, key):
    assert desk.ack(key, good().encode()).status == "quarantined"
    assert store.upload_counts().by_state == {}


def test_a_report_from_the_future_is_refused_with_numbers_and_an_old_one_is_welcome(store):
    last_ns = good().last_ns
    ack = Desk(store, now_ns=last_ns - 301_000_000_000).ack(KEY, good().encode())
    assert ack.status == "quarantined"
    assert "ends 301 s after it was received, the limit is 300 s" in ack.reason
    assert Desk(store, now_ns=last_ns - 299_000_000_000).send(KEY, good().encode()).status == "released"
    years = 20 * 365 * 86_400 * 1_000_000_000
    assert Desk(store, now_ns=last_ns + years).send(KEY, good(2).encode()).status == "released"


def test_a_tile_without_a_map_is_accepted_next_to_the_map_only(store):
    report = report_of(1, change_of(None, [0], {0: POLE}, tile=TileId(TILE.morton - 2)))  # one tile to the south
    other = dataclasses.replace(report, report_id=good(2).report_id)
    assert Desk(store, ingest=IngestLimits(reach_tiles=0)).send(KEY, report.encode()).status == "quarantined"
    assert Desk(store, ingest=IngestLimits(reach_tiles=1)).send(KEY, other.encode()).status == "released"


def test_a_report_against_a_version_that_is_no_longer_the_newest_is_welcome(store, desk):
    store.put_tiles([tile_of_states({5: POLE})])
    assert desk.send(KEY, good().encode()).status == "released"


def test_a_whole_report_against_a_version_that_is_gone_is_welcome_too(store, desk):
    report = good(base_sha=b"\x01" * 32)
    assert desk.send(KEY, report.encode()).status == "released"
    (row,) = store.reports()
    assert row.base_sha == b"\x01" * 32


def test_a_report_id_of_another_vehicle_hides_nothing(store, desk):
    forged = dataclasses.replace(good(), vehicle="mallory")
    honest = good(pose_sigma_m=0.01)
    assert forged.report_id == honest.report_id
    assert desk.send(KEY, forged.encode()).status == "released"
    assert desk.ack(KEY, honest.encode()).status == "stored"
    desk.work()
    assert desk.told[-1] == (honest.vehicle, desk.state(honest.vehicle, honest.report_id))
    first, second = store.reports()
    assert (first.vehicle, first.report_id) == ("mallory", forged.report_id)
    assert second.vehicle == honest.vehicle
    assert second.report_id != honest.report_id, "the id is taken"
    assert second.report_id[:10] == honest.report_id[:10], "the time in it stays"
    kept = ChangeReport.decode(second.body)
    assert (kept.report_id, kept.tiles) == (second.report_id, honest.tiles)


def test_one_poisonous_upload_never_stops_the_others(store, desk, monkeypatch):
    poison, whole = good(1), [good(n) for n in (2, 3, 4)]

    def decode(body):
        if body == poison.encode():
            raise ZeroDivisionError("somewhere inside")
        return decode_upload(body)

    monkeypatch.setattr(expander, "decode_upload", decode)
    monkeypatch.setattr(expander, "RETRY_S", 0.0)
    for report in (poison, *whole):
        assert desk.ack(KEY, report.encode()).status == "stored"
    desk.work()
    assert {row.report_id for row in store.reports()} == {report.report_id for report in whole}
    state = desk.state(poison.vehicle, poison.report_id)
    assert state.status == "quarantined"
    assert "set aside after 5 attempts to read it: ZeroDivisionError: somewhere inside" in state.reason
    assert store.quarantined()[0].body == poison.encode()


def test_an_upload_that_kills_its_workers_is_set_aside_and_drags_nobody_along(store, monkeypatch):
    """Each life of the shard claims, dies at the poison, and is started again."""
    poison, others = good(1), [good(n) for n in (2, 3, 4)]

    class Killed(BaseException):
        pass

    def decode(body):
        if body == poison.encode():
            raise Killed
        return decode_upload(body)

    monkeypatch.setattr(expander, "decode_upload", decode)
    for report in (poison, *others):
        Desk(store).ack(KEY, report.encode())
    for _ in range(3):  # the first life takes all with it; in the next, each comes alone and who died least comes first
        store.release("desk")
        with contextlib.suppress(Killed):
            Desk(store).work()
    assert {row.report_id for row in store.reports()} == {report.report_id for report in others}
    for _ in range(4):
        store.release("desk")
        with contextlib.suppress(Killed):
            Desk(store).work()
    assert {row.report_id for row in store.reports()} == {report.report_id for report in others}
    state = Desk(store).state(poison.vehicle, poison.report_id)
    assert (state.status, "no worker that claimed it came to an end" in state.reason) == ("quarantined", True)


def test_a_store_that_fails_gives_no_ack(store, desk):
    store.close()
    with pytest.raises(StoreClosed):
        desk.ack(KEY, good().encode())


def test_many_threads_may_report_and_look_at_once(store, desk):
    acks = []

    def vehicle(k):
        acks.extend(desk.ack(KEY, good(n).encode()).status for n in range(20 * k, 20 * k + 30))
        desk.work()

    threads = [threading.Thread(target=vehicle, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (acks.count("stored"), acks.count("duplicate")) == (90, 30)  # neighbours share 10 reports
    assert store.counts().reports == 90


def test_absurd_limits_are_refused():
    with pytest.raises(MergerError, match="reach_tiles"):
        IngestLimits(reach_tiles=-1)


def test_who_used_too_much_cpu_waits_in_the_store_while_others_are_looked_at(store, monkeypatch):
    """What was acknowledged is kept, and looked at when the share of its vehicle has filled again."""
    monkeypatch.setattr(served, "CPU_S_AT_ONCE", 1e-6)
    now_s = [1000.0]
    desk = Desk(store)
    desk.expander.served = served.ServedCpu(lambda: now_s[0])
    dear = [dataclasses.replace(good(number), vehicle="dear") for number in range(20)]
    for report in dear:
        assert desk.ack(KEY, report.encode()).status == "stored"
    desk.work()
    waiting = store.uploads_waiting("dear", 100)
    assert waiting >= 12, "no more than was claimed at once"
    assert desk.expander.served.held_back == 1
    assert desk.send(KEY, dataclasses.replace(good(99), vehicle="cheap").encode()).status == "released"
    assert store.uploads_waiting("dear", 100) == waiting
    while store.uploads_waiting("dear", 100):
        now_s[0] += 60.0
        desk.work()
    assert {desk.state("dear", report.report_id).status for report in dear} == {"released"}
