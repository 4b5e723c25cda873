"""One vehicle floods a cloud: how much longer do the others wait for their acknowledgements? A calm and a flooded time
take turns within one run, so that whatever else the machine does is in both.
"""

import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Final

import numpy as np

from gnd.deploy.chaos.street import read_street
from gnd.deploy.processes import ProcessSpec
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusError
from gnd.schemas.changes import ChangeAck
from gnd.schemas.keys import change_key
from gnd.tile_store.store import Store
from studies.flooding import FLOODER, flood
from studies.frame.measure import Figure
from studies.frame.options import check, option
from studies.small_cloud import TILE, SmallCloud, base_tile, change_report, small_cloud

SESSIONS: Final = 4
KINDS: Final = ("reports", "names", "nonsense")
LEAD_S: Final = 2.0
REQUEST_S: Final = 60.0


@dataclass(frozen=True, slots=True)
class FlooderOptions:
    """What is measured."""

    vehicles: int = option(20, "Honest vehicles.", span=(1, 1000))
    hz: float = option(2.0, "Reports a second of each.", span=(0.01, 100))
    times: float = option(100.0, "The flooder sends so many times as many as one of them.", span=(1, 100_000))
    kinds: tuple[str, ...] = option(KINDS, "Kinds of floods.", known=KINDS)
    rounds: int = option(4, "Calm and flooded times.", span=(1, 100))
    seconds: float = option(8.0, "Length of each, s.", span=(1, 600))
    shards: int = option(1, "Merger shards.", span=(1, 8))

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = FlooderOptions


def run(options: FlooderOptions | None = None) -> list[Figure]:
    """Measure each kind of flood on a cloud of its own."""
    options = options or FlooderOptions()
    return [figure for kind in options.kinds for figure in _figures(kind, options)]


def _figures(kind: str, options: FlooderOptions) -> list[Figure]:
    with tempfile.TemporaryDirectory() as folder, small_cloud(Path(folder), options.shards) as cloud:
        cloud.store.put_tiles(read_street().tiles)
        took_s = _measured(cloud, kind, options)
        flooder = cloud.store.uploads_waiting(FLOODER, 10_000)
    calm, flooded = (np.array([one for one, _ in took_s[phase]]) for phase in ("calm", "flood"))
    failed = sum(not good for phase in took_s.values() for _, good in phase)
    ratio = float(np.quantile(flooded, 0.99) / np.quantile(calm, 0.99))
    rate = options.hz * options.times
    detail = (
        f"{options.vehicles} vehicles, {options.hz:g} reports a second each; flooder: {rate:g} a second; "
        f"{len(calm)} and {len(flooded)} acks, {failed} failed; of the flooder {flooder} wait"
    )
    return [
        Figure(f"ack p50 calm, {kind}", 1e3 * float(np.quantile(calm, 0.5)), "ms", detail),
        Figure(f"ack p50 flooded, {kind}", 1e3 * float(np.quantile(flooded, 0.5)), "ms", detail),
        Figure(f"ack p99 calm, {kind}", 1e3 * float(np.quantile(calm, 0.99)), "ms", detail),
        Figure(f"ack p99 flooded, {kind}", 1e3 * float(np.quantile(flooded, 0.99)), "ms", detail),
        Figure(f"ratio of p99, {kind}", ratio, "", detail),
    ]


def _measured(cloud: SmallCloud, kind: str, options: FlooderOptions) -> dict[str, list[tuple[float, bool]]]:
    """Seconds to the ack and whether it was good, of each report of the honest vehicles, by phase."""
    gate, stop = cloud.folder / "gate", threading.Event()
    role = (kind, cloud.connect, options.hz * options.times, TILE.morton, str(gate))
    cloud.supervisor.start(ProcessSpec("flooder", flood, role))
    found: dict[str, list[tuple[float, bool]]] = defaultdict(list)
    phase = ["warm"]
    with ExitStack() as stack:
        buses = [stack.enter_context(open_bus(BusConfig(connect=(cloud.connect,)))) for _ in range(SESSIONS)]
        threads = [
            threading.Thread(target=_vehicle, args=(buses[n % SESSIONS], n, options, phase, found, stop))
            for n in range(options.vehicles)
        ]
        for thread in threads:
            thread.start()
        time.sleep(options.seconds)
        for _ in range(options.rounds):
            _phase(phase, "calm", options.seconds)
            gate.touch()
            _phase(phase, "flood", options.seconds)
            gate.unlink()
            phase[0] = "pause"
            _wait_until_settled(cloud.store)
        stop.set()
        for thread in threads:
            thread.join()
    return found


def _phase(phase: list[str], name: str, seconds: float) -> None:
    """Let it begin, then count."""
    phase[0] = "lead"
    time.sleep(LEAD_S)
    phase[0] = name
    time.sleep(seconds)


def _wait_until_settled(store: Store) -> None:
    until_s = time.monotonic() + REQUEST_S
    while store.uploads_waiting(FLOODER, 1) and time.monotonic() < until_s:
        time.sleep(0.1)


def _vehicle(
    bus: Bus,
    number: int,
    options: FlooderOptions,
    phase: Sequence[str],
    found: dict[str, list[tuple[float, bool]]],
    stop: threading.Event,
) -> None:
    """Report in a steady rhythm, each time what nobody has said before."""
    base, key = base_tile(), change_key("ndt", TILE.district)
    due_s = time.monotonic() + number / options.vehicles / options.hz
    for count in range(1_000_000):
        if stop.wait(max(0.0, due_s - time.monotonic())):
            return
        due_s = max(due_s + 1.0 / options.hz, time.monotonic() - 1.0)
        report = change_report(number + 100 * count, base)
        now, began_s = phase[0], time.monotonic()
        try:
            ack = ChangeAck.decode(bus.request(key, report.encode(), kind="change", timeout_s=REQUEST_S))
            good = ack.status in ("stored", "duplicate")
        except BusError:
            good = False
        found[now].append((time.monotonic() - began_s, good))
