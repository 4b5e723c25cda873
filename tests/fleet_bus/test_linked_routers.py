"""Routers that are linked, in processes of their own: what one has, the other's clients reach; one may be killed."""

import threading
import time

import pytest
from bus_testing import Inbox, RouterProcess, new_endpoint, wait_for

from gnd.fleet_bus.bus import Bus
from gnd.fleet_bus.config import FAIL_OVER_MS, BusConfig, zenoh_config
from gnd.fleet_bus.links import load_link
from gnd.fleet_bus.requesting import RetryPolicy

QUICK = RetryPolicy(first_wait_s=0.02, longest_wait_s=0.2, attempt_timeout_s=5.0)
ALIVE = "test/alive"


@pytest.fixture
def routers(endpoint):
    """A hub and a region's router that is linked with it, started first: (region, hub)."""
    hub, region = RouterProcess(endpoint), RouterProcess(new_endpoint(), connect=(endpoint,))
    region.start()
    hub.start()
    yield region, hub
    region.close()
    hub.close()


class Numbers:
    """A sender that publishes 1, 2, 3 … on a key until it is stopped."""

    def __init__(self, bus: Bus, key: str) -> None:
        self._publisher = bus.advanced_publisher(key, remember=10_000)
        self._stop = threading.Event()
        self.sent = 0
        self._thread = threading.Thread(target=self._run)
        self._thread.start()

    def _run(self) -> None:
        while not self._stop.wait(0.02):
            self.sent += 1
            self._publisher.put(str(self.sent).encode())

    def stop(self) -> None:
        self._stop.set()
        self._thread.join()


def test_what_is_served_at_one_router_is_reached_from_the_other(routers, client, key):
    region, hub = routers
    far, near = client(hub.endpoint), client(region.endpoint)
    far.serve(f"{key}/far", lambda request: b"far: " + request.payload)
    near.serve(f"{key}/near", lambda request: b"near: " + request.payload)
    assert near.request(f"{key}/far", b"1", kind="tile", retry=QUICK) == b"far: 1"
    assert far.request(f"{key}/near", b"2", kind="tile", retry=QUICK) == b"near: 2"
    inbox = Inbox()
    near.subscribe(key, inbox)
    inbox.wait_connected(far, key)
    far.publish(key, b"3", kind="update")
    wait_for(lambda: inbox.payloads == [b"3"], "a notice over the link")


def test_a_token_is_seen_over_the_link_and_goes_with_its_router(routers, client):
    region, hub = routers
    seen: list[tuple[str, bool]] = []
    client(hub.endpoint).watch_alive(f"{ALIVE}/*", lambda key, alive: seen.append((key, alive)))
    client(region.endpoint, open_timeout_s=2).declare_alive(f"{ALIVE}/near")
    wait_for(lambda: seen == [(f"{ALIVE}/near", True)], "the token over the link")
    region.kill()
    wait_for(lambda: seen[-1] == (f"{ALIVE}/near", False), "the end of the token")


def test_a_client_of_a_killed_router_goes_on_at_its_second(routers, client, key):
    """Requests in flight included: each is answered, and every notice arrives once and in order."""
    region, hub = routers
    far, vehicle = client(hub.endpoint), client(region.endpoint, hub.endpoint)
    far.serve(f"{key}/asked", lambda request: request.payload)
    inbox = Inbox()
    vehicle.subscribe(f"{key}/told", inbox, history=True)
    inbox.wait_connected(far, f"{key}/told")
    numbers = Numbers(far, f"{key}/told")
    wait_for(lambda: inbox.items, "the first notice")
    killer = threading.Timer(0.3, region.kill)
    killer.start()
    for n in range(100):
        payload = str(n).encode()
        assert vehicle.request(f"{key}/asked", payload, kind="change", retry=QUICK) == payload
        time.sleep(0.01)
    killer.join()
    numbers.stop()
    wait_for(lambda: len(inbox.items) >= numbers.sent, "every notice")
    assert inbox.payloads == [str(n).encode() for n in range(1, numbers.sent + 1)]
    assert vehicle.connections == 2


def test_what_is_served_moves_with_its_server_to_the_second_router(routers, client, key):
    """A shard's side: who asks over the hub reaches it again after its own router was killed."""
    region, hub = routers
    server, asker = client(region.endpoint, hub.endpoint), client(hub.endpoint)
    server.serve(key, lambda request: request.payload)
    assert asker.request(key, b"1", kind="change", retry=QUICK) == b"1"
    region.kill()
    assert asker.request(key, b"2", kind="change", retry=QUICK) == b"2"


@pytest.mark.slow
def test_links_come_again_and_nothing_declared_meanwhile_is_lost(routers, client, key):
    """The hub is killed and started again; both sides declare while the routers link up."""
    region, hub = routers
    far, near = client(hub.endpoint), client(region.endpoint)
    for round_ in range(4):
        hub.kill()
        near.serve(f"{key}/{round_}/before", lambda request: request.payload)
        hub.start()
        for n in range(10):
            far.serve(f"{key}/{round_}/far/{n}", lambda request: request.payload)
            near.serve(f"{key}/{round_}/near/{n}", lambda request: request.payload)
            time.sleep(0.05)
        far.request(f"{key}/{round_}/before", b"", kind="tile", retry=QUICK)
        for n in range(10):
            near.request(f"{key}/{round_}/far/{n}", b"", kind="tile", retry=QUICK)
            far.request(f"{key}/{round_}/near/{n}", b"", kind="tile", retry=QUICK)


def test_a_second_router_shortens_what_is_waited_for_a_silent_one():
    one, two = ("tcp/127.0.0.1:7447",), ("tcp/127.0.0.1:7447", "tcp/127.0.0.1:7448")
    assert BusConfig(connect=one).transmit_timeout_ms == 10_000
    assert BusConfig(connect=two).transmit_timeout_ms == FAIL_OVER_MS
    assert BusConfig(connect=two, lease_ms=500).transmit_timeout_ms == 500
    assert BusConfig(connect=one, link="3g").transmit_timeout_ms == 60_000

    def open_timeout_ms(config: BusConfig) -> int:
        return int(zenoh_config(config).get_json("transport/unicast/open_timeout"))

    slow = load_link("3g")
    assert open_timeout_ms(BusConfig(connect=one)) == 10_000
    assert open_timeout_ms(BusConfig(connect=two)) == 1_500
    assert 40 * slow.delay_ms < open_timeout_ms(BusConfig(connect=two, link=slow)) <= 1_500
