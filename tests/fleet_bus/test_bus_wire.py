"""Bytes on the wire, read from the kernel."""

import shutil
import subprocess
import sys

import pytest
from bus_testing import REPOSITORY, RouterProcess, wait_for

from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.wire import WireBytes, WireMeter


def test_wire_bytes_are_payload_and_overhead(router, client, key):
    server, bus = client(router), client(router)
    server.serve(key, lambda _request: bytes(300_000))
    bus.request(key, bytes(100_000), kind="tile")
    before = bus.wire()
    bus.request(key, bytes(100_000), kind="tile")
    after = bus.wire()
    assert 100_000 < after.up - before.up < 115_000
    assert 300_000 < after.down - before.down < 330_000
    assert after.connections == 1


def test_wire_bytes_add_up_over_a_restart_of_the_router(router_process: RouterProcess, client, key):
    bus = client(router_process.endpoint)
    for _ in range(3):
        bus.publish(key, bytes(100), kind="update")
    bus.subscribe(key, lambda _key, _payload: None)
    first = bus.wire()
    router_process.kill()
    wait_for(lambda: not bus.is_connected(), "the loss of the router")
    wait_for(lambda: bus.wire().connections == 1, "the reading of the dead connection")
    lost = bus.wire()
    assert lost.up >= first.up > 0
    router_process.start()
    wait_for(lambda: bus.wire().connections == 2, "the second connection")
    again = bus.wire()
    assert again.up > lost.up
    assert again.down > lost.down


def test_a_closed_bus_keeps_its_total_and_tells_its_ledger(router, client, key):
    ledger = Ledger("a")
    bus = client(router, ledger=ledger)
    bus.publish(key, bytes(10), kind="update")
    open_total = bus.wire()
    bus.close()
    assert bus.wire().up >= open_total.up > 0
    assert ledger.wire == bus.wire()


def test_a_connection_that_is_not_ours_counts_nothing():
    meter = WireMeter()
    meter.attach("tcp/127.0.0.1:1", "tcp/[::1]:2")
    meter.detach("tcp/127.0.0.1:1", "tcp/[::1]:2")
    assert meter.read() == WireBytes()


AGAINST_THE_INTERFACE = """
import pathlib, subprocess, sys
subprocess.run(["ip", "link", "set", "lo", "up"], check=True)
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.router import open_router

def interface():
    line = next(l for l in pathlib.Path("/proc/net/dev").read_text().splitlines() if l.strip().startswith("lo:"))
    numbers = line.split(":")[1].split()
    return int(numbers[0]), int(numbers[1])

at = "tcp/127.0.0.1:7447"
config = BusConfig(connect=(at,))
with open_router([at]), open_bus(config) as server, open_bus(config) as bus:
    def wire():
        return bus.wire() + server.wire()

    server.serve("k", lambda request: bytes(200_000))
    bus.request("k", bytes(50_000), kind="tile")
    interface_before, wire_before = interface(), wire()
    for _ in range(20):
        bus.request("k", bytes(50_000), kind="tile")
    interface_after, wire_after = interface(), wire()
    packets = interface_after[1] - interface_before[1]
    seen = interface_after[0] - interface_before[0] - 14 * packets  # 14: the Ethernet header of each packet
    counted = wire_after.up + wire_after.down - wire_before.up - wire_before.down
    print(seen, counted)
"""


def test_wire_bytes_agree_with_the_counters_of_the_interface():
    """In a network of its own, in which nobody else sends."""
    unshare = shutil.which("unshare")
    command = [unshare or "unshare", "--map-root-user", "--net"]
    if unshare is None or subprocess.run([*command, "true"], capture_output=True, check=False).returncode:
        pytest.skip("this system does not allow a network namespace")
    done = subprocess.run(
        [*command, sys.executable, "-c", AGAINST_THE_INTERFACE],
        capture_output=True,
        text=True,
        cwd=REPOSITORY,
        env={"PYTHONPATH": str(REPOSITORY / "src"), "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"},
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    seen, counted = map(int, done.stdout.split())
    assert seen > 2 * 20 * 250_000, "both connections carry everything"
    # A late acknowledgement may fall on either side of the readings.
    assert counted == pytest.approx(seen, rel=0.002)
