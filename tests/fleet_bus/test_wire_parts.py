"""What a connection costs beside its messages, told apart by the meter: its opening, its keep-alives."""

import shutil
import subprocess
import sys
import time

import pytest
from bus_testing import REPOSITORY, new_endpoint

from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.ledger import Ledger
from gnd.fleet_bus.ledger_file import read_ledger
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.traffic import agent_traffic
from gnd.fleet_bus.wire import WireBytes

QUIET = LinkProfile("quiet", lease_ms=1000, keep_alives=4)
KEEP_ALIVE_BYTES = 52 + 3


def rows(ledger: Ledger, path) -> dict[tuple[str, str], int]:
    ledger.write_jsonl(path)
    report = agent_traffic(read_ledger(path), ())
    assert report.up_wire_bytes == ledger.wire.up
    assert report.down_wire_bytes == ledger.wire.down
    assert report.estimated_wire_bytes == 0
    return {(line.kind, line.direction): line.wire_bytes for line in report.lines}


def test_a_silent_session_is_opening_keep_alives_and_acks(tmp_path):
    """4 keep-alives a second up, 2 down; nothing remains unexplained but opening and closing."""
    at, ledger = new_endpoint(), Ledger("a")
    with open_bus(BusConfig(mode="router", listen=(at,), lease_ms=1000)):
        with open_bus(BusConfig(connect=(at,), link=QUIET), ledger) as bus:
            first = bus.wire()
            stop_s = time.monotonic() + 3.0
            while time.monotonic() < stop_s:
                time.sleep(0.05)
                bus.wire()
            last = bus.wire()
        found = rows(ledger, tmp_path / "a.jsonl")
    assert 10 <= (last.up_alive - first.up_alive) / KEEP_ALIVE_BYTES <= 13
    assert 5 <= (last.down_alive - first.down_alive) / KEEP_ALIVE_BYTES <= 7
    assert last.up_alive % KEEP_ALIVE_BYTES == last.down_alive % KEEP_ALIVE_BYTES == 0
    assert 250 < found["opening", "up"] < 500
    assert 50 < found["closing", "up"] < 400
    assert found["keep-alives", "up"] >= last.up_alive
    # On a busy machine a reading may have come too late for a keep-alive or two.
    assert found.get(("session", "up"), 0) <= 2 * KEEP_ALIVE_BYTES
    assert found.get(("session", "down"), 0) <= 2 * KEEP_ALIVE_BYTES


def test_a_message_is_never_taken_for_a_keep_alive(router, client, key, tmp_path):
    ledger = Ledger("a")
    bus = client(router, ledger=ledger)
    before = bus.wire()
    for _ in range(20):
        bus.publish(key, b"", kind="control")  # as short as a message can be
        time.sleep(0.01)
        bus.wire()
    assert bus.wire().up_alive == before.up_alive
    bus.close()
    assert rows(ledger, tmp_path / "a.jsonl")["control", "up"] >= 20 * len(key)


def test_readings_that_come_too_seldom_find_fewer_keep_alives_never_more(router, client, key):
    """A keep-alive and a message between two readings: neither can be told, so nothing is said."""
    bus = client(router, link=LinkProfile("quiet", lease_ms=400, keep_alives=4))
    before = bus.wire()
    time.sleep(0.5)
    bus.publish(key, bytes(10), kind="control")
    time.sleep(0.05)
    after = bus.wire()
    assert after.up - before.up > 3 * KEEP_ALIVE_BYTES
    assert after.up_alive == before.up_alive


def test_parts_of_sessions_add_up():
    one, two = WireBytes(up=9, up_opening=2, down_alive=3), WireBytes(up=1, up_opening=5, up_alive=4, down_opening=1)
    assert one + two == WireBytes(up=10, up_opening=7, down_opening=1, up_alive=4, down_alive=3)


DEAD_LINK = """
import subprocess, time
def lo(state):
    subprocess.run(["ip", "link", "set", "lo", state], check=True)
lo("up")
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.links import LinkProfile
from gnd.fleet_bus.router import open_router
at = "tcp/127.0.0.1:7447"
link = LinkProfile("test", lease_ms=2000, keep_alives=2)
with open_router([at]), open_bus(BusConfig(connect=(at,), link=link)) as bus:
    bus.publish("k", b"1", kind="control")
    time.sleep(0.5)
    lo("down")
    begin_s = time.monotonic()
    while bus.is_connected():
        assert time.monotonic() - begin_s < 8.0, "a dead link was not noticed"
        time.sleep(0.05)
    lo("up")
    assert bus.wait_connected(15.0), "the lease of its old session is over, so the router takes it again"
    while bus.connections < 2 and time.monotonic() - begin_s < 30.0:  # zenoh tells of the link after the session
        time.sleep(0.05)
    print(bus.connections)
"""


@pytest.mark.slow
def test_a_dead_link_is_noticed_by_what_is_not_acknowledged_long_before_the_routers_lease():
    """In a network of its own, whose interface goes down without a word."""
    unshare = shutil.which("unshare")
    command = [unshare or "unshare", "--map-root-user", "--net"]
    if unshare is None or subprocess.run([*command, "true"], capture_output=True, check=False).returncode:
        pytest.skip("this system does not allow a network namespace")
    done = subprocess.run(
        [*command, sys.executable, "-c", DEAD_LINK],
        capture_output=True,
        text=True,
        cwd=REPOSITORY,
        env={"PYTHONPATH": str(REPOSITORY / "src"), "PATH": "/usr/sbin:/usr/bin:/sbin:/bin"},
        timeout=60,
        check=False,
    )
    assert done.returncode == 0, done.stderr
    assert int(done.stdout) == 2
