"""Two linked routers, of which one is lost: how long a vehicle that knows both gets no answer.

A region's router is linked with a hub. The vehicle connects to the region's router first and to the hub second; it asks
again and again what is served at the hub. Each part is a process. First the region's router is killed (`kill -9`), then
its host goes silent, then the link between the routers does for a while; for these two, each part has a network
namespace of its own (root, iproute2).
"""

import os
import shutil
import statistics
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Final

from gnd.deploy.lab.namespaces import add_namespace, remove_namespace, run_tool
from gnd.deploy.ports import claim_port
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import PLAIN_VARIABLE, BusConfig
from studies.frame.measure import Figure
from studies.frame.options import check, option

KEY: Final = "gnd/v1/lab/asked"
ASK_EVERY_S: Final = 0.01
DEADLINE_S: Final = 120.0
_SWITCH: Final = "gndloss-sw"
_HUB, _REGION, _VEHICLE = "gndloss-hub", "gndloss-reg", "gndloss-veh"
Process = subprocess.Popen[str]


@dataclass(frozen=True, slots=True)
class RouterLossOptions:
    """How much is measured."""

    kills: int = option(5, "How often the router is killed, and its host goes silent.", span=(1, 600))
    apart_s: int = option(10, "How long the routers are apart, s.", span=(1, 600))
    link: str = option("none", "Link profile whose times the vehicle's session has; nothing is paced.")

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = RouterLossOptions


@dataclass(frozen=True, slots=True)
class RouterHosts:
    """Where the parts run: in namespaces, or all on this machine's loopback."""

    apart: bool
    vehicle: str = _VEHICLE
    ports: tuple[int, int] = field(default_factory=lambda: (claim_port(0), claim_port(0)))

    def at(self, name: str) -> str:
        """The endpoint of a router."""
        number = (_HUB, _REGION).index(name)
        return f"tcp/{f'10.99.7.{number + 1}' if self.apart else '127.0.0.1'}:{self.ports[number]}"

    def start(self, home: str, *words: str, is_read: bool = False) -> Process:
        """A process of this program at home; whether somebody reads what it prints."""
        prefix = ["ip", "netns", "exec", home] if self.apart else []
        environment = os.environ | {PLAIN_VARIABLE: "1"}
        out = subprocess.PIPE if is_read else subprocess.DEVNULL
        return subprocess.Popen(  # noqa: S603  (words of our own, no shell)
            [*prefix, sys.executable, "-m", *words], env=environment, stdout=out, text=True
        )


class AskingVehicle:
    """A process that asks without end; keeps the longest time between two answers."""

    def __init__(self, process: Process) -> None:
        self._process = process
        self._last_s, self._longest_s = 0.0, 0.0
        threading.Thread(target=self._read, daemon=True).start()

    def _read(self) -> None:
        assert self._process.stdout is not None
        with self._process.stdout as lines:
            for line in lines:
                answered_s = float(line)
                self._longest_s = max(self._longest_s, answered_s - (self._last_s or answered_s))
                self._last_s = answered_s

    def longest_s(self, during: Callable[[], object]) -> float:
        """The longest time without an answer from when something happens until answers come again, s."""
        self._wait_for_answers()
        self._longest_s = 0.0
        during()
        time.sleep(1.0)
        self._wait_for_answers()
        return self._longest_s

    def _wait_for_answers(self) -> None:
        begin_s = time.monotonic()
        while self._last_s < begin_s + 0.5:
            if time.monotonic() > begin_s + DEADLINE_S:
                raise TimeoutError(f"no answer within {DEADLINE_S:g} s")
            time.sleep(0.01)


def run(chosen: RouterLossOptions | None = None) -> list[Figure]:
    """Lose the region's router in each way."""
    options = chosen or RouterLossOptions()
    figures = [_figure("region's router killed (kill -9): longest time without an answer", _killed(options))]
    if os.geteuid() == 0 and shutil.which("ip") is not None:
        with _namespaces():
            figures.append(_figure("region's host silent: longest time without an answer", _silent(options)))
            figures.append(_apart(options))
    return figures


def _figure(name: str, found_s: list[float]) -> Figure:
    return Figure(name, max(found_s), "s", f"the longest of {len(found_s)}; median {statistics.median(found_s):.2g} s")


def _killed(options: RouterLossOptions) -> list[float]:
    found_s = []
    for _ in range(options.kills):
        with _parts(RouterHosts(apart=False), options, _REGION, _HUB) as (vehicle, region):
            found_s.append(vehicle.longest_s(lambda: _end(region)))
    return found_s


def _silent(options: RouterLossOptions) -> list[float]:
    found_s = []
    for _ in range(options.kills):
        with _parts(RouterHosts(apart=True), options, _REGION, _HUB) as (vehicle, _):
            found_s.append(vehicle.longest_s(lambda: _set_link(up=False)))
        _set_link(up=True)
    return found_s


def _apart(options: RouterLossOptions) -> Figure:
    def interrupt() -> None:
        _set_link(up=False)
        time.sleep(options.apart_s)
        _set_link(up=True)

    with _parts(RouterHosts(apart=True, vehicle=_REGION), options, _REGION) as (vehicle, _):
        after_s = vehicle.longest_s(interrupt) - options.apart_s
    detail = f"link down for {options.apart_s} s; the vehicle knows the region's router alone"
    return Figure("routers apart: time until answers come again after the link is back", after_s, "s", detail)


@contextmanager
def _parts(hosts: RouterHosts, options: RouterLossOptions, *routers: str) -> Iterator[tuple[AskingVehicle, Process]]:
    """Hub, region, what is served at the hub, and a vehicle of these routers; with the process of the region's."""
    router = ("gnd.deploy.cli", "router", "--listen")
    with ExitStack() as stack:

        def start(home: str, *words: str, is_read: bool = False) -> Process:
            process = hosts.start(home, *words, is_read=is_read)
            stack.callback(_end, process)
            return process

        start(_HUB, *router, hosts.at(_HUB))
        region = start(_REGION, *router, hosts.at(_REGION), "--connect", hosts.at(_HUB))
        start(_HUB, "studies.router_loss", "serve", "none", hosts.at(_HUB))
        asking = start(hosts.vehicle, "studies.router_loss", "ask", options.link, *map(hosts.at, routers), is_read=True)
        yield AskingVehicle(asking), region


def _end(process: Process) -> None:
    process.kill()
    process.wait()


@contextmanager
def _namespaces() -> Iterator[None]:
    """Hub, region and vehicle, each with an interface at one switch."""
    with ExitStack() as stack:
        for name in (_SWITCH, _HUB, _REGION, _VEHICLE):
            add_namespace(name)
            stack.callback(remove_namespace, name)
        run_tool("ip", "-n", _SWITCH, "link", "add", "br0", "type", "bridge")
        run_tool("ip", "-n", _SWITCH, "link", "set", "br0", "up")
        for number, name in enumerate((_HUB, _REGION, _VEHICLE), 1):
            run_tool("ip", "link", "add", name, "netns", _SWITCH, "type", "veth", "peer", "name", "eth0", "netns", name)
            run_tool("ip", "-n", _SWITCH, "link", "set", name, "master", "br0", "up")
            run_tool("ip", "-n", name, "addr", "add", f"10.99.7.{number}/24", "dev", "eth0")
            run_tool("ip", "-n", name, "link", "set", "eth0", "up")
        yield


def _set_link(*, up: bool) -> None:
    """Takes the region's host off the switch, or back: packets vanish, and nobody is told."""
    run_tool("ip", "-n", _SWITCH, "link", "set", _REGION, "up" if up else "down")


def _part(role: str, link: str, *routers: str) -> None:
    """A process: serves without end, or asks and prints when it was answered, s of the machine's monotonic clock."""
    with open_bus(BusConfig(connect=routers, link=link, open_timeout_s=DEADLINE_S), name=role) as bus:
        if role == "serve":
            bus.serve(KEY, lambda _request: b"answer")
            threading.Event().wait()
        while True:
            bus.request(KEY, b"", kind="tile", timeout_s=DEADLINE_S)
            print(time.monotonic(), flush=True)
            time.sleep(ASK_EVERY_S)


if __name__ == "__main__":
    _part(*sys.argv[1:])
