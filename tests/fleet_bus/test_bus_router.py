"""Routers come and go; sessions find them again and end cleanly."""

import signal
import socket
import threading

import pytest
from bus_testing import RouterProcess, new_endpoint, script, wait_for

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import NoRouter, PortInUse, RequestFailed
from gnd.fleet_bus.requesting import RetryPolicy
from gnd.fleet_bus.router import open_router, run_router

QUICK = RetryPolicy(first_wait_s=0.02, longest_wait_s=0.1, attempt_timeout_s=0.5)


def test_without_a_router_the_error_says_what_to_do(endpoint):
    with pytest.raises(NoRouter, match=f"no router at {endpoint} for 0.3 s: start one with `gnd router`"):
        open_bus(BusConfig(connect=(endpoint,), open_timeout_s=0.3))


def test_opening_waits_for_a_router_that_comes_later(endpoint):
    opened = []

    def open_early() -> None:
        with open_bus(BusConfig(connect=(endpoint,))) as bus:
            opened.append(bus.is_connected())

    waiting = threading.Thread(target=open_early)
    waiting.start()
    with open_router([endpoint]):
        waiting.join(10)
    assert opened == [True]


def test_a_port_in_use_is_said_so(router):
    with pytest.raises(PortInUse, match=f"cannot listen at {router}: port in use"):
        open_router([router])


def test_the_command_says_that_the_port_is_in_use(router):
    with script("from gnd.deploy.cli import main; main()", "router", "--listen", router) as command:
        assert command.wait() == 2
        assert len(command.lines) == 1
        assert "port in use" in command.lines[0]


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_the_command_ends_cleanly_on_ctrl_c_and_on_terminate(endpoint, number):
    with script("from gnd.deploy.cli import main; main()", "router", "--listen", endpoint) as command:
        command.wait_line("router listens at")
        with open_bus(BusConfig(connect=(endpoint,))):
            command.signal(number)
            assert command.wait() == 0
    assert command.lines[-1] == "router ended"


def test_run_router_ends_with_its_event(endpoint):
    stop = threading.Event()
    running = threading.Thread(target=run_router, args=((endpoint,),), kwargs={"stop": stop})
    running.start()
    with open_bus(BusConfig(connect=(endpoint,))) as bus:
        stop.set()
        running.join(10)
        assert not running.is_alive()
        wait_for(lambda: not bus.is_connected(), "the end of the router")


def test_requests_survive_kill_and_restart_of_the_router(router_process: RouterProcess, client, key):
    server, bus = client(router_process.endpoint), client(router_process.endpoint)
    server.serve(key, lambda request: b"re: " + request.payload)
    assert bus.request(key, b"1", kind="change", retry=QUICK) == b"re: 1"
    router_process.kill()
    wait_for(lambda: not bus.is_connected(), "the loss of the router")
    answers = []
    asking = threading.Thread(target=lambda: answers.append(bus.request(key, b"2", kind="change", retry=QUICK)))
    asking.start()
    router_process.start()
    asking.join(15)
    assert answers == [b"re: 2"]


def test_without_router_the_failure_says_so(router_process: RouterProcess, client, key):
    bus = client(router_process.endpoint)
    router_process.kill()
    wait_for(lambda: not bus.is_connected(), "the loss of the router")
    with pytest.raises(RequestFailed, match=f"no router at {router_process.endpoint}"):
        bus.request(key, b"", kind="change", retry=QUICK, timeout_s=0.3)


HANGING_ROUTER = """
import sys, threading
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
with open_bus(BusConfig(mode="router", connect=(), listen=(sys.argv[1],), lease_ms=500)):
    print("up", flush=True)
    threading.Event().wait()
"""


def test_a_router_that_hangs_is_given_up_after_its_lease_and_found_again(endpoint, client, key):
    with script(HANGING_ROUTER, endpoint) as hanging:
        hanging.wait_line("up")
        server, bus = client(endpoint, lease_ms=500), client(endpoint, lease_ms=500)
        server.serve(key, lambda _request: b"back")
        assert bus.request(key, b"", kind="tile", retry=QUICK) == b"back"
        hanging.signal(signal.SIGSTOP)
        wait_for(lambda: not bus.is_connected(), "the end of the lease")
        hanging.signal(signal.SIGCONT)
        assert bus.request(key, b"", kind="tile", retry=QUICK) == b"back"


def test_a_port_that_is_no_router_is_given_up_in_time():
    with socket.create_server(("127.0.0.1", 0)) as silent:
        at = f"tcp/127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(NoRouter, match=f"no router at {at}"):
            open_bus(BusConfig(connect=(at,), open_timeout_s=0.3))


def test_a_client_with_two_endpoints_fails_over(router_process: RouterProcess, client, key):
    second = new_endpoint()
    with open_router([second], connect=[router_process.endpoint]):
        server, bus = client(second), client(router_process.endpoint, second)
        server.serve(key, lambda _request: b"still here")
        assert bus.request(key, b"", kind="tile", retry=QUICK) == b"still here"
        router_process.kill()
        assert bus.request(key, b"", kind="tile", retry=QUICK) == b"still here"


def test_two_linked_routers_forward_notices_and_requests(router, client, key):
    second = new_endpoint()
    with open_router([second], connect=[router]):
        here, there = client(router), client(second)
        got = []
        there.subscribe(f"{key}/notice", lambda _key, payload: got.append(payload))
        there.serve(f"{key}/ask", lambda _request: b"from over there")
        assert here.request(f"{key}/ask", b"", kind="tile", retry=QUICK) == b"from over there"
        wait_for(lambda: here.publish(f"{key}/notice", b"n", kind="update") or got, "a notice across two routers")


ENDS = """
import sys
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
bus = open_bus(BusConfig(connect=(sys.argv[1],)))
bus.subscribe("test/**", print)
bus.serve("test/served", lambda request: b"")
bus.watch_alive("test/alive/*", print)
if sys.argv[2] == "closed":
    bus.close()
    bus.close()
print("end of main", flush=True)
"""


@pytest.mark.parametrize("how", ["closed", "forgotten"])
def test_a_process_with_a_subscriber_ends(router, how):
    """zenoh's own callback subscribers at module scope hang the exit."""
    with script(ENDS, router, how) as process:
        process.wait_line("end of main")
        assert process.wait() == 0


INTERRUPTED = """
import sys
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
with open_bus(BusConfig(connect=(sys.argv[1],))) as bus:
    bus.subscribe("test/**", print)
    print("asking", flush=True)
    try:
        bus.request("test/nobody/there", b"", kind="tile", timeout_s=600)
    except KeyboardInterrupt:
        print("interrupted", flush=True)
"""


def test_ctrl_c_ends_a_waiting_request(router):
    with script(INTERRUPTED, router) as process:
        process.wait_line("asking")
        process.signal(signal.SIGINT)
        process.wait_line("interrupted")
        assert process.wait() == 0
