"""A link that stalls: nothing is lost and the session survives."""

import json
import socket
import threading
import time

import pytest
import zenoh
from bus_testing import Inbox, wait_for

from gnd.fleet_bus.config import BusConfig, zenoh_config
from gnd.fleet_bus.errors import BusClosed, RequestFailed
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.requesting import RetryPolicy

CELLULAR = LinkProfile("buffers of 3g, no pacing", batch_bytes=8192, send_buffer_bytes=16_384)
STALL_S = 6.5  # zenoh's default gives a session up after 5 s of a full queue


class Relay:
    """Forwards TCP connections to a port; while `open` is cleared, nothing passes from the client."""

    def __init__(self, port: int) -> None:
        self._port = port
        self._listener = socket.create_server(("127.0.0.1", 0))
        self._sockets: list[socket.socket] = []
        self.connections = 0
        self.open = threading.Event()
        self.open.set()
        self.endpoint = f"tcp/127.0.0.1:{self._listener.getsockname()[1]}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._listener.accept()
            except OSError:
                return
            self.connections += 1
            near.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 16_384)
            far = socket.create_connection(("127.0.0.1", self._port))
            self._sockets += [near, far]
            threading.Thread(target=self._pump, args=(near, far, self.open), daemon=True).start()
            threading.Thread(target=self._pump, args=(far, near, None), daemon=True).start()

    def _pump(self, source: socket.socket, sink: socket.socket, gate: threading.Event | None) -> None:
        try:
            while data := source.recv(4096):
                if gate is not None:
                    gate.wait(60)
                sink.sendall(data)
        except OSError:
            pass

    def close(self) -> None:
        self._listener.close()
        for end in self._sockets:
            end.close()


@pytest.fixture
def relay(router):
    forwarding = Relay(int(router.rpartition(":")[2]))
    yield forwarding
    forwarding.close()


@pytest.mark.slow
def test_a_stall_longer_than_zenohs_patience_loses_nothing(router, client, relay, key):
    receiver = client(router)
    inbox = Inbox()
    receiver.subscribe(key, inbox)
    sender = client(relay.endpoint, link=CELLULAR)
    inbox.wait_connected(sender, key)
    relay.open.clear()
    reopening = threading.Timer(STALL_S, relay.open.set)
    reopening.start()
    for number in range(200):  # 2 MB: far more than all buffers on the way
        sender.publish(key, number.to_bytes(2, "little") + bytes(10_000), kind="update")
    wait_for(lambda: len(inbox.items) == 200, "all notices after the stall")
    reopening.join()
    assert [int.from_bytes(payload[:2], "little") for payload in inbox.payloads] == list(range(200))
    assert relay.connections == 1, "the session was given up and opened again"


def test_closing_ends_a_put_that_waits_for_a_stalled_link(router, client, relay, key):
    inbox = Inbox()
    client(router).subscribe(key, inbox)
    sender = client(relay.endpoint, link=CELLULAR)
    inbox.wait_connected(sender, key)
    relay.open.clear()
    sent, outcome = [], []

    def put_for_ever() -> None:
        try:
            while len(sent) < 10_000:
                sender.publish(key, bytes(10_000), kind="update")
                sent.append(time.monotonic())
        except (BusClosed, zenoh.ZError) as error:
            outcome.append(error)

    putting = threading.Thread(target=put_for_ever)
    putting.start()
    wait_for(lambda: sent and time.monotonic() - sent[-1] > 0.3, "full buffers")
    sender.close()
    putting.join(10)
    relay.open.set()
    assert not putting.is_alive()
    assert len(outcome) == 1


def test_a_denied_key_is_no_answer(endpoint, client):
    """zenoh denies in silence: the asker sees an empty reply."""
    rule = {"id": "r", "permission": "deny", "flows": ["ingress"], "messages": ["query"], "key_exprs": ["denied/**"]}
    control = {
        "enabled": True,
        "default_permission": "allow",
        "rules": [rule],
        "subjects": [{"id": "all"}],
        "policies": [{"rules": ["r"], "subjects": ["all"]}],
    }
    settings = zenoh_config(BusConfig(mode="router", connect=(), listen=(endpoint,)))
    settings.insert_json5("access_control", json.dumps(control))
    with zenoh.open(settings):
        server, bus = client(endpoint), client(endpoint)
        server.serve("**", lambda _request: b"answer")
        retry = RetryPolicy(attempt_timeout_s=0.5)
        assert bus.request("allowed/key", b"", kind="tile", retry=retry) == b"answer"
        with pytest.raises(RequestFailed, match="empty reply"):
            bus.request("denied/key", b"", kind="tile", retry=retry, timeout_s=0.5)
