"""Senders are served in turn, and connections that become no session are told from those that do."""

import logging
import threading

import pytest

from gnd.fleet_bus import turns
from gnd.fleet_bus.errors import BusConfigError
from gnd.fleet_bus.guard import GuardLimits, SeenConnection, address, to_close
from gnd.fleet_bus.requesting import RequestAnswers, busy_text
from gnd.fleet_bus.seldom import LINES_A_MINUTE, MAX_LINE_CHARACTERS, Seldom
from gnd.fleet_bus.turns import InTurn


class Clock:
    now_s = 0.0

    def __call__(self) -> float:
        return self.now_s


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def mailbox(clock):
    """One thread that is held until `go`; then `done` lists what it has handled."""
    go, done, began = threading.Event(), [], threading.Event()

    def handle(item):
        began.set()
        assert go.wait(20)
        done.append(item)

    workers = InTurn("test", handle, 1, 40, clock)
    workers.go, workers.done, workers.began = go, done, began
    assert list(workers.offer("first", 0, "first")) == []
    assert began.wait(20)
    yield workers
    go.set()
    workers.close()


def finished(mailbox, n):
    mailbox.go.set()
    for _ in range(2000):
        if len(mailbox.done) >= n:
            return mailbox.done
        threading.Event().wait(0.005)
    raise AssertionError(mailbox.done)


def test_a_flooder_waits_for_itself(mailbox):
    for n in range(10):
        mailbox.offer("flooder", 60_000, f"flood-{n}")
    mailbox.offer("car", 100, "car")
    assert finished(mailbox, 12).index("car") <= 3


def test_one_turn_fills_a_quarter(mailbox):
    refused = [item for n in range(20) for item in mailbox.offer("flooder", 1, n)]
    assert refused == list(range(10, 20))
    assert list(mailbox.offer("car", 1, "car")) == []


def test_a_full_mailbox_drops_the_newest_of_the_longest(mailbox):
    for turn in ("a", "b", "c", "d"):
        for n in range(9):
            assert list(mailbox.offer(turn, 1, f"{turn}{n}")) == []
    mailbox.offer("a", 1, "a9")
    for n in range(3):
        mailbox.offer(f"car-{n}", 1, f"car-{n}")
    assert list(mailbox.offer("car-3", 1, "car-3")) == ["a9"]


def test_names_that_are_new_share_a_quarter(mailbox, clock):
    mailbox.offer("car", 1, "before")
    clock.now_s += turns.KNOWN_AFTER_S
    for n in range(8):
        mailbox.offer(f"new-{n}", 1, f"new-{n}")
        mailbox.offer("car", 1, f"car-{n}")
    early = finished(mailbox, 18)[2:10]
    assert sum(str(one).startswith("car") for one in early) >= 5


def test_a_closed_mailbox_takes_nothing(clock):
    workers = InTurn("closed", print, 1, 10, clock)
    workers.close()
    assert list(workers.offer("car", 1, "x")) == ["x"]


def test_busy_says_how_long_and_nonsense_says_nothing():
    class Reply:
        def __init__(self, text):
            self.encoding, self.payload = "gnd/busy", self
            self._text = text

        def to_bytes(self):
            return self._text.encode()

    for text, wait_s in (
        (busy_text(2.5, "full"), 2.5),
        (busy_text(1e6, "full"), 60.0),
        ("nonsense", 0.0),
        ("-5;x", 0.0),
    ):
        answers = RequestAnswers()
        answers.add_error(Reply(text))
        assert answers.retry_after_s == wait_s


def test_log_lines_are_few_and_short(caplog, clock):
    log = Seldom(logging.getLogger("test"), clock)
    for n in range(500):
        log.warning("%s %d", "x" * 10_000, n)
    assert len(caplog.records) == LINES_A_MINUTE
    clock.now_s += 61.0
    log.warning("again")
    assert "(470 lines like it left out)" in caplog.records[-1].getMessage()
    assert all(len(one.getMessage()) <= MAX_LINE_CHARACTERS + 50 for one in caplog.records)


def seen(n, host="10.0.0.1", since_s=0.0) -> SeenConnection:
    return SeenConnection(n, n, (host, n), since_s)


def test_handshakes_end_and_sessions_stay():
    limits = GuardLimits(handshake_s=5.0, handshakes=3, of_address=100)
    sessions = {("10.0.0.1", 1)}
    assert to_close([seen(1), seen(2)], sessions, limits, 4.0) == []
    assert [(one.inode, why) for one, why in to_close([seen(1), seen(2)], sessions, limits, 6.0)] == [(2, "handshake")]


def test_of_too_many_handshakes_the_oldest_of_the_busiest_address_go():
    limits = GuardLimits(handshake_s=5.0, handshakes=3, of_address=100)
    many = [seen(n, since_s=n / 10) for n in range(1, 5)]
    going = to_close([*many, seen(9, "10.0.0.2")], set(), limits, 1.0)
    assert [one.inode for one, _ in going] == [1, 2]


def test_of_an_address_with_too_many_the_newest_go():
    limits = GuardLimits(handshake_s=5.0, handshakes=256, of_address=2)
    ones = [seen(n, since_s=n) for n in range(1, 5)]
    going = to_close([*ones, seen(9, "10.0.0.2", 9.0)], {one.peer for one in ones}, limits, 4.0)
    assert [(one.inode, why) for one, why in going] == [(3, "address"), (4, "address")]


def test_addresses_are_compared_in_one_form():
    assert address("::ffff:10.0.0.1", 5) == ("10.0.0.1", 5)
    assert address("fe80::1%eth0", 5) == ("fe80::1", 5)


def test_limits_that_close_everything_are_refused():
    with pytest.raises(BusConfigError):
        GuardLimits(handshake_s=0.0, handshakes=1, of_address=1)


def test_newcomers_leave_threads_to_the_known_while_those_come(clock):
    held, began, count = threading.Event(), [], 8

    def handle(item):
        began.append(item)
        assert held.wait(20)

    workers = InTurn("test", handle, count, 1000, clock)
    try:
        workers.offer("known", 0, "known")
        clock.now_s += turns.KNOWN_AFTER_S + 1.0
        workers.offer("known", 0, "known again")
        until(lambda: len(began) == 2)
        for n in range(100):
            workers.offer(f"new-{n}", 0, "new")
        share = count // turns.NEWCOMERS_THREADS - 1  # one has what came before it was known
        until(lambda: began.count("new") == share)
        workers.offer("known", 0, "known at last")
        until(lambda: "known at last" in began)
        assert began.count("new") == share
    finally:
        held.set()
        workers.close()


def test_newcomers_have_all_threads_where_nobody_is_known(clock):
    held, began = threading.Event(), []

    def handle(item):
        began.append(item)
        assert held.wait(20)

    workers = InTurn("test", handle, 8, 1000, clock)
    try:
        for n in range(20):
            workers.offer(f"new-{n}", 0, "new")
        until(lambda: len(began) == 8)
    finally:
        held.set()
        workers.close()


def until(condition) -> None:
    for _ in range(4000):
        if condition():
            return
        threading.Event().wait(0.005)
    raise AssertionError(condition)


def test_long_keys_are_not_kept(clock):
    """A key may have 65,535 characters, and 65,536 turns are remembered."""
    known = turns.KnownTurns(clock)
    workers = InTurn("test", lambda _item: None, 1, 10, clock)
    workers._turns = known
    for n in range(10):
        workers.offer(f"{n}" + 60_000 * "x", 0, "item")
    workers.close()
    assert sum(map(len, known._new)) <= 10 * turns.LONGEST_TURN


def test_a_session_that_is_not_named_for_a_moment_keeps_its_connection():
    """zenoh may not name it while it is given up or renewed: it has the time of a handshake again."""
    limits = GuardLimits(handshake_s=5.0, handshakes=10, of_address=10)
    one = SeenConnection(3, 33, ("10.0.0.1", 5), since_s=0.0, session_s=100.0)
    assert to_close([one], [], limits, 104.0) == []
    assert to_close([one], [], limits, 106.0) == [(one, "handshake")]
