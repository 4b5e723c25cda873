"""Reception on a real router: what one shard declares, answers and gives up."""

import threading

import pytest
from merger_processes import Cloud, all_acks, raw_session, wait_for
from merger_world import POLE, TILE, change_of, report_of

from gnd.cloud_merger import reception
from gnd.cloud_merger.ownership import Members, owner_of
from gnd.cloud_merger.reception import Orphans, Reception
from gnd.deploy.fleet_identities import make_identities
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.gnd_map.tile_id import TileId
from gnd.schemas.changes import ChangeAck, ChangeReport
from gnd.schemas.keys import alive_key, change_key
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.link.sending import SenderThread

TILES = [TileId((TILE.morton & ~1023) + k * 1024 + 5) for k in range(8)]
REPORTS = [report_of(n, change_of(None, [0], {0: POLE}, tile=tile)) for n, tile in enumerate(TILES)]


@pytest.fixture
def cloud(tmp_path, free_port):
    cloud = Cloud(tmp_path, free_port)
    cloud.open()
    yield cloud
    cloud.close()


@pytest.fixture
def shard(cloud):
    """Shard "one", which stores nothing: it acknowledges all, and refuses reports of the last tile's district."""
    died = []

    def answer(_key, payload, _asker=None):
        report = ChangeReport.decode(payload)
        is_bad = report.district == TILES[-1].district
        return ChangeAck(report.report_id, "quarantined" if is_bad else "stored", "bad" if is_bad else "")

    with open_bus(BusConfig(connect=(cloud.endpoint,)), name="one") as bus:
        shard = Reception(bus, Members("one"), answer, died.append)
        shard.open()
        shard.died = died
        wait_for("the shard lives", lambda: cloud.living == {"one"})
        yield shard


def serving_threads():
    return sum(thread.name.startswith("serve ") for thread in threading.enumerate())


def districts(reports):
    return tuple(sorted(report.district.path for report in reports))


def test_a_district_is_declared_with_its_first_good_report(cloud, shard):
    assert shard.districts == ()
    with raw_session(cloud.endpoint) as session:
        for report in (*REPORTS, *REPORTS):
            assert len(all_acks(session, report)) == 1
    assert shard.districts == districts(REPORTS[:-1])


def test_a_district_more_takes_no_thread_more(cloud, shard):
    with raw_session(cloud.endpoint) as session:
        all_acks(session, REPORTS[0])
        before = serving_threads()
        for report in REPORTS:
            assert len(all_acks(session, report)) == 1
        assert serving_threads() == before > 0
    assert len(shard.districts) == len(REPORTS) - 1


def test_only_so_many_districts_are_declared_and_the_others_are_answered_all_the_same(cloud, shard, monkeypatch):
    monkeypatch.setattr(reception, "MAX_DECLARED", 2)
    with raw_session(cloud.endpoint) as session:
        for report in (*REPORTS, *REPORTS):
            assert len(all_acks(session, report)) == 1
    assert shard.districts == districts(REPORTS[5:7])


def test_districts_are_given_up_when_their_owner_comes_and_taken_back_when_it_goes(cloud, shard):
    with raw_session(cloud.endpoint) as session:
        for report in REPORTS[:-1]:
            all_acks(session, report)
        two = cloud.bus.declare_alive(alive_key("merger", "two"))  # lives, but does not answer
        mine = [report for report in REPORTS[:-1] if owner_of(report.district, ["one", "two"]) == "one"]
        others = [report for report in REPORTS[:-1] if report not in mine]
        assert mine
        assert others
        wait_for("the districts of two are given up", lambda: shard.districts == districts(mine))
        assert [len(all_acks(session, report)) for report in others] == [0] * len(others)
        assert [len(all_acks(session, report)) for report in mine] == [1] * len(mine)
        two.close()
        wait_for("the death is noticed", lambda: shard.died == ["two"])
        assert [len(all_acks(session, report)) for report in others] == [1] * len(others)


def test_a_report_that_comes_again_and_again_is_kept_whoever_owns_its_district(cloud, shard, monkeypatch):
    """Linked routers may hand it to this shard alone, long after another has become the owner."""
    monkeypatch.setattr(reception, "ORPHAN_S", 0.05)
    owned = [report for report in REPORTS[:-1] if owner_of(report.district, ["one", "two"]) == "two"]
    with raw_session(cloud.endpoint) as session:
        cloud.bus.declare_alive(alive_key("merger", "two"))  # lives, but does not answer
        wait_for("two is known", lambda: not shard._members.is_mine(owned[0].district))
        assert len(all_acks(session, owned[0])) == 0
        wait_for("it has asked again", lambda: len(all_acks(session, owned[0])) == 1)
        assert len(all_acks(session, owned[0])) == 1, "from then on at once"
    assert shard.districts == (), "whose it is does not change"


def test_orphans_are_what_comes_again_within_a_time():
    now_s = [100.0]
    orphans, place, other = Orphans(lambda: now_s[0]), ("ndt", TILE.district), ("ndt", TILES[-1].district)
    assert not orphans.has(place, "key", b"one")
    now_s[0] += 1.0
    assert not orphans.has(place, "key", b"one"), "the owner may be about to answer"
    now_s[0] += 1.5
    assert not orphans.has(place, "key", b"two"), "another message"
    assert orphans.has(place, "key", b"one")
    assert orphans.has(place, "key", b"two"), "of a district of which one has come again"
    assert not orphans.has(other, "elsewhere", b"two")
    now_s[0] += 31.0
    assert not orphans.has(place, "key", b"three")
    assert not orphans.has(place, "key", b"two"), "it was heard long ago"
    now_s[0] += 2.0
    assert orphans.has(place, "key", b"two")


def test_who_does_not_own_a_district_says_nothing_of_a_seal(cloud, shard, tmp_path):
    """It cannot know the key that a vehicle shares with the owner: told so, the vehicle would forget it each time."""
    identities = make_identities(tmp_path, 2, 1)
    district = next(one.district for one in REPORTS if owner_of(one.district, ["one", "two"]) == "two")
    key = change_key("ndt", district)

    def joined(name):
        return open_bus(BusConfig(connect=(cloud.endpoint,), identity=identities / name), name=name)

    with joined("merger-0") as one, joined("merger-1") as two, joined("vehicle-00") as vehicle:
        for bus, name in ((one, "one"), (two, "two")):
            members = Members(name)
            members.note("two" if name == "one" else "one", alive=True)
            reception = Reception(
                bus, members, lambda _key, payload, _asker: ChangeAck(payload.decode(), "stored"), print
            )
            bus.serve("gnd/v1/change/**", reception._fallback, kind="change", concerns=reception._may_answer)
        ids = [report_of(n, change_of(None, [0], {0: POLE})).report_id for n in range(4)]
        acks = [vehicle.request(key, one.encode(), kind="change", timeout_s=20.0) for one in ids]
        assert [ChangeAck.decode(ack).report_id for ack in acks] == [ids[0], "", "", ""]
        assert one.connection.sealing.refused == {}


def test_a_key_that_is_no_district_is_answered_rather_than_ignored(cloud, shard):
    with raw_session(cloud.endpoint) as session:
        replies = list(session.get("gnd/v1/change/ndt/9", payload=REPORTS[0].encode(), timeout=5.0))
    assert [ChangeAck.decode(reply.ok.payload.to_bytes()).report_id for reply in replies] == [REPORTS[0].report_id]


def test_under_an_agreed_key_an_ack_needs_not_name_its_report(cloud, tmp_path):
    """The first question is signed, and its ack names the report; from then on the seal shows what is acknowledged."""
    identities = make_identities(tmp_path, 1, 1)
    outbox, key = Outbox(tmp_path / "outbox.sqlite"), change_key("ndt", TILE.district)

    def answer(_key, payload, asker):
        assert asker.name == "vehicle-00"
        return ChangeAck(payload.decode(), "stored")

    def joined(name):
        return open_bus(BusConfig(connect=(cloud.endpoint,), identity=identities / name), name=name)

    with joined("merger-0") as shard, joined("vehicle-00") as vehicle:
        Reception(shard, Members("merger-0"), answer, lambda _: None).open()
        ids = [report_of(n, change_of(None, [0], {0: POLE})).report_id for n in range(4)]
        acks = [vehicle.request(key, one.encode(), kind="change", timeout_s=20.0) for one in ids]
        assert [ChangeAck.decode(ack).report_id for ack in acks] == [ids[0], "", "", ""]
        for one in ids:
            outbox.put(one, key, one.encode())
        sender = SenderThread(vehicle, outbox, "vehicle-00")
        wait_for("all are acknowledged", lambda: outbox.counts().held == len(ids))
        assert sender.last_error == ""
        vehicle.close()
        sender.close()
