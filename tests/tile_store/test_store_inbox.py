"""The inbox: what was acknowledged is kept once, whoever sends it how often."""

import threading
from dataclasses import replace

import pytest
from store_helpers import EAST, FAR, TILE, Clock, Maker, merge_once, report, report_id

from gnd.schemas.errors import SchemaError
from gnd.tile_store.errors import StoreError
from gnd.tile_store.store import Store
from gnd.tile_store.values import ReportRow, StoreConfig


def test_a_report_sent_twice_is_kept_once(store: Store) -> None:
    assert store.put_reports([report(1)]) == ["stored"]
    assert store.put_reports([report(1, body=b"other bytes")]) == ["duplicate"]
    assert [row.body for row in store.reports()] == [b"body"]


def test_a_report_sent_twice_in_one_call_is_kept_once(store: Store) -> None:
    assert store.put_reports([report(1), report(1)]) == ["stored", "duplicate"]
    assert store.counts().report_rows == 1


def test_a_duplicate_of_a_merged_report_does_not_make_its_tile_dirty_again(store: Store) -> None:
    store.put_reports([report(1)])
    merge_once(store, 1)
    assert store.put_reports([report(1)]) == ["duplicate"]
    assert store.dirty_count() == 0


def test_the_second_part_of_a_report_comes_after_the_first_and_once(store: Store) -> None:
    flags = report(1, body=b"flags")
    gaussians = replace(flags, body=b"with Gaussians", part=1)
    assert store.put_reports([flags, gaussians, gaussians]) == ["stored", "stored", "duplicate"]
    assert [row.body for row in store.in_play("ndt", TILE).reports] == [b"flags", b"with Gaussians"]
    assert list(store.reports()) == [flags, gaussians]
    assert store.counts().reports == 1


def test_the_second_part_counts_before_the_first_has_come(store: Store) -> None:
    late = report(1, body=b"flags")
    store.put_reports([replace(late, body=b"with Gaussians", part=1)])
    merge_once(store, 1)
    assert store.put_reports([late]) == ["stored"]
    assert [row.part for row in store.in_play("ndt", TILE).reports] == [0, 1]


def test_a_report_has_two_parts_at_most() -> None:
    with pytest.raises(StoreError, match="part 2"):
        replace(report(1), part=2)


def test_one_report_covers_several_tiles_and_layers(store: Store) -> None:
    rows = [report(1), report(1, EAST), report(1, layer="signs")]
    assert store.put_reports(rows) == ["stored", "stored", "stored"]
    assert store.put_reports([*rows, report(1, FAR)]) == ["duplicate", "duplicate", "duplicate", "stored"]
    counts = store.counts()
    assert (counts.reports, counts.report_rows, counts.dirty) == (1, 4, 4)


def test_rows_come_back_as_they_were_put(store: Store) -> None:
    row = ReportRow(report_id(5), "ndt", EAST, "a-vehicle", 123, bytes(range(256)), b"s" * 32)
    store.put_reports([row])
    assert list(store.reports()) == [row]


def test_reports_are_read_by_layer_and_vehicle_across_pages(store: Store) -> None:
    store.put_reports([report(i, vehicle=f"v{i % 2}") for i in range(600)])
    store.put_reports([report(0, layer="signs")])
    assert len(list(store.reports())) == 600
    assert [row.report_id for row in store.reports(vehicle="v1")] == [report_id(i, "v1") for i in range(1, 600, 2)]
    assert len(list(store.reports("signs"))) == 1
    assert list(store.reports("ndt", "nobody")) == []


def test_reports_from_many_threads_are_all_kept_and_each_caller_hears_of_its_own(store: Store) -> None:
    heard: dict[int, list[str]] = {}

    def send(sender: int) -> None:
        mine = [report(i, vehicle=f"v{sender}") for i in range(20)]
        heard[sender] = [status for row in (*mine, mine[0]) for status in store.put_reports([row])]

    threads = [threading.Thread(target=send, args=(sender,)) for sender in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert all(heard[sender] == ["stored"] * 20 + ["duplicate"] for sender in range(16))
    assert store.counts().reports == 16 * 20


def test_what_was_acknowledged_is_there_after_closing_and_opening(maker: Maker) -> None:
    first = maker.open()
    first.put_reports([report(i) for i in range(10)])
    first.close()
    second = maker.open()
    assert [row.report_id for row in second.reports()] == [report_id(i) for i in range(10)]
    assert second.dirty_count() == 1
    second.close()


@pytest.mark.parametrize("bad", ["", "not-a-ulid", "01ARZ3NDEKTSV4RRFFQ69G5FA", "81ARZ3NDEKTSV4RRFFQ69G5FAV", "i" * 26])
def test_a_report_id_must_be_a_ulid(bad: str) -> None:
    with pytest.raises(SchemaError, match="report id"):
        ReportRow(bad, "ndt", TILE, "v", 0, b"")


def test_a_layer_must_be_a_chunk_of_a_key() -> None:
    with pytest.raises(StoreError, match="layer 'a/b'"):
        report(1, layer="a/b")


def test_a_base_hash_has_32_bytes_or_none() -> None:
    with pytest.raises(StoreError, match="31 bytes"):
        ReportRow(report_id(1), "ndt", TILE, "v", 0, b"", b"x" * 31)


def test_quarantine_keeps_bytes_reason_and_count(store: Store, clock: Clock) -> None:
    store.quarantine(b"bad", "WrongHash: tile …", "gnd/v1/change/x")
    clock.advance(1)
    store.quarantine(b"worse", "TooLarge: 9 bytes")
    clock.advance(1)
    store.quarantine(b"bad", "said again", "gnd/v1/change/x")
    worse, bad = store.quarantined()
    assert (bad.body, bad.reason, bad.source, bad.times) == (b"bad", "WrongHash: tile …", "gnd/v1/change/x", 2)
    assert (worse.body, worse.times) == (b"worse", 1)
    assert bad.received_ns == clock.ns
    assert store.counts().quarantined == 2


@pytest.mark.parametrize(
    "bad",
    [
        {"merge_delay_s": -1.0},
        {"window_s": 0.0},
        {"window_reports": 0},
    ],
)
def test_a_configuration_that_cannot_work_is_refused(bad: dict[str, float]) -> None:
    with pytest.raises(StoreError):
        StoreConfig(**bad)  # type: ignore[arg-type]
