"""Only `reply.ok` is an answer; everything else is asked again until the deadline."""

import threading

import pytest
import zenoh
from bus_testing import script, stays, wait_for

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import BusClosed, BusConfigError, NotMine, Refused, RequestFailed, RequestRefused
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.requesting import RetryPolicy

QUICK = RetryPolicy(first_wait_s=0.02, longest_wait_s=0.1, attempt_timeout_s=0.3)


def messages(ledger: Ledger, kind: str, direction: str) -> int:
    return sum(line.messages for line in ledger.totals() if (line.kind, line.direction) == (kind, direction))


def test_a_request_is_answered_and_booked(router, client, key):
    ledger = Ledger("a")
    server, bus = client(router), client(router, ledger=ledger)
    server.serve(f"{key}/**", lambda request: request.key.encode() + b" " + request.payload)
    assert bus.request(f"{key}/x", b"hello", kind="change", tile="13033/03021/23031/22102") == f"{key}/x hello".encode()
    assert messages(ledger, "ack", "down") == 1
    assert messages(ledger, "change", "up") >= 1
    assert "13033/03021/23031/22102" in ledger.by_tile()


def test_a_handler_that_raises_is_no_answer(router, client, key):
    server, bus = client(router), client(router)
    seen = []

    def broken(request):
        seen.append(request.payload)
        raise ZeroDivisionError("disk on fire")

    server.serve(key, broken)
    with pytest.raises(RequestFailed, match="ZeroDivisionError: disk on fire") as info:
        bus.request(key, b"same", kind="change", retry=QUICK, timeout_s=0.5)
    assert info.value.attempts >= 2
    assert len(seen) >= 2
    assert set(seen) == {b"same"}


def test_nobody_there_is_no_answer(router, client, key):
    with pytest.raises(RequestFailed, match=f"request to {key} failed after .* empty reply: nobody serves this key"):
        client(router).request(key, b"", kind="tile", retry=QUICK, timeout_s=0.3)


def test_a_hung_handler_is_no_answer(router, client, key):
    server, bus = client(router), client(router)
    release = threading.Event()
    server.serve(key, lambda _request: b"late" if release.wait(10) else b"never")
    with pytest.raises(RequestFailed, match="Timeout"):
        bus.request(key, b"", kind="tile", retry=QUICK, timeout_s=0.7)
    release.set()


def test_a_handler_that_recovers_answers_in_the_end(router, client, key):
    server, bus = client(router), client(router)
    calls = []

    def third_time_lucky(request):
        calls.append(request)
        if len(calls) < 3:
            raise OSError("locked")
        return b"stored"

    server.serve(key, third_time_lucky)
    assert bus.request(key, b"", kind="change", retry=QUICK) == b"stored"
    assert len(calls) == 3


def test_empty_replies_are_asked_again_until_a_server_comes(router, client, key):
    ledger = Ledger("a")
    bus, server = client(router, ledger=ledger), client(router)
    answers = []
    asking = threading.Thread(target=lambda: answers.append(bus.request(key, b"q", kind="tile", retry=QUICK)))
    asking.start()
    wait_for(lambda: messages(ledger, "tile", "up") >= 3, "three attempts")
    assert not answers
    server.serve(key, lambda _request: b"here")
    asking.join(10)
    assert answers == [b"here"]


KILLED_IN_HAND = """
import os, sys, threading
from gnd.fleet_bus import BusConfig, open_bus
with open_bus(BusConfig(connect=(sys.argv[1],))) as bus:
    bus.serve(sys.argv[2], lambda request: os._exit(9))
    print("serving", flush=True)
    threading.Event().wait()
"""


def test_a_server_killed_with_the_request_in_hand_loses_nothing(router, client, key):
    bus, server = client(router), client(router)
    with script(KILLED_IN_HAND, router, key) as doomed:
        doomed.wait_line("serving")
        answers = []
        asking = threading.Thread(target=lambda: answers.append(bus.request(key, b"q", kind="change", retry=QUICK)))
        asking.start()
        assert doomed.wait() == 9
        server.serve(key, lambda request: b"second " + request.payload)
        asking.join(10)
    assert answers == [b"second q"]


def test_a_refusal_ends_the_asking_at_once(router, client, key):
    server, bus = client(router), client(router)
    calls = []

    def never(request):
        calls.append(request)
        raise Refused("version 9 is not spoken here")

    server.serve(key, never)
    with pytest.raises(RequestRefused, match="after 1 attempts, last: refused: version 9 is not spoken here"):
        bus.request(key, b"", kind="change")
    assert len(calls) == 1


def test_not_mine_leaves_the_answer_to_another(router, client, key):
    fallback, owner, bus = client(router), client(router), client(router)

    def not_mine(_request):
        raise NotMine

    fallback.serve("test/**", not_mine)
    owner.serve(key, lambda _request: b"owner")
    assert [bus.request(key, b"", kind="change", retry=QUICK) for _ in range(5)] == [b"owner"] * 5


def test_a_complete_handler_is_asked_alone_and_its_fallback_after_it_has_gone(router, client, key):
    fallback, owner, bus = client(router), client(router), client(router)
    fallback_calls = []

    def answer_fallback(request):
        fallback_calls.append(request)
        return b"fallback"

    fallback.serve(f"{key}/**", answer_fallback)
    serving = owner.serve(f"{key}/a/**", lambda _request: b"owner", complete=True)
    wait_for(lambda: bus.request(f"{key}/a/1", b"", kind="change") == b"owner", "the owner's declaration")
    fallback_calls.clear()
    assert {bus.request(f"{key}/a/1", b"", kind="change") for _ in range(20)} == {b"owner"}
    assert not fallback_calls
    assert bus.request(f"{key}/b/1", b"", kind="change") == b"fallback"
    serving.close()
    wait_for(lambda: bus.request(f"{key}/a/1", b"", kind="change") == b"fallback", "the fallback")


def test_a_region_brings_its_tiles_and_no_other(router, client, key):
    server, bus = client(router), client(router)
    tiles = {f"{key}/{a}/{b}": f"{a}{b}".encode() for a in "01" for b in "0123"}

    def region(request):
        asked = zenoh.KeyExpr(request.key)
        assert request.is_wild
        return [(tile, body) for tile, body in tiles.items() if asked.intersects(zenoh.KeyExpr(tile))]

    server.serve(f"{key}/**", region)
    answers = bus.request_many(f"{key}/1/**", b"", kind="tile", retry=QUICK)
    assert sorted(answers) == [(f"{key}/1/{b}", f"1{b}".encode()) for b in "0123"]
    assert len(bus.request_many(f"{key}/**", b"", kind="tile", retry=QUICK)) == 8


def test_an_empty_region_is_an_answer(router, client, key):
    server, bus = client(router), client(router)
    server.serve(f"{key}/**", lambda _request: [])
    assert bus.request_many(f"{key}/1/**", b"", kind="tile", retry=QUICK) == []


def test_a_region_without_server_fails_instead_of_being_empty(router, client, key):
    with pytest.raises(RequestFailed, match="nobody serves this key"):
        client(router).request_many(f"{key}/**", b"", kind="tile", retry=QUICK, timeout_s=0.3)


def test_a_region_cut_short_is_not_taken_for_whole(router, client, key):
    """zenoh ends the query of a killed server like any other: only the announced number tells."""
    bus = client(router)

    def dies_after_two(query):
        with query:
            query.reply(f"{key}/1", b"1")
            query.reply(f"{key}/2", b"2")

    with zenoh.open(zenoh_config(BusConfig(connect=(router,)))) as session:
        session.declare_queryable(f"{key}/**", dies_after_two)
        with pytest.raises(RequestFailed, match="only 2 of an unknown number of answers came"):
            bus.request_many(f"{key}/**", b"", kind="tile", retry=QUICK, timeout_s=0.5)


def test_a_region_may_be_served_by_several(router, client, key):
    one, two, bus = client(router), client(router), client(router)
    one.serve(f"{key}/1/**", lambda _request: [(f"{key}/1/a", b"1")])
    two.serve(f"{key}/2/**", lambda _request: [(f"{key}/2/a", b"2"), (f"{key}/2/b", b"3")])
    want = {(f"{key}/1/a", b"1"), (f"{key}/2/a", b"2"), (f"{key}/2/b", b"3")}
    wait_for(lambda: set(bus.request_many(f"{key}/**", b"", kind="tile", retry=QUICK)) == want, "both servers")


def test_one_answer_to_a_region_is_a_handler_fault(router, client, key):
    server, bus = client(router), client(router)
    server.serve(f"{key}/**", lambda _request: b"bytes")
    with pytest.raises(RequestFailed, match="needs a key without wildcards"):
        bus.request_many(f"{key}/**", b"", kind="tile", retry=QUICK, timeout_s=0.3)


def test_a_handler_may_ask_in_turn(router, client, key):
    """A nested get in a zenoh callback would block; our handlers run in threads of their own."""
    inner, outer, bus = client(router), client(router), client(router)
    inner.serve(f"{key}/inner", lambda _request: b"deep")
    outer.serve(f"{key}/outer", lambda _request: outer.request(f"{key}/inner", b"", kind="tile") + b"er", workers=1)
    assert bus.request(f"{key}/outer", b"", kind="tile") == b"deeper"


def test_handlers_run_side_by_side(router, client, key):
    """zenoh delivers queries one after the other; both must be in hand at once to pass the barrier."""
    server, bus = client(router), client(router)
    together = threading.Barrier(2, timeout=5)

    def meet(_request):
        together.wait()
        return b"met"

    server.serve(f"{key}/**", meet, workers=2)
    answers = []
    threads = [
        threading.Thread(target=lambda i=i: answers.append(bus.request(f"{key}/{i}", b"", kind="tile")))
        for i in range(2)
    ]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert answers == [b"met", b"met"]


def test_a_full_mailbox_says_busy_and_is_asked_again(router, client, key, monkeypatch):
    monkeypatch.setattr("gnd.fleet_bus.serving.QUEUE_LIMIT", 1)
    server, bus = client(router), client(router)
    release = threading.Event()

    def slow(request):
        assert release.wait(10)
        return request.payload

    server.serve(f"{key}/**", slow, workers=1)
    answers, threads = [], []
    for i in range(4):
        ask = threading.Thread(
            target=lambda i=i: answers.append(bus.request(f"{key}/{i}", b"%d" % i, kind="tile", timeout_s=20))
        )
        threads.append(ask)
        ask.start()
    wait_for(lambda: "busy: 1 requests are waiting" in failure_of(bus, f"{key}/x"), "a refusal for the time being")
    release.set()
    for thread in threads:
        thread.join(20)
    assert sorted(answers) == [b"0", b"1", b"2", b"3"]


def failure_of(bus: Bus, key: str) -> str:
    with pytest.raises(RequestFailed) as info:
        bus.request(key, b"x", kind="tile", retry=QUICK, timeout_s=0.1)
    return info.value.cause


def test_closing_the_bus_ends_a_waiting_request(router, client, key):
    server, bus = client(router), client(router)
    in_hand, release, outcome = threading.Event(), threading.Event(), []

    def hang(_request):
        in_hand.set()
        release.wait(10)
        return b""

    server.serve(key, hang)

    def ask() -> None:
        try:
            bus.request(key, b"", kind="tile", timeout_s=60)
        except BusClosed as error:
            outcome.append(error)

    asking = threading.Thread(target=ask)
    asking.start()
    assert in_hand.wait(10)
    bus.close()
    asking.join(5)
    release.set()
    assert len(outcome) == 1
    with pytest.raises(BusClosed, match="is closed"):
        bus.request(key, b"", kind="tile")


def test_a_closed_handler_no_longer_answers(router, client, key):
    server, bus = client(router), client(router)
    with server.serve(key, lambda _request: b"yes") as serving:
        assert bus.request(key, b"", kind="tile", retry=QUICK) == b"yes"
    assert serving.is_closed
    with pytest.raises(RequestFailed):
        bus.request(key, b"", kind="tile", retry=QUICK, timeout_s=0.3)


def test_retries_spread_and_are_bounded():
    policy = RetryPolicy(first_wait_s=0.1, factor=2, longest_wait_s=1.0)
    waits = [[policy.wait_s(attempt) for _ in range(50)] for attempt in (1, 2, 3, 4, 50, 5000)]
    for spread, longest in zip(waits, [0.1, 0.2, 0.4, 0.8, 1.0, 1.0], strict=True):
        assert longest / 2 <= min(spread) < max(spread) <= longest
    with pytest.raises(BusConfigError):
        RetryPolicy(factor=0.5)


def test_the_deadline_holds_whatever_the_policy(router, client, key):
    bus = client(router)
    forever = RetryPolicy(first_wait_s=30, longest_wait_s=30)
    with pytest.raises(RequestFailed, match="after 1 attempts"):
        bus.request(key, b"", kind="tile", retry=forever, timeout_s=0.5)
    stays(bus.is_connected, "the session survives failed requests", for_s=0.05)
