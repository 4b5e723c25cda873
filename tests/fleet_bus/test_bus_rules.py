"""Settings whose breach loses data or hides traffic: each is read back, and where it can be, seen at work."""

import json
import os
import socket
import threading
from pathlib import Path

import psutil
import pytest
import zenoh
from bus_testing import Inbox, RouterProcess, sockets_to, wait_for

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import MAX_MESSAGE_BYTES, ROUTER_LEASE_MS, BusConfig, assert_rules, zenoh_config
from gnd.fleet_bus.errors import BusClosed, BusConfigError, MessageTooLarge, NoRouter
from gnd.fleet_bus.router import open_router


def setting(config: BusConfig, key: str):
    return json.loads(zenoh_config(config).get_json(key))


@pytest.mark.parametrize("mode", ["client", "router"])
def test_shared_memory_and_scouting_are_off_in_every_mode(mode):
    config = BusConfig(mode=mode, connect=("tcp/127.0.0.1:1",))
    assert setting(config, "mode") == mode
    assert setting(config, "transport/shared_memory/enabled") is False
    assert setting(config, "scouting/multicast/enabled") is False
    assert setting(config, "scouting/gossip/enabled") is False
    assert setting(config, "transport/unicast/lowlatency") is False


def test_a_client_waits_for_its_own_link_and_a_router_for_nobody():
    control = "transport/link/tx/queue/congestion_control"
    waits = ("block/wait_before_close", "drop/wait_before_drop", "drop/max_wait_before_drop_fragments")

    def waits_us(config: BusConfig) -> list[int]:
        return [setting(config, f"{control}/{wait}") for wait in waits]

    assert waits_us(BusConfig()) == [60_000_000] * 3
    router = BusConfig(mode="router", listen=("tcp/127.0.0.1:1",))
    assert waits_us(router) == [500_000, 5_000, 5_000]
    assert {rule["id"]: rule["overwrite"]["congestion_control"] for rule in setting(router, "qos/network")} == {
        "notices": "drop",
        "reads": "drop",
    }
    assert setting(BusConfig(), "qos/network") == []


def test_a_router_receives_in_many_threads(router_process: RouterProcess, client):
    """A thread that forwards to a full queue waits."""
    client(router_process.endpoint).wait_connected(5)
    tasks = Path(f"/proc/{router_process.pid}/task")
    wait_for(lambda: sum((task / "comm").read_text().startswith("rx-") for task in tasks.iterdir()) == 16, "threads")


def test_a_broken_rule_is_an_error_that_names_it():
    config = BusConfig()
    settings = zenoh_config(config)
    settings.insert_json5("transport/shared_memory/enabled", "true")
    with pytest.raises(BusConfigError, match="transport/shared_memory/enabled must be False, but is True"):
        assert_rules(settings, config)


def test_the_default_of_zenoh_breaks_the_rules():
    """Otherwise the rules would test nothing."""
    with pytest.raises(BusConfigError):
        assert_rules(zenoh.Config(), BusConfig())


def test_large_messages_do_not_bypass_the_socket(router, client, key):
    """With shared memory a local payload above 3 kB would not be seen on the wire."""
    sender, receiver = client(router), client(router)
    inbox = Inbox()
    receiver.subscribe(key, inbox)
    inbox.wait_connected(sender, key)
    before = sender.wire().up, receiver.wire().down
    for _ in range(5):
        sender.publish(key, bytes(200_000), kind="update")
    wait_for(lambda: len(inbox.items) == 5, "five messages")
    assert sender.wire().up - before[0] > 1_000_000
    assert receiver.wire().down - before[1] > 1_000_000


def test_opening_a_session_opens_no_udp_socket(router, client):
    before = len(psutil.Process().net_connections("udp"))
    client(router)
    assert len(psutil.Process().net_connections("udp")) == before


def test_a_client_listens_nowhere(router, client):
    def listening() -> int:
        return sum(c.status == psutil.CONN_LISTEN for c in psutil.Process().net_connections("tcp"))

    before = listening()
    client(router)
    assert listening() == before


@pytest.mark.parametrize(("link", "batch", "send_buffer"), [("3g", 8192, 16_384), ("4g", 16_384, 65_536)])
def test_cellular_profiles_shrink_batches_and_the_send_buffer(endpoint, client, link, batch, send_buffer):
    with open_router([endpoint]):
        before = set(sockets_to(port_of(endpoint)))
        client(endpoint, link=link)
        config = BusConfig(connect=(endpoint,), link=link)
        assert setting(config, "transport/link/tx/batch_size") == batch
        assert setting(config, "transport/link/tcp/so_sndbuf") == send_buffer
        assert setting(config, "transport/link/tx/lease") >= 20_000
        # Linux doubles the value for its own bookkeeping: socket(7).
        assert send_buffer * 2 in {send_buffer_of(fd) for fd in set(sockets_to(port_of(endpoint))) - before}


def test_5g_keeps_full_batches_with_a_wider_buffer():
    config = BusConfig(link="5g")
    assert setting(config, "transport/link/tx/batch_size") == 65_535
    assert setting(config, "transport/link/tcp/so_sndbuf") == 262_144


def port_of(endpoint: str) -> int:
    return int(endpoint.rpartition(":")[2])


def send_buffer_of(descriptor: int) -> int:
    with socket.socket(fileno=os.dup(descriptor)) as duplicate:
        return duplicate.getsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF)


def test_the_lease_can_be_set_and_otherwise_follows_the_link():
    assert setting(BusConfig(lease_ms=1500), "transport/link/tx/lease") == 1500
    assert setting(BusConfig(link="4g"), "transport/link/tx/lease") == 60_000
    assert setting(BusConfig(), "transport/link/tx/lease") == 10_000
    assert setting(BusConfig(mode="router"), "transport/link/tx/lease") == ROUTER_LEASE_MS
    assert setting(BusConfig(mode="router", lease_ms=1500), "transport/link/tx/lease") == 1500


def test_keep_alives_follow_the_link():
    assert setting(BusConfig(link="4g"), "transport/link/tx/keep_alive") == 2
    assert setting(BusConfig(), "transport/link/tx/keep_alive") == 4


def test_a_router_takes_more_sessions_than_zenoh_by_default():
    assert setting(BusConfig(mode="router"), "transport/unicast/max_sessions") == 10_000


def test_max_sessions_is_the_limit_of_a_router(endpoint, client, monkeypatch):
    """The setting that we raise is the one that refuses vehicles."""
    monkeypatch.setattr("gnd.fleet_bus.config.MAX_SESSIONS", 2)
    with open_bus(BusConfig(mode="router", connect=(), listen=(endpoint,))):
        client(endpoint), client(endpoint)
        with pytest.raises(NoRouter):
            open_bus(BusConfig(connect=(endpoint,), open_timeout_s=0.2))


def test_too_large_a_message_is_refused_before_it_is_sent(router, client, key):
    bus, too_large = client(router), bytes(MAX_MESSAGE_BYTES + 1)
    with pytest.raises(MessageTooLarge, match="a change message has 16777217 bytes, the limit is 16777216"):
        bus.request(key, too_large, kind="change")
    with pytest.raises(MessageTooLarge):
        bus.publish(key, too_large, kind="update")


def test_a_receiver_drops_what_exceeds_its_limit_and_lives_on(router, client, key, monkeypatch):
    sender = client(router)
    monkeypatch.setattr("gnd.fleet_bus.config.MAX_MESSAGE_BYTES", 100_000)
    receiver = client(router)
    inbox = Inbox()
    receiver.subscribe(key, inbox)
    inbox.wait_connected(sender, key)
    sender.publish(key, bytes(1_000_000), kind="update")
    sender.publish(key, bytes(10), kind="update")
    wait_for(lambda: inbox.items, "the small message")
    assert inbox.payloads == [bytes(10)]


def test_a_bus_of_the_parent_is_refused_after_a_fork(router, client, key):
    """zenoh's threads do not exist in the child: a call would wait for ever."""
    bus = client(router)
    child = os.fork()
    if child == 0:
        try:
            bus.request(key, b"", kind="control")
        except BusClosed as error:
            os._exit(0 if "after the fork" in str(error) else 1)
        os._exit(2)
    assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"connect": ()}, "at least one endpoint"),
        ({"connect": ("127.0.0.1:7447",)}, "is not like tcp/127.0.0.1:7447"),
        ({"connect": ("tcp/127.0.0.1:70000",)}, "is not like"),
        ({"listen": ("tcp/127.0.0.1:7447",)}, "a client does not listen"),
        ({"mode": "peer"}, "mode must be client or router"),
        ({"lease_ms": 50}, "lease_ms must be 100 or more"),
    ],
)
def test_unusable_settings_are_refused(settings, words):
    with pytest.raises(BusConfigError, match=words):
        BusConfig(**settings)


def test_calls_from_many_threads_share_one_session(router, client, key):
    server, bus = client(router), client(router)
    server.serve(f"{key}/**", lambda request: request.payload[::-1], workers=4)
    answers: dict[int, bytes] = {}

    def ask(number: int) -> None:
        answers[number] = bus.request(f"{key}/{number}", f"{number:04}".encode(), kind="tile")

    threads = [threading.Thread(target=ask, args=(number,)) for number in range(16)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join(10)
    assert answers == {number: f"{number:04}".encode()[::-1] for number in range(16)}
