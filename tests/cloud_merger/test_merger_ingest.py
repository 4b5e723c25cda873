import dataclasses
import threading

import numpy as np
import pytest
from merger_world import GROUND, NEIGHBOUR, POLE, TILE, WALL, change_of, gaussians_of, report_of, tile_of_states

from cloud_merger.errors import MergerError
from cloud_merger.ingest import Ingest, IngestLimits
from gnd_map.gaussian import Gaussians
from gnd_map.tile_id import TileId
from schemas.changes import ChangeReport
from schemas.keys import change_key
from tile_store.errors import StoreClosed
from tile_store.sqlite_store import SqliteStore

BASE = gaussians_of({0: GROUND, 1: WALL})
KEY = change_key("ndt", TILE.district)
FAR = TileId(TILE.morton + (1 << 20))  # some 39 km away


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([tile_of_states({0: GROUND, 1: WALL}, tile) for tile in (TILE, NEIGHBOUR)])
        yield store


@pytest.fixture
def ingest(store):
    return Ingest(store, IngestLimits(), now_ns=lambda: 77)


def good(number=1, tile=TILE, **values):
    return report_of(number, dataclasses.replace(change_of(BASE, [0, 1, 2], {2: POLE}, tile=tile), **values))


def with_gaussian(**columns):
    pole = gaussians_of({2: POLE})
    values = [columns.get(name, getattr(pole, name)) for name in ("voxel_id", "count", "cells", "mean_m", "cov_m2")]
    return good(changed=Gaussians(*values))


def test_a_report_is_kept_tile_by_tile_before_it_is_acknowledged(store, ingest):
    report = report_of(1, *(change_of(BASE, [0, 1, 2], {2: POLE}, tile=tile) for tile in sorted((TILE, NEIGHBOUR))))
    ack = ingest.answer(KEY, report.encode())
    assert (ack.report_id, ack.status, ack.reason) == (report.report_id, "stored", "")
    rows = list(store.reports())
    assert [row.tile for row in rows] == sorted((TILE, NEIGHBOUR))
    assert {row.received_ns for row in rows} == {77}
    parts = [ChangeReport.decode(row.body).tiles for row in rows]
    assert [part for (part,) in parts] == list(report.tiles)
    assert [row.base_sha for row in rows] == [change.base_sha for change in report.tiles]
    assert store.dirty_count() == 2


def test_the_same_report_again_is_a_duplicate_and_wakes_nobody(store):
    stored = []
    ingest = Ingest(store, IngestLimits(), on_stored=lambda: stored.append(1))
    assert ingest.answer(KEY, good().encode()).status == "stored"
    assert ingest.answer(KEY, good().encode()).status == "duplicate"
    assert store.counts().report_rows == 1
    assert len(stored) == 1


@pytest.mark.parametrize(
    ("report", "reason"),
    [
        (good(base_sha=b"\x01" * 32), "no version of the map has sha 0101010101010101"),
        (report_of(1, change_of(None, [0], {0: POLE}, tile=FAR)), "is not on the map of layer ndt"),
        (report_of(1, change_of(BASE, [0], {}, tile=FAR)), "no version of the map"),
        (with_gaussian(mean_m=np.array([[0.1, -0.9, 0.0]], np.float32)), "mean of 0.9 m from the voxel's centre"),
        (with_gaussian(cov_m2=np.array([[0.01, 0, 0, 0.6, 0, 0.01]], np.float32)), "variance of 0.6 m²"),
        (with_gaussian(cells=np.array([1001], np.int32), count=np.array([5000], np.int32)), "1001 occupied sub-cells"),
        (with_gaussian(cells=np.array([30], np.int32), count=np.array([21], np.int32)), "9 sub-cells more than points"),
        (good(pose_sigma_m=0.8), "pose known to 0.8 m"),
        (good(pose_sigma_rad=0.2), "0.2 rad"),
    ],
)
def test_an_absurd_report_is_quarantined_with_its_reason_and_nothing_else_is_touched(store, ingest, report, reason):
    payload = report.encode()
    key = change_key("ndt", report.district)
    ack = ingest.answer(key, payload)
    assert (ack.report_id, ack.status) == (report.report_id, "quarantined")
    assert reason in ack.reason
    (kept,) = store.quarantined()
    assert (kept.body, kept.reason, kept.source) == (payload, ack.reason, key)
    assert (store.counts().report_rows, store.dirty_count()) == (0, 0)


def test_the_other_tiles_of_an_absurd_report_wait_in_quarantine_with_it(store, ingest):
    bad = dataclasses.replace(change_of(BASE, [0], {}, tile=NEIGHBOUR), base_sha=b"\x02" * 32)
    report = report_of(1, *sorted((change_of(BASE, [0, 1, 2], {2: POLE}), bad), key=lambda change: change.tile))
    assert ingest.answer(KEY, report.encode()).status == "quarantined"
    assert store.counts().report_rows == 0


@pytest.mark.parametrize("payload", [b"", b"\xff" * 100, good().encode()[:-7], b"\0" * (9 << 20)])
def test_bytes_that_are_no_report_are_quarantined(store, ingest, payload):
    ack = ingest.answer(KEY, payload)
    assert (ack.report_id, ack.status) == ("", "quarantined")
    assert store.quarantined()[0].body == payload


@pytest.mark.parametrize(
    "key",
    [change_key("ndt", FAR.district), change_key("signs", TILE.district), "gnd/v1/change/ndt/9", "gnd/v2/change/x"],
)
def test_a_report_on_the_wrong_key_is_quarantined(store, ingest, key):
    assert ingest.answer(key, good().encode()).status == "quarantined"
    assert store.counts().report_rows == 0


def test_a_tile_without_a_map_is_accepted_next_to_the_map_only(store):
    report = report_of(1, change_of(None, [0], {0: POLE}, tile=TileId(TILE.morton - 2)))  # one tile to the south
    assert Ingest(store, IngestLimits(reach_tiles=0)).answer(KEY, report.encode()).status == "quarantined"
    assert Ingest(store, IngestLimits(reach_tiles=1)).answer(KEY, report.encode()).status == "stored"


def test_a_report_against_a_version_that_is_no_longer_the_newest_is_welcome(store, ingest):
    store.put_tiles([tile_of_states({5: POLE})])
    assert ingest.answer(KEY, good().encode()).status == "stored"


def test_a_store_that_fails_gives_no_ack(store, ingest):
    store.close()
    with pytest.raises(StoreClosed):
        ingest.answer(KEY, good().encode())


def test_many_threads_may_report_at_once(store, ingest):
    acks = []

    def vehicle(k):
        acks.extend(ingest.answer(KEY, good(n).encode()).status for n in range(20 * k, 20 * k + 30))

    threads = [threading.Thread(target=vehicle, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (acks.count("stored"), acks.count("duplicate")) == (90, 30)  # neighbours share 10 reports
    assert store.counts().reports == 90


def test_absurd_limits_are_refused():
    with pytest.raises(MergerError, match="max_mean_m"):
        IngestLimits(max_mean_m=0.0)
    with pytest.raises(MergerError, match="reach_tiles"):
        IngestLimits(reach_tiles=-1)
