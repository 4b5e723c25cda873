"""The link between two routers goes silent, in network namespaces: nobody is told, and packets vanish."""

import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager

import pytest
from lab_testing import needs_root, own_name, wait_until

from gnd.deploy.lab.namespaces import add_namespace, remove_namespace, run_tool
from gnd.fleet_bus.config import PLAIN_VARIABLE

pytestmark = [needs_root, pytest.mark.slow, pytest.mark.xdist_group("hosts")]
APART_S = 8.0
HUB, REGION = "10.98.6.1", "10.98.6.2"

SERVER = """
import sys, time
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
with open_bus(BusConfig(connect=(sys.argv[1],)), name="server") as bus:
    bus.serve("gnd/v1/lab/asked", lambda request: request.payload)
    publisher = bus.advanced_publisher("gnd/v1/lab/told", remember=10_000)
    for n in range(10_000):
        publisher.put(str(n).encode())
        time.sleep(0.05)
"""
CLIENT = """
import os, sys
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
def say(word, payload):
    os.write(1, word + b" " + payload + b"\\n")  # at once: two threads write
with open_bus(BusConfig(connect=(sys.argv[1],)), name="client") as bus:
    bus.subscribe("gnd/v1/lab/told", lambda _key, payload: say(b"told", payload), history=True)
    for n in range(10_000):
        assert bus.request("gnd/v1/lab/asked", str(n).encode(), kind="tile", timeout_s=60) == str(n).encode()
        say(b"asked", str(n).encode())
"""
ROUTER = "from gnd.fleet_bus.cli import router; router()"


class Side:
    """A network namespace, and processes in it whose lines are kept with the times at which they came."""

    def __init__(self, name: str) -> None:
        self.name = name
        self._processes: list[subprocess.Popen[str]] = []

    def start(self, code: str, *words: str) -> list[tuple[float, str]]:
        lines: list[tuple[float, str]] = []
        command = ["ip", "netns", "exec", self.name, "env", f"{PLAIN_VARIABLE}=1", sys.executable, "-c", code, *words]
        process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True)
        self._processes.append(process)
        threading.Thread(target=self._read, args=(process, lines), daemon=True).start()
        return lines

    def _read(self, process: "subprocess.Popen[str]", lines: list[tuple[float, str]]) -> None:
        assert process.stdout is not None
        with process.stdout:
            for line in process.stdout:
                lines.append((time.monotonic(), line.strip()))  # noqa: PERF401  (others read meanwhile)

    def close(self) -> None:
        for process in self._processes:
            process.kill()
            process.wait()
        remove_namespace(self.name)


@contextmanager
def two_sides() -> Iterator[tuple[Side, Side]]:
    """Hub and region, with a cable between them."""
    lab = own_name()[:8]
    with ExitStack() as stack:
        sides = []
        for name in (f"{lab}-hub", f"{lab}-reg"):
            add_namespace(name)
            sides.append(Side(name))
            stack.callback(sides[-1].close)
        hub, region = sides
        cable = ("ip", "link", "add", "cable", "netns", hub.name, "type", "veth")
        run_tool(*cable, "peer", "name", "cable", "netns", region.name)
        for side, address in ((hub, HUB), (region, REGION)):
            run_tool("ip", "-n", side.name, "addr", "add", f"{address}/24", "dev", "cable")
            run_tool("ip", "-n", side.name, "link", "set", "cable", "up")
        yield hub, region


def numbers(lines: list[tuple[float, str]], word: str) -> list[int]:
    return [int(line.split()[1]) for _, line in list(lines) if line.startswith(word)]


def test_a_silent_link_is_ended_and_comes_again_with_everything_that_was_missed() -> None:
    with two_sides() as (hub, region):
        at_hub, at_region = f"tcp/{HUB}:7447", f"tcp/{REGION}:7447"
        hub_says = hub.start(ROUTER, "--listen", at_hub)
        region_says = region.start(ROUTER, "--listen", at_region, "--connect", at_hub)
        client = region.start(CLIENT, at_region)
        wait_until(lambda: bool(region_says), "the region's router listens")
        hub.start(SERVER, at_hub)
        wait_until(lambda: len(numbers(client, "told")) > 20 and len(numbers(client, "asked")) > 20, "all is well")
        run_tool("ip", "-n", hub.name, "link", "set", "cable", "down")
        time.sleep(APART_S)
        for says in (hub_says, region_says):
            wait_until(lambda says=says: any("has ended" in line for _, line in list(says)), "both have noticed")  # type: ignore[misc]
        asked, told = len(numbers(client, "asked")), len(numbers(client, "told"))
        run_tool("ip", "-n", hub.name, "link", "set", "cable", "up")
        wait_until(lambda: len(numbers(client, "asked")) > asked + 20, "answers come again")
        wait_until(lambda: len(numbers(client, "told")) > told + APART_S / 0.05, "what was missed has come")
        heard = numbers(client, "told")
        assert heard == list(range(heard[0], heard[0] + len(heard))), "each once, in order"
        answered = numbers(client, "asked")
        assert answered == list(range(len(answered)))
