"""Reports in short: what a vehicle packs is what the cloud stores; nothing is kept by halves; bad halves are named."""

import dataclasses
import random
import threading

import numpy as np
import pytest
from merger_world import BALL, NEIGHBOUR, POLE, TILE, WALL_AGAIN, report_of
from short_world import KEY, bases_of, drive_number, flagged, packed_of, tile_at, track_by

from cloud_merger import short_reports
from cloud_merger.ingest import Ingest, IngestLimits
from cloud_merger.parameters import MergeParameters
from cloud_merger.short_reports import ShortReports
from cloud_merger.waiting import WaitingLimits
from cloud_merger.wants import WantParameters
from gnd_map.classes import ChangeClass
from gnd_map.codec import decode_mask, encode_flags, encode_mask
from gnd_map.gaussian import Gaussians
from gnd_map.tile_id import District, TileId
from gnd_map.track import Piece, encode_track
from schemas.changes import ChangeAck, ChangeReport
from schemas.keys import change_key
from schemas.packed import PackedGaussians, PackedReport, crc_of, decode_upload
from tile_store.errors import StoreClosed
from tile_store.sqlite_store import SqliteStore
from vehicle_agent.packing import askable, pack, pack_measured

# Back and forth through the district; its ends are near enough.
LONG = dataclasses.replace(
    track_by(), pieces=(Piece(np.tile(np.array([[0, 0, 4], [2000, 0, 4]], np.int32), (3, 1)), 100),)
)
REPORT = drive_number(1, new={3: POLE, 4: BALL}, modified={1: WALL_AGAIN}, deleted=(2,))
PACKED = packed_of(REPORT)


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([tile_at(TILE), tile_at(NEIGHBOUR)])
        yield store


def ingest_of(store, want=None, waiting=None, **others):
    short = ShortReports(store, MergeParameters(), want or WantParameters(), waiting or WaitingLimits())
    return Ingest(store, IngestLimits(), now_ns=lambda: 77, short=short, **others)


@pytest.fixture
def ingest(store):
    return ingest_of(store)


def stored(store):
    return {row.tile: ChangeReport.decode(row.body).tiles[0] for row in store.reports()}


def second_half(report, ack):
    return pack_measured(report, bases_of(report), ack.wanted).encode()


def changed(payload, **values):
    return dataclasses.replace(decode_upload(payload), **values).encode()


def test_both_halves_store_what_the_whole_report_says_to_the_bit(store, ingest):
    first = ingest.answer(KEY, PACKED)
    assert (first.report_id, first.status) == (REPORT.report_id, "wanted")
    assert decode_mask(first.wanted, askable(REPORT)).tolist() == [True, True, True]
    assert (store.counts().report_rows, store.dirty_count()) == (0, 0), "nothing is kept by halves"
    assert ingest.answer(KEY, second_half(REPORT, first)) == ChangeAck(REPORT.report_id, "stored")
    (said,), (found,) = REPORT.tiles, stored(store).values()
    assert found.changed == said.changed
    assert (found.tile, found.base_version, found.base_sha) == (said.tile, said.base_version, said.base_sha)
    assert found.change_class.tolist() == said.change_class.tolist()
    assert not found.evidence.any()
    assert np.isin(said.changed.voxel_id, found.observed).all()
    assert len(found.observed) > 50, "the track tells what else was seen"
    assert found.pose_sigma_m == pytest.approx(said.pose_sigma_m, abs=1e-4)
    (row,) = store.reports()
    assert (row.vehicle, row.received_ns, row.base_sha) == (REPORT.vehicle, 77, said.base_sha)
    whole = ChangeReport.decode(row.body)
    assert (whole.sensor_model, whole.software) == (REPORT.sensor_model, REPORT.software)
    assert (whole.first_ns, whole.last_ns) == (REPORT.first_ns, REPORT.last_ns)


def test_where_nothing_is_wanted_the_flags_alone_are_stored_and_gaussians_withheld(store):
    ingest = ingest_of(store, WantParameters(enough=0))
    assert ingest.answer(KEY, PACKED).status == "stored"
    (found,) = stored(store).values()
    assert found.changed == Gaussians.nothing_at([1, 2, 3, 4])
    kinds = [ChangeClass.MODIFIED, ChangeClass.DELETED, ChangeClass.NEW, ChangeClass.NEW]
    assert found.change_class.tolist() == kinds
    assert store.dirty_count() == 1


def test_only_what_was_asked_for_comes_and_the_rest_stays_withheld(store):
    for number in (2, 3, 4, 5):
        whole = report_of(number, flagged(new={3: POLE}, deleted=(2,), observed=(0, 1, 2, 3)))
        assert ingest_of(store).answer(KEY, whole.encode()).status == "stored"
    ack = (ingest := ingest_of(store)).answer(KEY, PACKED)
    assert decode_mask(ack.wanted, 3).tolist() == [False, False, True]  # four saw 1 as it was; of 3 enough is in hand
    assert ingest.answer(KEY, second_half(REPORT, ack)).status == "stored"
    found = ChangeReport.decode(next(r for r in store.reports() if r.report_id == REPORT.report_id).body).tiles[0]
    assert found.changed.voxel_id[found.changed.exists].tolist() == [4]
    assert found.changed.select([4]) == REPORT.tiles[0].changed.select([4])


def test_halves_that_come_again_are_answered_again_and_applied_once(store):
    woken = []
    ingest = ingest_of(store, on_stored=lambda: woken.append(1))
    first = ingest.answer(KEY, PACKED)
    assert ingest.answer(KEY, PACKED) == first, "what was asked stays asked"
    half = second_half(REPORT, first)
    statuses = [ingest.answer(KEY, payload).status for payload in (half, half, PACKED, REPORT.encode(), half)]
    assert statuses == ["stored", "duplicate", "duplicate", "duplicate", "duplicate"]
    assert (store.counts().report_rows, len(woken)) == (1, 1)


def test_another_shard_of_the_same_store_knows_what_is_durable_and_asks_again_for_what_is_not(store, ingest):
    first = ingest.answer(KEY, PACKED)
    other = ingest_of(store)
    lost = other.answer(KEY, second_half(REPORT, first))
    assert (lost.report_id, lost.status) == (REPORT.report_id, "resend")
    assert "no flags" in lost.reason
    assert store.quarantined() == []
    again = other.answer(KEY, PACKED)
    assert other.answer(KEY, second_half(REPORT, again)).status == "stored"
    assert ingest.answer(KEY, second_half(REPORT, first)).status == "duplicate"  # late, and at the first shard
    assert ingest_of(store).answer(KEY, PACKED).status == "duplicate"  # a third one, which asks the store
    assert store.counts().report_rows == 1


def test_a_report_against_a_base_that_is_not_here_is_asked_for_whole(store, ingest):
    nowhere = drive_number(2, new={3: POLE})
    wrong = dataclasses.replace(nowhere, tiles=(dataclasses.replace(nowhere.tiles[0], base_version=9),))
    ack = ingest.answer(KEY, packed_of(wrong))
    assert ack.status == "resend"
    assert "has no version 9 here" in ack.reason
    assert ingest.answer(KEY, nowhere.encode()).status == "stored"


def test_a_base_with_another_content_is_noticed_by_its_digest(store, ingest):
    ack = ingest.answer(KEY, changed(PACKED, base_digest=b"\x01" * 8))
    assert ack.status == "resend"
    assert "the vehicle compared with 0101010101010101" in ack.reason
    assert (store.quarantined(), store.counts().report_rows) == ([], 0)


def test_a_tile_without_a_map_can_be_reported_in_short(store, ingest):
    south = TileId(TILE.morton - 2)
    change = dataclasses.replace(
        flagged(new={3: POLE}, base=Gaussians.empty(), tile=south), base_version=0, base_sha=b""
    )
    report = report_of(1, change)
    ack = ingest.answer(KEY, pack(report, {}, track_by(south)).encode())
    assert ack.status == "wanted"
    assert ingest.answer(KEY, pack_measured(report, {}, ack.wanted).encode()).status == "stored"
    assert stored(store)[south].changed == change.changed
    assert stored(store)[south].base_sha == b""


def test_a_report_over_two_tiles_is_asked_about_in_their_order(store, ingest):
    changes = [flagged(new={3: POLE}, modified={1: WALL_AGAIN}), flagged(new={4: BALL}, tile=NEIGHBOUR)]
    report = report_of(1, *sorted(changes, key=lambda change: change.tile))
    ack = ingest.answer(KEY, packed_of(report))
    mask = decode_mask(ack.wanted, askable(report))
    assert len(mask) == 3
    assert ingest.answer(KEY, second_half(report, ack)).status == "stored"
    assert [stored(store)[c.tile].changed for c in report.tiles] == [c.changed for c in report.tiles]


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
        (PACKED[:-3], "is truncated: its last field ends at byte"),
        (changed(PACKED, flags=decode_upload(PACKED).flags[:-1]), "flags"),
        (changed(PACKED, flags=b""), "flags"),
        (changed(PACKED, flags=encode_flags([])), "flags"),
        (changed(PACKED, track=b""), "track"),
        (changed(PACKED, track=decode_upload(PACKED).track[:-1]), "track"),
        (changed(PACKED, pose_sigma_tenth_mm=8_000), "pose known to 0.8 m"),
        (changed(PACKED, track=encode_track(LONG)), "m of way, the limit is 3000 m"),
        (packed_of(drive_number(1, new={3: POLE, 800 * 39 * 39: POLE})), "the limit is 400 floors"),
    ],
)
def test_a_bad_first_half_is_quarantined_with_its_reason_and_nothing_else_is_touched(store, ingest, payload, reason):
    ack = ingest.answer(KEY, payload)
    assert ack.status == "quarantined"
    assert reason in ack.reason
    (kept,) = store.quarantined()
    assert (kept.body, kept.reason, kept.source) == (payload, ack.reason, KEY)
    assert (store.counts().report_rows, len(ingest._short.room)) == (0, 0)
    assert ingest.answer(KEY, REPORT.encode()).status == "stored", "whole it is welcome"


@pytest.mark.parametrize(
    ("damage", "reason"),
    [
        (lambda half: dataclasses.replace(half, measured=half.measured[:-1]), "Gaussians of 3 voxels"),
        (lambda half: dataclasses.replace(half, measured=b""), "Gaussians of 3 voxels"),
        (lambda half: dataclasses.replace(half, measured=half.measured + b"\0"), "Gaussians of 3 voxels"),
        (
            lambda half: dataclasses.replace(half, measured=bytes([half.measured[0] ^ 255]) + half.measured[1:]),
            "3 voxels",
        ),
    ],
)
def test_a_bad_second_half_is_quarantined_and_its_first_half_forgotten(store, ingest, damage, reason):
    half = decode_upload(second_half(REPORT, ingest.answer(KEY, PACKED)))
    ack = ingest.answer(KEY, damage(half).encode())
    assert ack.status == "quarantined"
    assert reason in ack.reason
    assert len(store.quarantined()) == 1
    assert (store.counts().report_rows, len(ingest._short.room)) == (0, 0)
    assert ingest.answer(KEY, half.encode()).status == "resend"
    assert ingest.answer(KEY, REPORT.encode()).status == "stored"


def test_gaussians_before_flags_are_asked_for_again(store, ingest):
    early = PackedGaussians(REPORT.report_id, b"anything", 7)
    assert ingest.answer(KEY, early.encode()).status == "resend"
    assert (store.quarantined(), store.counts().report_rows) == ([], 0)


def test_gaussians_that_answer_another_mask_are_asked_for_again(store, ingest):
    ack = ingest.answer(KEY, PACKED)
    other = encode_mask(np.array([True, False, False]))
    resend = ingest.answer(KEY, pack_measured(REPORT, bases_of(REPORT), other).encode())
    assert resend.status == "resend"
    assert f"{crc_of(ack.wanted):08x}" in resend.reason
    assert ingest.answer(KEY, second_half(REPORT, ack)).status == "stored"


def test_a_second_half_on_another_key_is_refused(store, ingest):
    half = second_half(REPORT, ingest.answer(KEY, PACKED))
    ack = ingest.answer(change_key("signs", TILE.district), half)
    assert ack.status == "quarantined"
    assert "goes on on" in ack.reason


def test_an_absurd_gaussian_in_the_second_half_is_refused_like_in_a_whole_report(store):
    far = drive_number(1, new={3: (0.9, 0.0, 0.0, 0.1, 0.1, 0.1)})
    ingest = ingest_of(store)
    ack = ingest.answer(KEY, second_half(far, ingest.answer(KEY, packed_of(far))))
    assert ack.status == "quarantined"
    assert "from the voxel's centre" in ack.reason


def test_first_halves_that_wait_are_bounded_and_the_forgotten_come_again(store):
    ingest = ingest_of(store, waiting=WaitingLimits(reports=2))
    reports = [drive_number(n, new={3: POLE}) for n in range(1, 5)]
    acks = [ingest.answer(KEY, packed_of(report)) for report in reports]
    assert len(ingest._short.room) == 2
    statuses = [ingest.answer(KEY, second_half(r, a)).status for r, a in zip(reports, acks, strict=True)]
    assert statuses == ["resend", "resend", "stored", "stored"]
    assert [ingest.answer(KEY, packed_of(r)).status for r in reports[:2]] == ["wanted", "wanted"]


def test_gaussians_promised_by_some_are_not_asked_of_all(store):
    ingest = ingest_of(store, WantParameters(enough=2))
    statuses = [ingest.answer(KEY, packed_of(drive_number(n, new={3: POLE}))).status for n in range(1, 5)]
    assert statuses == ["wanted", "wanted", "stored", "stored"]


def test_a_store_that_fails_gives_no_ack_and_the_halves_may_come_again(tmp_path, store, ingest):
    half = second_half(REPORT, ingest.answer(KEY, PACKED))
    store.close()
    with pytest.raises(StoreClosed):
        ingest.answer(KEY, half)
    with SqliteStore(tmp_path / "map.sqlite") as again:
        assert again.counts().report_rows == 0
        fresh = ingest_of(again)
        assert fresh.answer(KEY, second_half(REPORT, fresh.answer(KEY, PACKED))).status == "stored"


def test_a_fault_of_the_shard_itself_does_not_hold_up_the_report(store, ingest, monkeypatch):
    def fails(*_):
        raise ZeroDivisionError("somewhere inside")

    monkeypatch.setattr(short_reports, "expand", fails)
    ack = ingest.answer(KEY, PACKED)
    assert ack.status == "resend"
    assert "ZeroDivisionError: somewhere inside" in ack.reason
    assert ingest.answer(KEY, REPORT.encode()).status == "stored"


def test_damaged_halves_are_refused_or_asked_for_again_and_nothing_is_stored_of_them(store):
    ingest, rng = ingest_of(store), random.Random(5)
    half = second_half(REPORT, ingest.answer(KEY, PACKED))
    for number in range(400):
        data = bytearray((PACKED, half)[number % 2])
        for _ in range(rng.randint(1, 3)):
            at = rng.randrange(len(data))
            match rng.randrange(3):
                case 0:
                    data[at] ^= 1 << rng.randrange(8)
                case 1:
                    del data[at : at + rng.randint(1, 5)]
                case _:
                    data[at:at] = rng.randbytes(rng.randint(1, 5))
        ack = ingest.answer(KEY, bytes(data))
        assert ack.status in ("quarantined", "resend", "wanted"), bytes(data).hex()
    assert store.counts().report_rows == 0


def test_many_vehicles_may_send_halves_at_once(store, ingest):
    statuses = []

    def vehicle(k):
        for n in range(3 * k, 3 * k + 3):
            report = drive_number(n, new={3: POLE}, modified={1: WALL_AGAIN})
            ack = ingest.answer(KEY, packed_of(report))
            statuses.append(
                ack.status if ack.status == "stored" else ingest.answer(KEY, second_half(report, ack)).status
            )

    threads = [threading.Thread(target=vehicle, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert statuses == ["stored"] * 12
    assert store.counts().reports == 12


def test_the_district_of_the_key_says_where_the_tiles_lie(store, ingest):
    elsewhere = District("13033/03021/23030")
    ack = ingest.answer(change_key("ndt", elsewhere), PACKED)
    assert ack.status == "resend"
    assert "has no version 1 here" in ack.reason
    assert isinstance(decode_upload(PACKED), PackedReport)
