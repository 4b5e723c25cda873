"""Word that a report is released waits for the next ack, and nothing else does; nobody waits for ever."""

import signal
import threading
import time

import pytest
from merger_processes import Cloud, wait_for
from merger_world import BALL, POLE, TILE, WALL_AGAIN, report_of
from short_world import KEY, bases_of, flagged, packed_of, tile_at, track_by
from upload_desk import Desk

from gnd.cloud_merger import patience
from gnd.cloud_merger.ingest import Ingest
from gnd.cloud_merger.patience import KEPT_S, PatientWords
from gnd.cloud_merger.states import States
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.fleet_bus.router import open_router
from gnd.fleet_bus.seals import Holder
from gnd.schemas.changes import ChangeAck
from gnd.schemas.keys import want_key
from gnd.schemas.limits import MAX_STATES_OF_ACK
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportState, ReportStates
from gnd.tile_store.sqlite_store import SqliteStore
from gnd.vehicle_agent.link.outbox import PATIENT_ASK_S
from gnd.vehicle_agent.report.packing import pack

VEHICLE = "car-1"
FIRST, SECOND, THIRD = (
    report_of(n, flagged(new={3: POLE, 4: BALL}, modified={1: WALL_AGAIN}), vehicle=VEHICLE) for n in (1, 2, 3)
)


def patient(report, *, is_last=False):
    return pack(report, bases_of(report), track_by(), 1000, is_last=is_last).encode()


def state(number, status="released"):
    reason = "no" if status in ("resend", "quarantined") else ""
    return ReportState(deterministic_report_id(1, "v", str(number)), status, reason=reason)


class Clock:
    def __init__(self):
        self.now_s = 0.0

    def __call__(self):
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def words(clock):
    return PatientWords(clock)


def test_what_was_not_said_to_be_patient_is_told_at_once(words):
    assert not words.keep("car", state(1))
    words.expect("car", state(1).report_id)
    assert not words.keep("another", state(1)), "nobody is patient for another"
    assert words.take("car") == words.take("another") == ()


@pytest.mark.parametrize("status", ["resend", "quarantined", "waiting", "unknown"])
def test_only_that_a_report_is_released_waits(words, status):
    words.expect("car", state(1).report_id)
    assert not words.keep("car", state(1, status))
    assert not words.keep("car", state(1)), "it is looked at anew, and waited for"


def test_a_word_waits_for_its_vehicle_and_is_given_once(words):
    for number in (1, 2):
        words.expect("car", state(number).report_id)
        assert words.keep("car", state(number))
    assert words.take("another") == ()
    assert words.take("car") == (state(1), state(2))
    assert words.take("car") == ()


def test_a_word_waits_no_longer_than_until_it_is_due_whatever_comes_meanwhile(words, clock):
    for number in (1, 2):
        words.expect("car", state(number).report_id)
        words.keep("car", state(number))
        assert words.due() == []
        clock.now_s += 0.6 * KEPT_S
    words.expect("later", state(3).report_id)
    words.keep("later", state(3))
    assert words.due() == [("car", (state(1), state(2)))]
    assert words.due() == []
    assert KEPT_S < PATIENT_ASK_S, "or vehicles would ask for what waits for them"


def test_memory_is_bounded_and_what_has_no_room_is_told_at_once(words, monkeypatch):
    monkeypatch.setattr(patience, "MOST_PATIENT", 40)
    monkeypatch.setattr(patience, "MOST_VEHICLES", 1)
    for number in range(60):
        words.expect("car", state(number).report_id)
    kept = [words.keep("car", state(number)) for number in range(60)]
    assert kept == [False] * 20 + [True] * MAX_STATES_OF_ACK + [False] * (40 - MAX_STATES_OF_ACK)
    words.expect("another", state(60).report_id)
    assert not words.keep("another", state(60))
    assert len(words.take("car")) == MAX_STATES_OF_ACK


@pytest.fixture
def store(tmp_path):
    with SqliteStore(tmp_path / "map.sqlite") as store:
        store.put_tiles([tile_at()])
        yield store


class PatientDesk(Desk):
    """A shard whose words go to the vehicle's key on a bus."""

    def __init__(self, store, cloud, words):
        super().__init__(store)
        self.ingest = Ingest(store, "desk", now_ns=self.ingest._now_ns, words=words)
        self.states = States(store, cloud, words)

    def _tell(self, vehicle, told):
        self.states.tell(vehicle, told)


@pytest.fixture
def endpoint(free_port):
    where = f"tcp/127.0.0.1:{free_port}"
    with open_router([where]):
        yield where


@pytest.fixture
def heard(endpoint):
    """What the vehicle is told on its own key."""
    found = []
    with open_bus(BusConfig(connect=(endpoint,))) as car:
        car.subscribe(want_key(VEHICLE), lambda _key, payload: found.append(ReportStates.decode(payload)), kind="ack")
        yield found


@pytest.fixture
def desk(store, endpoint, words, heard):
    with open_bus(BusConfig(connect=(endpoint,))) as shard:
        yield PatientDesk(store, shard, words)


def released(*reports):
    return tuple(ReportState(one.report_id, "released") for one in reports)


def test_the_ack_of_the_next_report_brings_the_word_and_an_impatient_one_brings_the_rest(desk, heard):
    assert desk.ack(KEY, patient(FIRST)) == ChangeAck(FIRST.report_id, "stored")
    desk.work()
    assert desk.ack(KEY, patient(SECOND)) == ChangeAck(SECOND.report_id, "stored", told=released(FIRST))
    assert desk.ack(KEY, patient(SECOND)) == ChangeAck(SECOND.report_id, "duplicate"), "told once"
    desk.work()
    assert heard == []
    assert desk.ack(KEY, patient(THIRD, is_last=True)).told == released(SECOND)
    desk.work()
    wait_for("the last one is told at once", lambda: heard)
    assert heard == [ReportStates(released(THIRD))]


def test_a_word_that_is_told_takes_along_those_that_wait(desk, heard):
    desk.ack(KEY, patient(FIRST))
    desk.ack(KEY, packed_of(SECOND))  # its Gaussians are asked for
    desk.work()
    wait_for("the second one is told", lambda: heard)
    (told,) = heard
    assert {one.report_id: one.status for one in told.states}[FIRST.report_id] == "released"


def test_what_waits_for_too_long_is_told(desk, heard, clock):
    desk.ack(KEY, patient(FIRST))
    desk.work()
    desk.states.tell_kept()
    clock.now_s += KEPT_S
    assert heard == []
    desk.states.tell_kept()
    wait_for("it is told", lambda: heard)
    assert heard == [ReportStates(released(FIRST))]


def test_nobody_takes_the_word_that_waits_for_another(desk):
    """With identities: who seals a report of another vehicle is refused, and hears nothing."""
    desk.ack(KEY, patient(FIRST))
    desk.work()
    thief = Holder("vehicle", "thief", "", b"12345678", time.time() + 1000, None)
    ack = desk.ingest.answer(KEY, patient(SECOND), thief)
    assert (ack.status, ack.told) == ("quarantined", ())
    assert desk.ack(KEY, patient(THIRD)).told == released(FIRST)


@pytest.mark.slow
@pytest.mark.xdist_group("shards")
def test_a_real_shard_keeps_the_word_and_one_that_is_killed_is_asked(tmp_path, free_port):
    cloud, heard = Cloud(tmp_path, free_port), threading.Event()
    cloud.open()
    try:
        cloud.store.put_tiles([tile_at(TILE)])
        cloud.start("one")
        with open_bus(BusConfig(connect=(cloud.endpoint,))) as car:
            car.subscribe(want_key(VEHICLE), lambda *_: heard.set(), kind="ack")
            first, second, third = (_sent(car, report) for report in (FIRST, SECOND, THIRD) if _wait(cloud, report))
            assert (first.told, second.told) == ((), released(FIRST))
            assert third.told == released(SECOND)
            assert not heard.is_set()
            wait_for("the third is looked at", lambda: _status(cloud, THIRD) == "released")
            cloud.signal("one", signal.SIGKILL)  # with the word that it kept
            cloud.shards["one"].wait()
            cloud.start("two")
            assert _status(cloud, THIRD) == "released", "who asks any shard hears it"
    finally:
        cloud.close()


def _wait(cloud, report):
    """Until all before this report are looked at."""
    before = [one for one in (FIRST, SECOND, THIRD) if one.report_id < report.report_id]
    wait_for("those before are looked at", lambda: all(_status(cloud, one) == "released" for one in before))
    time.sleep(0.5)  # and told to the process that receives
    return True


def _status(cloud, report):
    return cloud.store.upload_statuses(VEHICLE, [report.report_id])[0].state


def _sent(car, report) -> ChangeAck:
    retry = RetryPolicy(longest_wait_s=0.2, attempt_timeout_s=10.0)
    return ChangeAck.decode(car.request(KEY, patient(report), kind="change", retry=retry, timeout_s=60.0))
