"""Clients that are stopped: how long the others wait for notices, tiles and acknowledgements meanwhile.

A router, a tile server, a shard and twenty clients, each a process. Every client follows all tiles and asks for one
again and again; some send reports; some of those that will be stopped ask for the whole map in many threads at once.
A tile of 2,000 voxels changes by half ten times a second.
"""

import itertools
import json
import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterable, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path

import psutil

from gnd.deploy.processes import ProcessSpec
from gnd.deploy.repeating import repeated
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusError
from gnd.fleet_bus.router import wait_for_stop
from gnd.schemas.keys import change_key, tile_key, tiles_key, update_keys
from gnd.schemas.updates import TileUpdate
from studies.frame.measure import Figure
from studies.small_cloud import READY_S, SmallCloud, change_report, small_cloud
from studies.small_cloud import tiles as map_tiles

PUBLISH_EVERY_S = 0.1
ASK_EVERY_S = 0.1
REPORT_EVERY_S = 0.25
SLOW_EVERY_S = 1.0
SLOW_FOR_S = 0.05
GREEDY_THREADS = 4
ASK_S = 120.0


@dataclass(frozen=True, slots=True)
class Plan:
    """How many clients there are and for how long they are watched."""

    clients: int = 20
    stopped: int = 5
    greedy: int = 2  # of those that are stopped: they ask for everything
    slow: int = 1  # of those that are stopped, from the first on: they go on for a moment every now and then
    calm_s: float = 4.0
    stopped_s: float = 15.0
    after_s: float = 4.0


@dataclass(frozen=True, slots=True)
class StalledOutcome:
    """What the healthy clients saw, and what became of the stopped ones.

    Attributes:
        calm, stopped: the longest waits before and while clients are stopped, s, by what was waited for: "gap" (between
            two notices), "notice" (from the commit to the arrival), "tile" and "ack".
        missed: share of the notices that healthy clients did not get while others were stopped.
        dropped_after_s: until the router had closed the connections of all stopped clients, s; None = not at all.
        back: how many of the stopped clients heard notices again when they went on.
    """

    calm: dict[str, float]
    stopped: dict[str, float]
    missed: float
    dropped_after_s: float | None
    back: int


def run() -> list[Figure]:
    """Stop a quarter of the clients for 15 s."""
    plan = Plan()
    outcome = measure(plan)
    who = f"{plan.stopped} of {plan.clients} clients stopped for {plan.stopped_s:g} s ({plan.slow}: nearly)"
    names = {
        "gap": f"longest time between two notices at a healthy client (one every {PUBLISH_EVERY_S:g} s)",
        "notice": "slowest notice, commit to healthy client",
        "tile": "slowest tile query of a healthy client",
        "ack": "slowest acknowledgement of a healthy client",
    }
    figures = [
        Figure(name, outcome.stopped[what], "s", f"{who}; before: {outcome.calm[what]:.3f} s")
        for what, name in names.items()
    ]
    closed_s = float("inf") if outcome.dropped_after_s is None else outcome.dropped_after_s
    return [
        *figures,
        Figure("notices that healthy clients missed meanwhile", 100 * outcome.missed, "%"),
        Figure("until the router had closed all connections that are dead", closed_s, "s"),
        Figure("stopped clients that hear notices again", outcome.back, f"of {plan.stopped}"),
    ]


def measure(plan: Plan) -> StalledOutcome:
    """Run the cloud and the clients, stop some, and let them go on."""
    with tempfile.TemporaryDirectory() as name, ExitStack() as stack:
        folder = Path(name)
        cloud = stack.enter_context(small_cloud(folder))
        for number in range(plan.clients):
            task = (cloud.connect, number, folder / f"client-{number}.json", number < plan.greedy)
            cloud.supervisor.start(ProcessSpec(f"client-{number}", client, task, restart=False))
        stack.enter_context(repeated(cloud.publish, PUBLISH_EVERY_S))
        _wait(lambda: len(list(folder.glob("client-*.ready"))) == plan.clients, "clients that hear notices")
        calm = time.monotonic(), _sleep(plan.calm_s)
        stopped, dropped_after_s = _stop_some(cloud, plan)
        back = _go_on(cloud, plan)
        names = tuple(f"client-{number}" for number in range(plan.clients))
        cloud.supervisor.stop(names)
        seen = [json.loads((folder / f"{name}.json").read_text()) for name in names[plan.stopped :]]
        heard_again = sum(_heard_after(folder / f"{name}.json", back) for name in names[: plan.stopped])
        return StalledOutcome(
            _waits(seen, cloud, *calm), _waits(seen, cloud, *stopped), _missed(seen, cloud, *stopped),
            dropped_after_s, heard_again,
        )  # fmt: skip


# A client, in its own process


def client(connect: str, number: int, path: Path, greedy: bool, *, stop: threading.Event) -> None:
    """Listen and ask until told to stop, then write what came when."""
    seen: dict[str, list[list[float]]] = {"notice": [], "tile": [], "ack": []}

    def on_notice(_key: str, payload: bytes) -> None:
        update = TileUpdate.decode(payload)
        seen["notice"].append([time.monotonic(), update.tile.morton, update.version])
        path.with_suffix(".ready").touch()

    base = map_tiles()
    tile = tile_key("ndt", base[number % len(base)].tile_id)
    report = change_report(number, base[0]).encode()
    works: list[Callable[[Bus], object]] = [lambda bus: _ask(bus, tile, b"", "tile", seen["tile"], stop, ASK_EVERY_S)]
    if number % 5 == 4 or number >= 20:
        key = change_key("ndt", base[0].tile_id.district)
        works.append(lambda bus: _ask(bus, key, report, "change", seen["ack"], stop, REPORT_EVERY_S))
    if greedy:
        works += [lambda bus: _ask_for_all(bus, stop)] * GREEDY_THREADS
    with open_bus(BusConfig(connect=(connect,)), name=f"client-{number}") as bus:
        bus.subscribe(update_keys("ndt", ""), on_notice)
        threads = [threading.Thread(target=work, args=(bus,), daemon=True) for work in works]
        for thread in threads:
            thread.start()
        wait_for_stop(stop)
    path.write_text(json.dumps(seen))


def _ask(
    bus: Bus, key: str, payload: bytes, kind: str, took: list[list[float]], stop: threading.Event, every_s: float
) -> None:
    """The same report again is a duplicate: its acknowledgement goes the same way and merges nothing."""
    while not stop.wait(every_s):
        asked_s = time.monotonic()
        took.append([asked_s, float("inf")])
        try:
            bus.request(key, payload, kind=kind, timeout_s=ASK_S)
        except BusError:
            return
        took[-1][1] = time.monotonic() - asked_s


def _ask_for_all(bus: Bus, stop: threading.Event) -> None:
    while not stop.is_set():
        try:
            bus.request_many(tiles_key("ndt"), b"", kind="tile", timeout_s=ASK_S)
        except BusError:
            continue


# What is made of it


def _stop_some(cloud: SmallCloud, plan: Plan) -> tuple[tuple[float, float], float | None]:
    """From when to when clients were stopped, and when the router had closed all their connections, s after."""
    pids = [cloud.pid(f"client-{number}") for number in range(plan.stopped)]
    ports = {one.laddr.port for pid in pids[plan.slow :] for one in psutil.Process(pid).net_connections("tcp")}
    begin_s = time.monotonic()
    for pid in pids:
        os.kill(pid, signal.SIGSTOP)
    closed_s = None
    while time.monotonic() < begin_s + plan.stopped_s:
        if closed_s is None and ports.isdisjoint(_ports_of_clients(cloud.pid("router"))):
            closed_s = time.monotonic() - begin_s
        time.sleep(SLOW_EVERY_S)
        _breathe(pids[: plan.slow])
    return (begin_s, time.monotonic()), closed_s


def _breathe(pids: Sequence[int]) -> None:
    """Let stopped processes run for a moment."""
    for number in (signal.SIGCONT, signal.SIGSTOP):
        for pid in pids:
            os.kill(pid, number)
        time.sleep(SLOW_FOR_S)


def _go_on(cloud: SmallCloud, plan: Plan) -> float:
    """Let the stopped clients go on; since when."""
    for number in range(plan.stopped):
        os.kill(cloud.pid(f"client-{number}"), signal.SIGCONT)
    since_s = time.monotonic()
    _sleep(plan.after_s)
    return since_s


def _ports_of_clients(router: int) -> set[int]:
    """Seen from the router: a stopped client never reads that its connection was closed."""
    connections = psutil.Process(router).net_connections("tcp")
    return {one.raddr.port for one in connections if one.raddr and one.status == psutil.CONN_ESTABLISHED}


def _waits(
    seen: Sequence[dict[str, list[list[float]]]], cloud: SmallCloud, begin_s: float, end_s: float
) -> dict[str, float]:
    """The longest waits of all clients that touch a span of time, s."""

    def slowest(what: str) -> float:
        took = (
            took_s
            for one in seen
            for asked_s, took_s in one[what]
            if begin_s - ASK_S < asked_s < end_s and asked_s + took_s > begin_s
        )
        return max(took, default=float("inf"))

    def delays(arrivals: Iterable[list[float]]) -> Iterable[float]:
        for at_s, morton, version in arrivals:
            put_s = cloud.put_s.get((int(morton), int(version)))
            if put_s is not None and begin_s <= put_s < end_s:
                yield at_s - put_s

    return {
        "gap": max(_longest_gap_s([row[0] for row in one["notice"]], begin_s, end_s) for one in seen),
        "notice": max((delay_s for one in seen for delay_s in delays(one["notice"])), default=float("inf")),
        "tile": slowest("tile"),
        "ack": slowest("ack"),
    }


def _longest_gap_s(times_s: Sequence[float], begin_s: float, end_s: float) -> float:
    inside = [begin_s, *(t for t in times_s if begin_s < t < end_s), end_s]
    return max(after - before for before, after in itertools.pairwise(inside))


def _missed(seen: Sequence[dict[str, list[list[float]]]], cloud: SmallCloud, begin_s: float, end_s: float) -> float:
    due = {key for key, put_s in cloud.put_s.items() if begin_s <= put_s < end_s - 1.0}
    came = sum(len(due & {(int(m), int(v)) for _, m, v in one["notice"]}) for one in seen)
    return 1 - came / (len(due) * len(seen))


def _heard_after(path: Path, since_s: float) -> bool:
    return path.exists() and any(row[0] > since_s for row in json.loads(path.read_text())["notice"])


def _sleep(for_s: float) -> float:
    time.sleep(for_s)
    return time.monotonic()


def _wait(condition: Callable[[], bool], what: str) -> None:
    deadline_s = time.monotonic() + READY_S
    while not condition():
        if time.monotonic() > deadline_s:
            raise TimeoutError(f"no {what} within {READY_S:g} s")
        time.sleep(0.05)
