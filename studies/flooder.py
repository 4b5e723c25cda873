"""One vehicle floods a cloud: how much longer do the others wait for their acknowledgements?

Calm and flooded times take turns within one run, so that whatever else the machine does is in both. Before the first
the vehicles have driven for so long that they are known. The CPU time of each part tells what the flood costs, whoever
else keeps the cores busy.
"""

import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Final

import numpy as np
from numpy.typing import NDArray

from gnd.deploy.chaos.street import read_street
from gnd.deploy.fleet_identities import make_identities
from gnd.deploy.load.cpu import by_part, cpu_s
from gnd.deploy.processes import ProcessSpec
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusError
from gnd.fleet_bus.turns import KNOWN_AFTER_S
from gnd.schemas.changes import ChangeAck
from gnd.schemas.keys import change_key
from gnd.tile_store.connection import SqlConnection
from gnd.tile_store.sqlite_connection import SqliteConnection
from gnd.tile_store.sqlite_store import SqliteStore
from studies.flooding import FLOODER, flood
from studies.frame.measure import Figure
from studies.frame.options import check, option
from studies.small_cloud import TILE, SmallCloud, base_tile, change_report, small_cloud

SESSIONS: Final = 4
KINDS: Final = ("reports", "names", "returning", "nonsense")
LEAD_S: Final = 2.0
REQUEST_S: Final = 60.0
Ack = tuple[int, float, bool]
"""Round, seconds to the ack, whether it was good."""


@dataclass(frozen=True, slots=True)
class FlooderOptions:
    """What is measured."""

    vehicles: int = option(20, "Honest vehicles.", span=(1, 99))
    hz: float = option(2.0, "Reports a second of each.", span=(0.01, 100))
    times: float = option(100.0, "The flooder sends so many times as many as one of them.", span=(1, 100_000))
    kinds: tuple[str, ...] = option(KINDS, "Kinds of floods.", known=KINDS)
    rounds: int = option(4, "Calm and flooded times.", span=(1, 100))
    seconds: float = option(8.0, "Length of each, s.", span=(1, 600))
    shards: int = option(1, "Merger shards.", span=(1, 8))
    warm: float = option(KNOWN_AFTER_S + 2.0, "The vehicles drive for so long before, s.", span=(1, 600))
    secure: bool = option(False, "With certificates, TLS, rights and seals: the flooder is a vehicle of the fleet.")

    def __post_init__(self) -> None:
        check(self)


OPTIONS: Final = FlooderOptions


@dataclass(slots=True)
class _FloodTimes:
    """What the honest vehicles saw, and what the parts used, by phase ("calm", "flood" ...)."""

    phase: str = "warm"
    number: int = 0
    acks: dict[str, list[Ack]] = field(default_factory=lambda: defaultdict(list))
    cpu: dict[str, dict[str, float]] = field(default_factory=lambda: defaultdict(lambda: defaultdict(float)))
    left: list[int] = field(default_factory=list)

    def took_s(self, phase: str, number: int | None = None) -> NDArray[np.float64]:
        """Seconds to each ack of a phase, of one round or of all."""
        return np.array([one for at, one, _ in self.acks[phase] if number in (None, at)])

    def ratios(self, share: float) -> NDArray[np.float64]:
        """(rounds,) quantile of the flooded time of each round by that of its calm time."""
        found = [
            np.quantile(self.took_s("flood", n), share) / np.quantile(self.took_s("calm", n), share)
            for n in range(1, self.number + 1)
        ]
        return np.array(found)


def run(options: FlooderOptions | None = None) -> list[Figure]:
    """Measure each kind of flood on a cloud of its own."""
    options = options or FlooderOptions()
    return [figure for kind in options.kinds for figure in _figures(kind, options)]


def _figures(kind: str, options: FlooderOptions) -> list[Figure]:
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        identities = make_identities(folder, options.shards, options.vehicles + 1) if options.secure else None
        with small_cloud(folder, options.shards, identities) as cloud:
            cloud.store.put_tiles(read_street().tiles)
            found = _measured(cloud, kind, options)
    calm, flooded = found.took_s("calm"), found.took_s("flood")
    failed = sum(not good for phase in ("calm", "flood") for *_, good in found.acks[phase])
    rate = options.hz * options.times
    detail = (
        f"{options.vehicles} vehicles, {options.hz:g} reports a second each; flooder: {rate:g} a second"
        f"{' with a certificate' if options.secure else ''}; {len(calm)} and {len(flooded)} acks, {failed} failed; "
        f"of the flood waited at the end of each round {', '.join(map(str, found.left))}"
    )
    rounds = ", ".join(f"{one:.2f}" for one in found.ratios(0.99))
    seconds = options.rounds * options.seconds
    used = [
        Figure(
            f"CPU of {part}, {kind}",
            1e3 * (found.cpu["flood"][part] - found.cpu["calm"][part]) / seconds,
            "ms a second more",
            f"calm {1e3 * found.cpu['calm'][part] / seconds:.0f} ms a second",
        )
        for part in sorted(found.cpu["flood"])
    ]
    return [
        *(
            Figure(f"ack {label} {phase}, {kind}", 1e3 * float(np.quantile(took_s, share)), "ms", detail)
            for label, share in (("p50", 0.5), ("p99", 0.99))
            for phase, took_s in (("calm", calm), ("flooded", flooded))
        ),
        Figure(f"ratio of p50, {kind}", float(np.quantile(flooded, 0.5) / np.quantile(calm, 0.5)), "", detail),
        Figure(f"ratio of p99, {kind}", float(np.quantile(flooded, 0.99) / np.quantile(calm, 0.99)), "", detail),
        Figure(f"median of the rounds' ratios of p99, {kind}", float(np.median(found.ratios(0.99))), "", rounds),
        *used,
    ]


def _measured(cloud: SmallCloud, kind: str, options: FlooderOptions) -> _FloodTimes:
    gate, stop, found = cloud.folder / "gate", threading.Event(), _FloodTimes()
    role = (kind, cloud.connect, options.hz * options.times, TILE.morton, str(gate))
    identity = cloud.identity_of(f"vehicle-{options.vehicles:02d}")
    cloud.supervisor.start(ProcessSpec("flooder", flood, role, identity=identity))
    with ExitStack() as stack:
        n_buses = options.vehicles if options.secure else min(SESSIONS, options.vehicles)
        buses = [stack.enter_context(open_bus(_of_vehicle(cloud, n))) for n in range(n_buses)]
        threads = [
            threading.Thread(target=_vehicle, args=(buses[n % n_buses], n, options, found, stop))
            for n in range(options.vehicles)
        ]
        for thread in threads:
            thread.start()
        time.sleep(options.warm)
        for found.number in range(1, options.rounds + 1):
            with _phase(cloud, found, "calm"):
                time.sleep(options.seconds)
            gate.touch()
            with _phase(cloud, found, "flood"):
                time.sleep(options.seconds)
            gate.unlink()
            found.left.append(_forget_flood(cloud.store, options.vehicles))
        stop.set()
        for thread in threads:
            thread.join()
    return found


def _of_vehicle(cloud: SmallCloud, number: int) -> BusConfig:
    return BusConfig(connect=(cloud.connect,), identity=cloud.identity_of(f"vehicle-{number:02d}"))


@contextmanager
def _phase(cloud: SmallCloud, found: _FloodTimes, name: str) -> Iterator[None]:
    """Let it begin, then count acks and CPU while the block runs."""
    found.phase = "lead"
    time.sleep(LEAD_S)
    before, found.phase = _cpu(cloud), name
    yield
    found.phase = "pause"
    for part, now_s in _cpu(cloud).items():
        found.cpu[name][part] += now_s - before.get(part, 0.0)


def _cpu(cloud: SmallCloud) -> Mapping[str, float]:
    pids = cloud.supervisor.pids()
    return by_part(pids) | {"flooder": cpu_s(pids[FLOODER])}


def _forget_flood(store: SqliteStore, honest: int) -> int:
    """Take out of the store what waits of the flood, so that none of it is in the next calm time; how much it was."""
    kept = tuple(f"vehicle-{n:02d}" for n in range(honest))
    others = f"state IN ('waiting', 'early') AND vehicle NOT IN ({', '.join('?' * honest)})"

    def forget(c: SqlConnection, _now: int) -> int:
        assert isinstance(c, SqliteConnection)
        c.execute(f"DELETE FROM upload WHERE {others}", kept)  # noqa: S608 - question marks only
        return c.changes()

    return store.transact(forget)


def _vehicle(bus: Bus, number: int, options: FlooderOptions, found: _FloodTimes, stop: threading.Event) -> None:
    """Report in a steady rhythm, each time what nobody has said before."""
    base, key = base_tile(), change_key("ndt", TILE.district)
    due_s = time.monotonic() + number / options.vehicles / options.hz
    for count in range(1_000_000):
        if stop.wait(max(0.0, due_s - time.monotonic())):
            return
        due_s = max(due_s + 1.0 / options.hz, time.monotonic() - 1.0)
        report = replace(change_report(number + 100 * count, base), vehicle=f"vehicle-{number:02d}")
        phase, at, began_s = found.phase, found.number, time.monotonic()
        good = _is_acknowledged(bus, key, report.encode())
        found.acks[phase].append((at, time.monotonic() - began_s, good))


def _is_acknowledged(bus: Bus, key: str, body: bytes) -> bool:
    try:
        ack = ChangeAck.decode(bus.request(key, body, kind="change", timeout_s=REQUEST_S))
    except BusError:
        return False
    return ack.status in ("stored", "duplicate")
