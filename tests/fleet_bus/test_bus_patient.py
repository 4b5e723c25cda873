"""Parts that are started before their router."""

import logging

import pytest
from bus_testing import Inbox, RouterProcess, wait_for

from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusConfigError, NoRouter, RequestFailed


@pytest.fixture
def early(endpoint: str):
    """A bus that was opened while nobody listened."""
    with open_bus(BusConfig(connect=(endpoint,), patient=True), name="early") as bus:
        yield bus


def test_all_that_was_declared_before_is_there_when_the_router_is(early: Bus, endpoint: str, client, caplog):
    caplog.set_level(logging.INFO)
    inbox, router = Inbox(), RouterProcess(endpoint)
    early.subscribe("test/news", inbox)
    early.serve("test/ask", lambda _request: b"answer")
    early.serve("test/closed", lambda _request: b"never").close()
    early.declare_alive("test/alive/early")
    publisher = early.advanced_publisher("test/told")
    assert not early.is_connected()
    wait_for(lambda: f"early: no router at {endpoint}" in caplog.text, "a line in the log")
    router.start()
    try:
        other = client(endpoint)
        assert other.request("test/ask", b"", kind="control") == b"answer"
        inbox.wait_connected(other, "test/news")
        with pytest.raises(RequestFailed):
            other.request("test/closed", b"", kind="control", timeout_s=0.2)
        alive, told = [], Inbox()
        other.watch_alive("test/alive/*", lambda key, _alive: alive.append(key))
        other.subscribe("test/told", told, history=True)
        publisher.put(b"now")
        wait_for(lambda: alive == ["test/alive/early"] and told.payloads == [b"now"], "token and notice")
        assert early.connections == 1
        assert "early: found the router at" in caplog.text
    finally:
        router.close()


def test_requests_wait_for_the_router_and_notices_say_that_there_is_none(early: Bus, endpoint: str):
    with pytest.raises(RequestFailed, match=f"no router at {endpoint}"):
        early.request("test/ask", b"", kind="control", timeout_s=0.1)
    with pytest.raises(NoRouter):
        early.publish("test/news", b"", kind="update", wait_s=0.05)
    with pytest.raises(NoRouter):
        early.advanced_publisher("test/told").put(b"")
    assert early.connections == 0
    assert early.wire().up == 0


def test_closing_ends_the_search(endpoint: str):
    bus = open_bus(BusConfig(connect=(endpoint,), patient=True))
    bus.close()
    assert bus.is_closed


def test_a_router_is_not_patient(endpoint: str):
    with pytest.raises(BusConfigError, match="only a client waits"):
        BusConfig(mode="router", listen=(endpoint,), patient=True)
