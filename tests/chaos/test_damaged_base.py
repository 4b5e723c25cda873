"""A damaged page under the base of an upload: the upload waits as long as it takes, and others do not wait with it."""

from pathlib import Path

import pytest

from gnd.cloud_merger import expander as module
from gnd.cloud_merger.config import MAX_ATTEMPTS, ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.cloud_merger.ingest import Ingest
from gnd.deploy.chaos.page import PAGE_BYTES
from gnd.deploy.chaos.street import ChaosStreet, SentReport, read_street
from gnd.tile_store.errors import StoreDamaged
from gnd.tile_store.sqlite_store import SqliteStore

HEADER_BYTES = 8


def flip(path: Path, at: int) -> None:
    """The first bytes of a page, inverted; twice is as before."""
    raw = bytearray(path.read_bytes())
    raw[at : at + HEADER_BYTES] = bytes(byte ^ 0xFF for byte in raw[at : at + HEADER_BYTES])
    path.write_bytes(raw)


def reports_in_two_districts(street: ChaosStreet) -> tuple[SentReport, SentReport]:
    said = [street.said(1, "car", n) for n in range(40)]
    return next(one for one in said if one.whole.district == street.copies[0][0].tile_id.district), next(
        one for one in said if one.whole.district != street.copies[0][0].tile_id.district
    )


def test_an_upload_waits_for_a_page_to_be_mended_and_others_are_looked_at(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(module, "DAMAGED_RETRY_S", 0.0)
    path, street = tmp_path / "store.sqlite", read_street()
    near, far = reports_in_two_districts(street)
    with SqliteStore(path) as store:
        store.put_tiles(street.copies[0])
    size = path.stat().st_size
    with SqliteStore(path) as store:
        store.put_tiles(street.copies[1])
        base = store.get("ndt", near.bases[0].tile_id)
    assert base is not None
    at = path.read_bytes().index(base.body[:64]) // PAGE_BYTES * PAGE_BYTES
    assert at < size, "a page of the first district"
    flip(path, at)
    with SqliteStore(path) as store:
        with pytest.raises(StoreDamaged):
            store.get("ndt", near.bases[0].tile_id)
        config = ShardConfig()
        ingest, expander = Ingest(store, config.shard_id), Expander(store, config, lambda *_: None)
        assert [ingest.answer(one.key, one.packed.encode()).status for one in (near, far)] == ["stored"] * 2
        for _ in range(3 * MAX_ATTEMPTS):
            expander.work()
        status = {
            one.report_id: one.state
            for one in store.upload_statuses("car", [near.whole.report_id, far.whole.report_id])
        }
        assert status[near.whole.report_id] == "waiting"
        assert status[far.whole.report_id] in ("wanted", "released")
    flip(path, at)
    with SqliteStore(path) as store:
        expander = Expander(store, config, lambda *_: None)
        while expander.work():
            pass
        (status_now,) = store.upload_statuses("car", [near.whole.report_id])
        assert status_now.state in ("wanted", "released")
        assert {row.report_id for row in store.reports()} == {near.whole.report_id, far.whole.report_id}
