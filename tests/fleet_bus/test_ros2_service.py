"""Services as rmw_zenoh's clients ask them, over a real router."""

import itertools
import threading
import time

import pytest
import zenoh

from gnd.fleet_bus import ros2_service
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusConfigError, Refused
from gnd.fleet_bus.ros2 import NO_HASH, RosNode, RosTopic, endpoint_of_token
from gnd.fleet_bus.ros2_attachments import RosAttachment

HASH = "RIHS01_e118de6bf5eeb66a2491b5bda11202e7b68f198d6f67922cf30364858239c81a"
ADD = RosTopic("/add_two_ints", "example_interfaces/srv/AddTwoInts", HASH)
GID = bytes(range(16))
# Of the server and the client of ROS 2's demos, as rmw_zenoh's docs/design.md shows them.
KEY = f"2/add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{HASH}"
TOKEN = (
    "@ros2_lv/2/f9980ee0495eaafb3e38f0d19e2eae12/0/10/{kind}/%/%/{node}/"
    f"%add_two_ints/example_interfaces::srv::dds_::AddTwoInts_/{HASH}/::,10:,:,:,,"
)
_DOMAINS = itertools.count(20)


def ask(bus: Bus, key: str, payload: bytes, sequence: int = 1, timeout_s: float = 10.0) -> list[zenoh.Reply]:
    with bus.connection.sending() as session:
        replies = session.get(
            key,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            payload=payload,
            attachment=RosAttachment(sequence, 5, GID).encode(),
            timeout=timeout_s,
        )
        return list(replies)


def first(bus: Bus, key: str, payload: bytes) -> zenoh.Reply:
    """The answer, once the router knows the service."""
    until_s = time.monotonic() + 10.0
    while time.monotonic() < until_s:
        if replies := ask(bus, key, payload):
            return replies[0]
    raise AssertionError("no answer")


@pytest.fixture
def domain() -> int:
    return next(_DOMAINS)


def test_key_and_tokens_are_those_of_rmw_zenoh() -> None:
    assert ADD.key(2) == KEY
    for kind, name in (("SS", "add_two_ints_server"), ("SC", "add_two_ints_client")):
        found = endpoint_of_token(TOKEN.format(kind=kind, node=name))
        assert found is not None
        assert (found.kind, found.node, found.topic) == (kind, f"/{name}", ADD)


def test_a_request_is_answered_and_the_graph_shows_the_server(router: str, domain: int) -> None:
    with (
        RosNode(open_bus(BusConfig(connect=(router,))), domain, "server") as node,
        open_bus(BusConfig(connect=(router,))) as client,
    ):
        service = node.serve(ADD, lambda request: request[::-1])
        reply = first(client, ADD.key(domain), b"abc").ok
        assert reply is not None
        assert (str(reply.key_expr), reply.payload.to_bytes()) == (ADD.key(domain), b"cba")
        assert reply.attachment is not None
        beside = RosAttachment.decode(reply.attachment.to_bytes())
        assert beside is not None
        assert (beside.sequence, beside.gid) == (1, GID)
        assert abs(beside.sent_ns - time.time_ns()) < 60e9
        humble = RosTopic(ADD.name, ADD.type_name, NO_HASH).key(domain)
        (other,) = ask(client, humble, b"x", 2)
        assert other.ok is not None
        assert str(other.ok.key_expr) == humble
        assert (service.answered, service.refused) == (2, 0)
        assert [(one.kind, one.node, one.topic) for one in node.endpoints()] == [("SS", "/server", ADD)]
        service.close()
        assert ask(client, ADD.key(domain), b"abc", 3, timeout_s=1.0) == []


def test_a_handler_that_fails_ends_nothing(router: str, domain: int) -> None:
    def handler(request: bytes) -> bytes:
        if request == b"refuse":
            raise Refused("not so")
        return bytes([100 // request[0]])

    with (
        RosNode(open_bus(BusConfig(connect=(router,))), domain, "server") as node,
        open_bus(BusConfig(connect=(router,))) as client,
    ):
        service = node.serve(ADD, handler)
        assert first(client, ADD.key(domain), b"\x02").ok is not None
        for request, why in ((b"refuse", "not so"), (b"\0", "ZeroDivisionError"), (b"", "IndexError")):
            (reply,) = ask(client, ADD.key(domain), request)
            assert reply.err is not None
            assert why in reply.err.payload.to_string()
        assert first(client, ADD.key(domain), b"\x05").ok is not None
        assert (service.answered, service.refused) == (2, 3)


def test_more_requests_than_may_wait_are_told_so(router: str, domain: int, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ros2_service, "REQUESTS_WAITING", 1)
    go_on, answers = threading.Event(), []
    with (
        RosNode(open_bus(BusConfig(connect=(router,))), domain, "server") as node,
        open_bus(BusConfig(connect=(router,))) as client,
    ):
        node.serve(ADD, lambda request: b"" if request == b"first" else (go_on.wait(20.0), b"done")[1])
        assert first(client, ADD.key(domain), b"first").ok is not None
        threads = [
            threading.Thread(target=lambda: answers.extend(ask(client, ADD.key(domain), b"slow"))) for _ in range(8)
        ]
        for thread in threads:
            thread.start()
        until_s = time.monotonic() + 10.0
        while len(answers) < 5 and time.monotonic() < until_s:  # two in hand, one waits
            time.sleep(0.02)
        go_on.set()
        for thread in threads:
            thread.join()
    told = [one.err.payload.to_string() for one in answers if one.err is not None]
    assert len(told) == 5
    assert set(told) == {"busy: 1 requests are waiting"}
    assert [one.ok.payload.to_bytes() for one in answers if one.ok is not None] == [b"done"] * 3


def test_a_service_without_the_hash_of_its_type_is_refused(router: str, domain: int) -> None:
    with (
        RosNode(open_bus(BusConfig(connect=(router,))), domain, "server") as node,
        pytest.raises(BusConfigError, match="needs the hash"),
    ):
        node.serve(RosTopic(ADD.name, ADD.type_name), lambda request: request)
