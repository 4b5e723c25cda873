"""Reports in short: what a vehicle packs is what the cloud stores; nothing is kept by halves; bad halves are named."""

import dataclasses
import random
import signal
import subprocess
import sys
import threading

import numpy as np
import pytest
from merger_world import BALL, NEIGHBOUR, POLE, TILE, WALL_AGAIN, report_of
from short_world import KEY, bases_of, drive_number, flagged, packed_of, tile_at, track_by
from upload_desk import NOW, Desk

from gnd.cloud_merger import short_reports
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.verify import Verifier
from gnd.cloud_merger.wants import WantParameters
from gnd.cloud_merger.work import Worker
from gnd.gnd_map.classes import ChangeClass
from gnd.gnd_map.codec import decode_mask, encode_flags, encode_mask
from gnd.gnd_map.gaussian import Gaussians
from gnd.gnd_map.tile_id import District, TileId
from gnd.gnd_map.track import TrackPiece, encode_track
from gnd.schemas.changes import ChangeAck, ChangeReport
from gnd.schemas.keys import change_key
from gnd.schemas.packed import PackedReport, crc_of, decode_upload
from gnd.tile_store.errors import StoreClosed
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig
from gnd.vehicle_agent.report.packing import askable, pack, pack_measured

# Back and forth through the district; its ends are near enough.
LONG = dataclasses.replace(
    track_by(), pieces=(TrackPiece(np.tile(np.array([[0, 0, 4], [2000, 0, 4]], np.int32), (3, 1)), 100),)
)
REPORT = drive_number(1, new={3: POLE, 4: BALL}, modified={1: WALL_AGAIN}, deleted=(2,))
PACKED = packed_of(REPORT)


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([tile_at(TILE), tile_at(NEIGHBOUR)])
        yield store


@pytest.fixture
def desk(store):
    return Desk(store)


def stored(store):
    """What counts about each tile: part 1 in place of part 0."""
    rows = sorted(store.reports(), key=lambda row: row.part)
    return {row.tile: ChangeReport.decode(row.body).tiles[0] for row in rows}


def second_half(report, told):
    return pack_measured(report, bases_of(report), told.wanted).encode()


def changed(payload, **values):
    return dataclasses.replace(decode_upload(payload), **values).encode()


def test_flags_count_at_once_and_both_halves_say_what_the_whole_report_says_to_the_bit(store, desk):
    assert desk.ack(KEY, PACKED) == ChangeAck(REPORT.report_id, "stored")
    desk.work()
    ((vehicle, told),) = desk.told
    assert (vehicle, told.report_id, told.status) == (REPORT.vehicle, REPORT.report_id, "wanted")
    assert decode_mask(told.wanted, askable(REPORT)).tolist() == [True, True, True]
    assert desk.state(REPORT.vehicle, REPORT.report_id) == told
    assert stored(store)[TILE].changed == Gaussians.nothing_at([1, 2, 3, 4]), "flags are votes"
    assert store.dirty_count() == 1
    assert desk.ack(KEY, second_half(REPORT, told)) == ChangeAck(REPORT.report_id, "stored")
    assert desk.state(REPORT.vehicle, REPORT.report_id).status == "waiting"
    desk.work()
    assert desk.told[-1] == (REPORT.vehicle, desk.state(REPORT.vehicle, REPORT.report_id))
    assert desk.told[-1][1].status == "released"
    (said,), (found,) = REPORT.tiles, stored(store).values()
    assert found.changed == said.changed
    assert (found.tile, found.base_version, found.base_sha) == (said.tile, said.base_version, said.base_sha)
    assert found.change_class.tolist() == said.change_class.tolist()
    assert not found.evidence.any()
    assert np.isin(said.changed.voxel_id, found.observed).all()
    assert len(found.observed) > 50, "the track tells what else was seen"
    assert found.pose_sigma_m == pytest.approx(said.pose_sigma_m, abs=1e-4)
    flags, row = store.reports()
    assert (flags.part, row.part, row.vehicle, row.received_ns) == (0, 1, REPORT.vehicle, NOW)
    assert row.base_sha == said.base_sha
    whole = ChangeReport.decode(row.body)
    assert (whole.sensor_model, whole.software) == (REPORT.sensor_model, REPORT.software)
    assert (whole.first_ns, whole.last_ns) == (REPORT.first_ns, REPORT.last_ns)


ALL_OF_IT = pack(REPORT, bases_of(REPORT), track_by(), at_once_bytes=10_000)
"""The same report, its Gaussians beside the flags."""


def test_gaussians_that_come_with_the_flags_are_not_asked_for_and_count_like_those_that_were(tmp_path):
    kept = []
    for number, payloads in enumerate(((PACKED,), (ALL_OF_IT.encode(),))):
        with SqliteStore(tmp_path / f"{number}.sqlite") as store:
            store.put_tiles([tile_at()])
            desk = Desk(store)
            told = [desk.send(KEY, payload) for payload in payloads]
            if told[0].status == "wanted":
                told.append(desk.send(KEY, second_half(REPORT, told[0])))
            assert [one.status for one in told] == (["released"] if number else ["wanted", "released"])
            kept.append(stored(store)[TILE])
            assert [row.part for row in store.reports()] == ([0] if number else [0, 1])
    of_halves, at_once = kept
    assert at_once.changed == of_halves.changed == REPORT.tiles[0].changed
    assert at_once.observed.tolist() == of_halves.observed.tolist()
    assert at_once.change_class.tolist() == of_halves.change_class.tolist()


@pytest.mark.parametrize(
    "damage", [lambda m: m[:-1], lambda m: m + b"\0", lambda m: b"\xff" * len(m), lambda _m: b"\0"]
)
def test_gaussians_beside_the_flags_that_cannot_be_read_are_named_and_the_report_follows_whole(store, desk, damage):
    bad = dataclasses.replace(ALL_OF_IT, measured=damage(ALL_OF_IT.measured)).encode()
    told = desk.send(KEY, bad)
    assert (told.status, told.reason.split(":")[0]) == ("quarantined", "BadReport")
    assert not list(store.reports())
    assert desk.send(KEY, REPORT.encode()).status == "released"
    assert stored(store)[TILE].changed == REPORT.tiles[0].changed


def test_gaussians_beside_flags_that_name_none_are_refused(store, desk):
    bare = pack(drive_number(2, deleted=(2,)), bases_of(REPORT), track_by())
    told = desk.send(KEY, dataclasses.replace(bare, measured=ALL_OF_IT.measured).encode())
    assert told.status == "quarantined"
    assert not list(store.reports())


def test_where_nothing_is_wanted_the_flags_alone_are_stored_and_gaussians_withheld(store):
    desk = Desk(store, want=WantParameters(enough=0))
    assert desk.send(KEY, PACKED).status == "released"
    (found,) = stored(store).values()
    assert found.changed == Gaussians.nothing_at([1, 2, 3, 4])
    kinds = [ChangeClass.MODIFIED, ChangeClass.DELETED, ChangeClass.NEW, ChangeClass.NEW]
    assert found.change_class.tolist() == kinds
    assert store.dirty_count() == 1


def test_only_what_was_asked_for_comes_and_the_rest_stays_withheld(store):
    for number in (2, 3, 4, 5):
        whole = report_of(number, flagged(new={3: POLE}, deleted=(2,), observed=(0, 1, 2, 3)))
        assert Desk(store).send(KEY, whole.encode()).status == "released"
    told = (desk := Desk(store)).send(KEY, PACKED)
    assert decode_mask(told.wanted, 3).tolist() == [False, False, True]  # four saw 1 as it was; of 3 enough is in hand
    desk.send(KEY, second_half(REPORT, told))
    found = ChangeReport.decode(next(r for r in store.reports() if r.part == 1).body).tiles[0]
    assert found.changed.voxel_id[found.changed.exists].tolist() == [4]
    assert found.changed.select([4]) == REPORT.tiles[0].changed.select([4])


def test_only_tiles_of_which_gaussians_came_get_a_second_part(store, desk):
    changes = [flagged(deleted=(2,)), flagged(new={4: BALL}, tile=NEIGHBOUR)]
    report = report_of(1, *sorted(changes, key=lambda change: change.tile))
    desk.send(KEY, second_half(report, desk.send(KEY, packed_of(report))))
    assert sorted((row.tile, row.part) for row in store.reports()) == [(TILE, 0), (NEIGHBOUR, 0), (NEIGHBOUR, 1)]


def test_halves_that_come_again_are_acknowledged_again_and_applied_once(store):
    woken = []
    desk = Desk(store, on_journaled=lambda: woken.append(1))
    told = desk.send(KEY, PACKED)
    assert desk.ack(KEY, PACKED).status == "duplicate"
    assert desk.state(REPORT.vehicle, REPORT.report_id) == told, "what was asked stays asked"
    half = second_half(REPORT, told)
    statuses = [desk.ack(KEY, payload).status for payload in (half, half, PACKED)]
    desk.work()
    assert statuses == ["stored", "duplicate", "duplicate"]
    assert (store.counts().report_rows, len(woken)) == (2, 2)
    assert [desk.ack(KEY, payload).status for payload in (half, PACKED)] == ["duplicate"] * 2
    desk.send(KEY, REPORT.encode())  # whole, after all: it is what the second part says already
    assert (store.counts().report_rows, stored(store)[TILE].changed) == (2, REPORT.tiles[0].changed)
    assert desk.state(REPORT.vehicle, REPORT.report_id).status == "released"


def test_halves_may_come_in_any_order_and_to_different_shards(store):
    one, other = Desk(store, "one"), Desk(store, "other")
    half = second_half(REPORT, Desk(store, "asker").send(KEY, PACKED))
    again = drive_number(7, new={3: POLE, 4: BALL}, modified={1: WALL_AGAIN}, deleted=(2,))
    early = changed(half, report_id=again.report_id)  # the same Gaussians answer the same mask
    assert other.ack(KEY, early).status == "stored"
    other.work()
    assert store.upload_counts().by_state == {"wanted": 1, "early": 1}
    assert one.send(KEY, packed_of(again)).status in ("wanted", "released")
    other.work()
    one.work()
    assert "early" not in store.upload_counts().by_state
    assert [row.part for row in store.reports() if row.report_id == again.report_id] == [0, 1]
    assert one.state(again.vehicle, again.report_id).status == "released"


def test_what_is_wanted_outlives_every_shard(store, desk):
    told = desk.send(KEY, PACKED)
    later = Desk(store, "later")
    assert later.state(REPORT.vehicle, REPORT.report_id) == told
    later.send(KEY, second_half(REPORT, told))
    assert later.state(REPORT.vehicle, REPORT.report_id).status == "released"
    assert stored(store)[TILE].changed == REPORT.tiles[0].changed


DIES = """
import os, signal, sys
from gnd.cloud_merger.config import ShardConfig
from gnd.cloud_merger.expander import Expander
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.tile_store.values import StoreConfig

store = SqliteStore(sys.argv[1])
settle = store.settle_upload

def dies(settled):
    if sys.argv[2] == "after":
        settle(settled)
    os.kill(os.getpid(), signal.SIGKILL)

store.settle_upload = dies
Expander(store, ShardConfig("victim"), print).work()
"""


@pytest.mark.parametrize("when", ["before", "after"])
def test_a_worker_killed_before_or_after_the_journal_loses_and_doubles_nothing(store, desk, when):
    """Both halves meet a worker that dies with its work in hand, and then one that has just made it durable."""
    payload = PACKED
    for status in ("wanted", "released"):
        assert desk.ack(KEY, payload).status == "stored"
        store.release("desk")  # so that the other may have it at once
        died = subprocess.run([sys.executable, "-c", DIES, str(store.path), when], check=False, capture_output=True)
        assert died.returncode == -signal.SIGKILL, died.stderr
        store.release("victim")
        desk.work()
        state = desk.state(REPORT.vehicle, REPORT.report_id)
        assert state.status == status
        payload = second_half(REPORT, state) if state.wanted else b""
    assert [row.part for row in store.reports()] == [0, 1]
    assert stored(store)[TILE].changed == REPORT.tiles[0].changed


def test_a_report_against_a_base_that_is_not_here_is_asked_for_whole_and_accepted_whole(store, desk):
    wrong = dataclasses.replace(REPORT, tiles=(dataclasses.replace(REPORT.tiles[0], base_version=9),))
    told = desk.send(KEY, packed_of(wrong))
    assert told.status == "resend"
    assert "has no version 9 here" in told.reason
    assert desk.state(REPORT.vehicle, REPORT.report_id) == told
    assert desk.send(KEY, wrong.encode()).status == "released"
    assert desk.state(REPORT.vehicle, REPORT.report_id).status == "released"
    assert (store.quarantined(), store.counts().report_rows) == ([], 1)


def test_a_base_with_another_content_is_noticed_by_its_digest(store, desk):
    told = desk.send(KEY, changed(PACKED, base_digest=b"\x01" * 8))
    assert told.status == "resend"
    assert "the vehicle compared with 0101010101010101" in told.reason
    assert (store.quarantined(), store.counts().report_rows) == ([], 0)


def test_a_tile_without_a_map_can_be_reported_in_short(store, desk):
    south = TileId(TILE.morton - 2)
    change = dataclasses.replace(
        flagged(new={3: POLE}, base=Gaussians.empty(), tile=south), base_version=0, base_sha=b""
    )
    report = report_of(1, change)
    told = desk.send(KEY, pack(report, {}, track_by(south)).encode())
    assert told.status == "wanted"
    desk.send(KEY, pack_measured(report, {}, told.wanted).encode())
    assert stored(store)[south].changed == change.changed
    assert stored(store)[south].base_sha == b""


def test_a_report_over_two_tiles_is_asked_about_in_their_order(store, desk):
    changes = [flagged(new={3: POLE}, modified={1: WALL_AGAIN}), flagged(new={4: BALL}, tile=NEIGHBOUR)]
    report = report_of(1, *sorted(changes, key=lambda change: change.tile))
    told = desk.send(KEY, packed_of(report))
    assert len(decode_mask(told.wanted, askable(report))) == 3
    desk.send(KEY, second_half(report, told))
    assert [stored(store)[c.tile].changed for c in report.tiles] == [c.changed for c in report.tiles]


@pytest.mark.parametrize(
    ("payload", "reason"),
    [
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
def test_a_bad_first_half_is_quarantined_with_its_reason_and_nothing_else_is_touched(store, desk, payload, reason):
    told = desk.send(KEY, payload)
    assert told.status == "quarantined"
    assert reason in told.reason
    (kept,) = store.quarantined()
    assert (kept.body, kept.reason, kept.source) == (payload, told.reason, KEY)
    assert store.counts().report_rows == 0
    assert desk.send(KEY, REPORT.encode()).status == "released", "whole it is welcome"
    assert desk.state(REPORT.vehicle, REPORT.report_id).status == "released"


@pytest.mark.parametrize(
    "damage",
    [
        lambda half: half.measured[:-1],
        lambda half: b"",
        lambda half: half.measured + b"\0",
        lambda half: bytes([half.measured[0] ^ 255]) + half.measured[1:],
    ],
)
def test_a_bad_second_half_is_quarantined_and_the_whole_report_takes_the_place_of_its_flags(store, desk, damage):
    half = decode_upload(second_half(REPORT, desk.send(KEY, PACKED)))
    told = desk.send(KEY, changed(half.encode(), measured=damage(half)))
    assert (told.report_id, told.status) == (REPORT.report_id, "resend")
    assert "Gaussians of 3 voxels" in told.reason
    assert desk.state(REPORT.vehicle, REPORT.report_id) == told
    assert len(store.quarantined()) == 1
    assert [row.part for row in store.reports()] == [0]
    assert desk.send(KEY, REPORT.encode()).status == "released"
    assert [row.part for row in store.reports()] == [0, 1]
    assert stored(store)[TILE].changed == REPORT.tiles[0].changed


def test_gaussians_that_answer_another_mask_are_quarantined_and_the_right_ones_still_wanted(store, desk):
    told = desk.send(KEY, PACKED)
    other = encode_mask(np.array([True, False, False]))
    desk.send(KEY, pack_measured(REPORT, bases_of(REPORT), other).encode())
    assert f"asked were {crc_of(told.wanted):08x}" in store.quarantined()[0].reason
    assert desk.state(REPORT.vehicle, REPORT.report_id) == told
    desk.send(KEY, second_half(REPORT, told))
    assert desk.state(REPORT.vehicle, REPORT.report_id).status == "released"


def test_a_second_half_on_another_key_answers_nothing(store, desk):
    half = second_half(REPORT, desk.send(KEY, PACKED))
    assert desk.ack(change_key("signs", TILE.district), half).status == "quarantined"
    desk.send(change_key("ndt", District("13033/03021/23030")), half)
    assert desk.state(REPORT.vehicle, REPORT.report_id).status == "wanted"


def test_an_absurd_gaussian_in_the_second_half_is_refused_like_in_a_whole_report(store, desk):
    far = drive_number(1, new={3: (0.9, 0.0, 0.0, 0.1, 0.1, 0.1)})
    told = desk.send(KEY, second_half(far, desk.send(KEY, packed_of(far))))
    assert told.status == "resend"
    assert "from the voxel's centre" in told.reason
    told = desk.send(KEY, far.encode())
    assert told.status == "quarantined"
    assert desk.state(far.vehicle, far.report_id) == told


def test_gaussians_promised_by_some_are_not_asked_of_all(store):
    desk = Desk(store, want=WantParameters(enough=2))
    statuses = [desk.send(KEY, packed_of(drive_number(n, new={3: POLE}))).status for n in range(1, 5)]
    assert statuses == ["wanted", "wanted", "released", "released"]


def test_flags_under_the_id_of_another_vehicle_are_asked_about_and_answered_apart(store, desk):
    forged = changed(PACKED, vehicle="mallory", sensor_model="none")
    assert desk.send(KEY, forged).status == "wanted"
    told = desk.send(KEY, PACKED)
    assert desk.told[-1][0] == REPORT.vehicle
    desk.send(KEY, second_half(REPORT, told))
    by_vehicle = {(row.vehicle, row.part): row.report_id for row in store.reports()}
    assert by_vehicle["mallory", 0] == REPORT.report_id
    assert by_vehicle[REPORT.vehicle, 0] != REPORT.report_id, "its flags count all the same"
    assert len({row.report_id for row in store.reports()}) == 2


def test_a_store_that_fails_loses_no_half_that_was_acknowledged(tmp_path, store, desk):
    half = second_half(REPORT, desk.send(KEY, PACKED))
    assert desk.ack(KEY, half).status == "stored"
    store.close()
    with pytest.raises(StoreClosed):
        desk.work()
    with SqliteStore(tmp_path / "map.sqlite") as again:
        fresh = Desk(again)
        fresh.work()
        assert fresh.state(REPORT.vehicle, REPORT.report_id).status == "released"


def test_a_fault_of_the_shard_itself_leads_to_the_whole_report(store, desk, monkeypatch):
    def fails(*_):
        raise ZeroDivisionError("somewhere inside")

    monkeypatch.setattr(short_reports, "expand", fails)
    monkeypatch.setattr("gnd.cloud_merger.expander.RETRY_S", 0.0)
    told = desk.send(KEY, PACKED)
    assert told.status == "quarantined"
    assert "ZeroDivisionError: somewhere inside" in told.reason
    assert desk.send(KEY, REPORT.encode()).status == "released"


def test_damaged_halves_are_refused_or_asked_for_again_and_nothing_is_released_of_them(store, desk):
    rng = random.Random(5)
    half = second_half(REPORT, desk.send(KEY, PACKED))
    for number in range(300):
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
        assert desk.ack(KEY, bytes(data)).status in ("quarantined", "stored", "duplicate"), bytes(data).hex()
    desk.work()
    assert "waiting" not in store.upload_counts().by_state
    rows = [row for row in store.reports() if row.report_id == REPORT.report_id]
    assert all(ChangeReport.decode(row.body).tiles[0].base_sha == REPORT.tiles[0].base_sha for row in rows)


def test_many_vehicles_may_send_halves_at_once(store, desk):
    def vehicle(k):
        for n in range(3 * k, 3 * k + 3):
            report = drive_number(n, new={3: POLE}, modified={1: WALL_AGAIN})
            desk.ack(KEY, packed_of(report))
            while (told := desk.state(report.vehicle, report.report_id)).status == "waiting":
                desk.work()
            if told.status == "wanted":
                desk.ack(KEY, second_half(report, told))
                desk.work()

    threads = [threading.Thread(target=vehicle, args=(k,)) for k in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    desk.work()
    assert set(store.upload_counts().by_state) == {"released"}
    assert store.counts().reports == 12


def test_the_district_of_the_key_says_where_the_tiles_lie(store, desk):
    elsewhere = District("13033/03021/23030")
    told = desk.send(change_key("ndt", elsewhere), PACKED)
    assert told.status == "resend"
    assert "has no version 1 here" in told.reason
    assert isinstance(decode_upload(PACKED), PackedReport)


def test_what_could_not_win_makes_no_merge_and_counts_in_the_next(tmp_path):
    """Two against one: nothing is asked of the one. With three more it wins, and its own vote is among theirs."""
    with SqliteStore(tmp_path / "lazy.sqlite", StoreConfig(merge_delay_s=0.0)) as store:
        store.put_tiles([tile_at(TILE), tile_at(NEIGHBOUR)])
        desk = Desk(store)
        worker = Worker(store, ShardConfig("desk"))

        def merge():
            while claims := store.claim("desk", 10, 60.0):
                for claim in claims:
                    worker.settle(claim)

        def drives(number, **said):
            report = drive_number(number, **said)
            told = desk.send(KEY, packed_of(report))
            if told.wanted:
                desk.send(KEY, second_half(report, told))
            return told

        for number in (1, 2):
            drives(number)
        merge()
        assert not drives(3, new={3: POLE}).wanted
        assert store.dirty_count() == 0, "it waits for another reason to merge"
        assert drives(4, new={3: POLE}).wanted
        for number in (5, 6):
            drives(number, new={3: POLE})
        merge()
        changed = store.get("ndt", TILE).decode_gaussians()
        assert 3 in changed.gaussians.voxel_id, "four of six; without the one that waited three of five, too few"
        assert {one.status for one in Verifier(store, ShardConfig("desk")).history("ndt", TILE)} <= {"same", "given"}
