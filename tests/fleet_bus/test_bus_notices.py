"""Notices and signs of life."""

import signal
import threading

import pytest
import zenoh
from bus_testing import PROBE, Inbox, RouterProcess, script, stays, wait_for

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.errors import BusClosed, NoRouter
from gnd.fleet_bus.ledger import Ledger


def test_a_burst_arrives_whole_and_in_order(router, client, key, monkeypatch):
    """zenoh's default drops half of it: publishers block, and the router's queue is long."""
    monkeypatch.setattr("gnd.fleet_bus.subscribing.QUEUE_LIMIT", 10_000)
    sender, receiver = client(router), client(router)
    inbox = Inbox()
    receiver.subscribe(key, inbox)
    inbox.wait_connected(sender, key)
    for number in range(5000):
        sender.publish(key, number.to_bytes(4, "little") + bytes(1000), kind="update")
    wait_for(lambda: len(inbox.items) == 5000, "5000 notices")
    assert [int.from_bytes(payload[:4], "little") for payload in inbox.payloads] == list(range(5000))


def test_the_router_may_drop_any_notice_whatever_its_publisher_wants(router, client, key):
    """Publishers wait for their own link; the router waits for no subscriber."""
    sender, receiver = client(router), client(router)
    samples: list[zenoh.Sample] = []
    subscriber = receiver._connection.session.declare_subscriber(key, samples.append)
    wait_for(lambda: sender.publish(key, PROBE, kind="control") or samples, "a plain notice")
    with sender.advanced_publisher(key) as publisher:
        publisher.put(b"advanced")
        wait_for(lambda: samples[-1].payload.to_bytes() == b"advanced", "an advanced notice")
    sender._connection.session.put(key, b"", congestion_control=zenoh.CongestionControl.BLOCK)  # a foreign program
    wait_for(lambda: samples[-1].payload.to_bytes() == b"", "a foreign notice")
    assert all(sample.congestion_control == zenoh.CongestionControl.DROP for sample in samples)
    assert all(sample.priority == zenoh.Priority.DATA_LOW for sample in samples)
    subscriber.undeclare()


def test_a_subscriber_hears_its_region_and_nothing_else(router, client, key):
    sender, receiver = client(router), client(router)
    inbox = Inbox()
    receiver.subscribe(f"{key}/13033/03021/**", inbox)
    inbox.wait_connected(sender, f"{key}/13033/03021/23031/22102")
    for path in ("13033/03021/23031/22102", "13033/03022/00000/00000", "13033/030210/x", "13033/03021/33333/00000"):
        sender.publish(f"{key}/{path}", path.encode(), kind="update")
    wait_for(lambda: len(inbox.items) == 2, "two notices")
    stays(lambda: len(inbox.items) == 2, "notices from outside the region", for_s=0.1)
    assert inbox.payloads == [b"13033/03021/23031/22102", b"13033/03021/33333/00000"]


def test_a_stuck_callback_blocks_neither_the_session_nor_the_sender(router, client, key, monkeypatch):
    monkeypatch.setattr("gnd.fleet_bus.subscribing.QUEUE_LIMIT", 10)
    sender, receiver = client(router), client(router)
    release = threading.Event()
    inbox = Inbox(lambda _key, _payload: release.wait(10))
    subscription = receiver.subscribe(key, inbox)
    receiver.serve(f"{key}/ask", lambda _request: b"alive")
    inbox.wait_connected(sender, key)
    for number in range(2000):
        sender.publish(key, b"%d" % number, kind="update")
    assert sender.request(f"{key}/ask", b"", kind="control") == b"alive"
    # One is in the callback and ten wait: the newest.
    wait_for(lambda: subscription.dropped >= 1989, "1989 dropped notices")
    release.set()
    wait_for(lambda: len(inbox.items) == 11, "the newest notices")
    assert [int(payload) for payload in inbox.payloads[1:]] == list(range(1990, 2000))


def test_a_callback_that_raises_gets_the_next_notice(router, client, key):
    sender, receiver = client(router), client(router)

    def picky(_key, _payload):
        raise ValueError("not like this")

    inbox = Inbox(picky)
    receiver.subscribe(key, inbox)
    inbox.wait_connected(sender, key)
    sender.publish(key, b"1", kind="update")
    sender.publish(key, b"2", kind="update")
    wait_for(lambda: inbox.payloads == [b"1", b"2"], "both notices")


def test_a_callback_may_ask(router, client, key):
    sender, receiver = client(router), client(router)
    sender.serve(f"{key}/tile", lambda _request: b"the tile")
    got = []
    inbox = Inbox(lambda _key, _payload: got.append(receiver.request(f"{key}/tile", b"", kind="tile")))
    receiver.subscribe(key, inbox)
    inbox.wait_connected(sender, key)
    sender.publish(key, b"", kind="update")
    wait_for(lambda: got == [b"the tile"], "a request out of a callback")


def test_notices_are_booked_with_their_tile(router, client, key):
    sent, received = Ledger("s"), Ledger("r")
    sender, receiver = client(router, ledger=sent), client(router, ledger=received)
    inbox = Inbox()
    receiver.subscribe(f"{key}/**", inbox, tile_of=lambda at: "13033" if at.endswith("/13033") else None)
    inbox.wait_connected(sender, f"{key}/probe")
    sender.publish(f"{key}/13033", bytes(123), kind="update", tile="13033")
    wait_for(lambda: inbox.items, "the notice")
    assert received.by_tile() == sent.by_tile() == {"13033": (1, 123)}
    assert [(line.kind, line.direction) for line in received.totals()] == [("update", "down")]


def test_a_put_without_router_is_reported(router_process: RouterProcess, client, key):
    bus = client(router_process.endpoint)
    bus.publish(key, b"", kind="update")
    router_process.kill()
    wait_for(lambda: not bus.is_connected(), "the loss of the router")
    with pytest.raises(NoRouter, match=f"no router at {router_process.endpoint} for 0.1 s: 4 bytes for {key} were not"):
        bus.publish(key, b"lost", kind="update", wait_s=0.1)


def test_a_put_waits_for_the_router_to_come_back(router_process: RouterProcess, client, key):
    sender, receiver = client(router_process.endpoint), client(router_process.endpoint)
    inbox = Inbox()
    receiver.subscribe(key, inbox)
    router_process.kill()
    wait_for(lambda: not sender.is_connected() and not receiver.is_connected(), "the loss of the router")
    restarting = threading.Timer(0.2, router_process.start)
    restarting.start()
    inbox.wait_connected(sender, key)  # its first put waits for the router
    restarting.join()
    sender.publish(key, b"after", kind="update")
    wait_for(lambda: inbox.payloads == [b"after"], "the notice after the restart")


def test_closing_ends_a_waiting_put(router_process: RouterProcess, client, key):
    bus = client(router_process.endpoint)
    router_process.kill()
    wait_for(lambda: not bus.is_connected(), "the loss of the router")
    outcome = []

    def put() -> None:
        try:
            bus.publish(key, b"", kind="update", wait_s=60)
        except BusClosed as error:
            outcome.append(error)

    waiting = threading.Thread(target=put)
    waiting.start()
    bus.close()
    waiting.join(5)
    assert len(outcome) == 1


def test_a_late_subscriber_gets_what_the_publisher_remembers(router, client, key):
    sender, late = client(router), client(router)
    publisher = sender.advanced_publisher(key, remember=2)
    for number in range(3):
        publisher.put(b"%d" % number)
    got = []
    late.subscribe("test/**", lambda at, payload: got.append(payload) if at == key else None, history=True)
    wait_for(lambda: got[-2:] == [b"1", b"2"], "the remembered notices")
    assert len(set(got)) == len(got), "a notice came twice"


def test_notices_survive_kill_and_restart_of_the_router(router_process: RouterProcess, client, key):
    sender, receiver = client(router_process.endpoint), client(router_process.endpoint)
    got = []
    receiver.subscribe(key, lambda _key, payload: got.append(payload), history=True)
    publisher = sender.advanced_publisher(key, remember=10)
    publisher.put(b"before")
    wait_for(lambda: b"before" in got, "the first notice")
    router_process.kill()
    wait_for(lambda: not sender.is_connected(), "the loss of the router")
    publisher.put(b"during")
    router_process.start()
    sender.wait_connected(10)
    publisher.put(b"after")
    wait_for(lambda: b"after" in got and b"during" in got, "what was published while the router was away")
    assert sorted(got) == [b"after", b"before", b"during"]


HOLDER = """
import sys, threading
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
with open_bus(BusConfig(connect=(sys.argv[1],), lease_ms=int(sys.argv[3]))) as bus:
    bus.declare_alive(sys.argv[2])
    print("alive", flush=True)
    threading.Event().wait()
"""


def watch(bus: Bus, keyexpr: str) -> list[tuple[str, bool]]:
    seen: list[tuple[str, bool]] = []
    bus.watch_alive(keyexpr, lambda key, alive: seen.append((key, alive)))
    return seen


def test_signs_of_life_come_and_go(router, client, key):
    holder, watcher = client(router), client(router)
    early = holder.declare_alive(f"{key}/early")
    seen = watch(watcher, f"{key}/*")
    wait_for(lambda: seen == [(f"{key}/early", True)], "the token that was there before")
    with holder.declare_alive(f"{key}/late"):
        wait_for(lambda: seen[1:] == [(f"{key}/late", True)], "the new token")
    wait_for(lambda: seen[2:] == [(f"{key}/late", False)], "the end of it")
    early.close()
    wait_for(lambda: seen[3:] == [(f"{key}/early", False)], "the end of the other")


def test_a_killed_process_is_noticed(router, client, key):
    seen = watch(client(router), f"{key}/*")
    with script(HOLDER, router, f"{key}/doomed", "10000") as holder:
        wait_for(lambda: seen == [(f"{key}/doomed", True)], "the token")
        holder.kill()
        wait_for(lambda: seen[1:] == [(f"{key}/doomed", False)], "the death, long before the lease of 10 s", 5.0)


def test_a_hanging_process_is_noticed_after_its_lease(router, client, key):
    seen = watch(client(router), f"{key}/*")
    with script(HOLDER, router, f"{key}/hung", "500") as holder:
        wait_for(lambda: seen == [(f"{key}/hung", True)], "the token")
        holder.signal(signal.SIGSTOP)
        wait_for(lambda: seen[1:] == [(f"{key}/hung", False)], "the end of the lease", 5.0)


def test_signs_of_life_return_with_the_router(router_process: RouterProcess, client, key):
    holder, watcher = client(router_process.endpoint), client(router_process.endpoint)
    holder.declare_alive(f"{key}/agent")
    seen = watch(watcher, f"{key}/*")
    wait_for(lambda: seen == [(f"{key}/agent", True)], "the token")
    router_process.kill()
    wait_for(lambda: seen[1:] == [(f"{key}/agent", False)], "everybody gone with the router")
    router_process.start()
    wait_for(lambda: seen[2:] == [(f"{key}/agent", True)], "the token again")
