"""The outbox thread over a real bus: nobody there, a slow answer, a refusal, a restart."""

import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest
from waiting import wait_until

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import Refused
from gnd.fleet_bus.serving import Request
from gnd.gnd_map.tile_id import District
from gnd.schemas.changes import ChangeAck
from gnd.schemas.keys import change_key, change_keys, state_key, state_keys, want_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportQuestion, ReportState, ReportStates
from gnd.vehicle_agent.errors import OutboxError
from gnd.vehicle_agent.link.outbox import Outbox
from gnd.vehicle_agent.link.sending import SenderThread

DISTRICT = District("13033/03021/23031")
KEY = change_key("ndt", DISTRICT)
NEVER = threading.Event()
Opener = Callable[[], SenderThread]


def report_id(number: int) -> str:
    return deterministic_report_id(1_570_838_400_000, "vehicle", str(number))


@pytest.fixture
def outbox(tmp_path: Path) -> Outbox:
    return Outbox(tmp_path / "outbox.sqlite")


@pytest.fixture
def start(bus: Bus, outbox: Outbox) -> Iterator[Opener]:
    opened: list[SenderThread] = []

    def open_sender() -> SenderThread:
        opened.append(SenderThread(bus, outbox, "vehicle"))
        return opened[-1]

    yield open_sender
    bus.close()
    for sender in opened:
        sender.close()


class Inbox:
    """Answers reports with a status, remembers them, and tells that they are released."""

    def __init__(self, cloud: Bus, status: str = "stored", reason: str = "") -> None:
        self.cloud, self.status, self.reason = cloud, status, reason
        self.bodies: list[bytes] = []

    def __call__(self, request: Request) -> bytes:
        self.bodies.append(request.payload)
        if self.status != "quarantined":
            told = ReportStates((ReportState(request.payload.decode(), "released"),))
            self.cloud.publish(want_key("vehicle"), told.encode(), kind="ack")
        return ChangeAck(request.payload.decode(), self.status, self.reason).encode()  # type: ignore[arg-type]


def test_reports_wait_until_somebody_answers(start: Opener, outbox: Outbox, cloud: Bus) -> None:
    outbox.put(report_id(1), KEY, report_id(1).encode())
    sender = start()
    assert not sender.drain(0.3, NEVER)
    assert outbox.counts().pending == 1
    inbox = Inbox(cloud)
    cloud.serve(change_keys(), inbox)
    assert sender.drain(15.0, NEVER)
    assert outbox.counts().acknowledged == 1
    assert set(inbox.bodies) == {report_id(1).encode()}


def test_the_oldest_goes_first_and_a_duplicate_counts_as_acknowledged(
    start: Opener, outbox: Outbox, cloud: Bus
) -> None:
    inbox = Inbox(cloud, "duplicate")
    cloud.serve(change_keys(), inbox)
    ids = sorted(report_id(n) for n in range(5))
    for number in reversed(ids):
        outbox.put(number, KEY, number.encode())
    assert start().drain(15.0, NEVER)
    assert inbox.bodies == [number.encode() for number in ids]
    assert outbox.counts().acknowledged == 5


def test_a_quarantined_report_is_kept_with_its_reason(start: Opener, outbox: Outbox, cloud: Bus) -> None:
    cloud.serve(change_keys(), Inbox(cloud, "quarantined", "covariance of voxel 7 is absurd"))
    outbox.put(report_id(1), KEY, report_id(1).encode())
    assert start().drain(15.0, NEVER)
    assert outbox.refused() == [(report_id(1), "covariance of voxel 7 is absurd")]


def test_a_report_that_is_refused_for_good_is_not_sent_for_ever(start: Opener, outbox: Outbox, cloud: Bus) -> None:
    def refuse(_request: Request) -> bytes:
        raise Refused("no reports about this region")

    cloud.serve(change_keys(), refuse)
    outbox.put(report_id(1), KEY, b"body")
    assert start().drain(15.0, NEVER)
    assert "no reports about this region" in outbox.refused()[0][1]


def test_an_answer_for_another_report_is_no_acknowledgement(start: Opener, outbox: Outbox, cloud: Bus) -> None:
    cloud.serve(change_keys(), lambda _: ChangeAck(report_id(99), "stored").encode())
    outbox.put(report_id(1), KEY, b"body")
    sender = start()
    wait_until(lambda: sender.last_error)
    assert f"was answered for report {report_id(99)}" in sender.last_error
    assert outbox.counts().pending == 1


def test_an_answer_without_an_id_counts_only_where_a_seal_binds_it(start: Opener, outbox: Outbox, cloud: Bus) -> None:
    """In a session without identities nothing shows what it answers."""
    cloud.serve(change_keys(), lambda _: ChangeAck(report_id(1), "stored").unnamed().encode())
    outbox.put(report_id(1), KEY, b"body")
    sender = start()
    wait_until(lambda: sender.last_error)
    assert "was answered for report without an id" in sender.last_error
    assert outbox.counts().pending == 1


def test_a_restarted_sender_sends_only_what_is_open(start: Opener, outbox: Outbox, cloud: Bus) -> None:
    outbox.put(report_id(1), KEY, report_id(1).encode())
    outbox.put(report_id(2), KEY, report_id(2).encode())
    outbox.answered(report_id(1), "stored")
    outbox.told(ReportState(report_id(1), "released"), 0)
    outbox.failed(outbox.due(0)[0], 10**19 // 2, "the agent was killed here")
    inbox = Inbox(cloud)
    cloud.serve(change_keys(), inbox)
    assert start().drain(15.0, NEVER)
    assert inbox.bodies == [report_id(2).encode()]


def test_draining_ends_when_the_agent_is_stopped(start: Opener, outbox: Outbox) -> None:
    outbox.put(report_id(1), KEY, b"body")
    stop = threading.Event()
    stop.set()
    assert not start().drain(60.0, stop)


def test_a_lost_notice_is_asked_for_and_the_end_of_the_drive_waits_for_it(
    start: Opener, outbox: Outbox, cloud: Bus
) -> None:
    """Nobody tells anything: after four seconds the vehicle asks after all that is held, in one message."""
    asked = []

    def answer(request: Request) -> bytes:
        asked.append((request.key, ReportQuestion.decode(request.payload).report_ids))
        states = (ReportState(one, "waiting" if len(asked) == 1 else "released") for one in asked[-1][1])
        return ReportStates(tuple(states)).encode()

    cloud.serve(change_keys(), lambda request: ChangeAck(request.payload.decode(), "stored").encode())
    cloud.serve(state_keys(), answer)
    ids = tuple(report_id(n) for n in (1, 2))
    for number in sorted(ids):
        outbox.put(number, KEY, number.encode())
    sender = start()
    assert not sender.drain(2.0, NEVER)
    assert (outbox.counts().acknowledged, outbox.counts().held, asked) == (2, 2, [])
    assert sender.drain(15.0, NEVER)
    assert asked == [(state_key("vehicle"), tuple(sorted(ids)))] * 2
    assert sender.counts == {"whole": 2, "questions": 2}


def test_an_agent_that_was_killed_asks_at_once_after_what_it_had_sent(
    start: Opener, outbox: Outbox, cloud: Bus
) -> None:
    outbox.put(report_id(1), KEY, report_id(1).encode())
    outbox.answered(report_id(1), "stored", now_ns=10**19 // 2)
    cloud.serve(state_keys(), lambda _: ReportStates((ReportState(report_id(1), "released"),)).encode())
    assert start().drain(3.0, NEVER)


def test_a_cloud_that_has_forgotten_a_report_gets_it_again(start: Opener, outbox: Outbox, cloud: Bus) -> None:
    """A store put back from a backup of before the ack."""
    outbox.put(report_id(1), KEY, report_id(1).encode())
    outbox.answered(report_id(1), "stored")
    cloud.serve(state_keys(), lambda _: ReportStates((ReportState(report_id(1), "unknown"),)).encode())
    cloud.serve(change_keys(), inbox := Inbox(cloud))
    assert start().drain(15.0, NEVER)
    assert inbox.bodies == [report_id(1).encode()]


def test_a_full_disk_under_the_outbox_does_not_end_the_sender(
    start: Opener, outbox: Outbox, cloud: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("gnd.vehicle_agent.link.sending.STORE_PAUSE_S", 0.05)
    fails = {"due": 2, "answered": 1, "failed": 1}

    def failing(name: str) -> Callable[..., object]:
        real: Callable[..., object] = getattr(outbox, name)

        def call(*arguments: object, **named: object) -> object:
            if fails[name]:
                fails[name] -= 1
                raise OutboxError("disk I/O error")
            return real(*arguments, **named)

        return call

    for name in fails:
        monkeypatch.setattr(outbox, name, failing(name))
    inbox = Inbox(cloud)
    cloud.serve(change_keys(), inbox)
    outbox.put(report_id(1), KEY, report_id(1).encode())
    sender = start()
    assert sender.drain(10.0, NEVER), sender.last_error
    assert fails == {"due": 0, "answered": 0, "failed": 0}


def test_a_date_that_is_set_back_keeps_no_report_from_going(
    start: Opener, outbox: Outbox, cloud: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    outbox.put(report_id(1), KEY, report_id(1).encode())
    sender = start()
    wait_until(lambda: sender.last_error != "" or sender.counts["whole"] > 0)
    before_ns = time.time_ns()
    monkeypatch.setattr(time, "time_ns", lambda: before_ns - 86_400 * 10**9)
    cloud.serve(change_keys(), Inbox(cloud))
    outbox.failed(outbox.due(2**62)[0], time.monotonic_ns(), "no answer")  # waits half a second, not a day
    assert sender.drain(10.0, NEVER), sender.last_error
