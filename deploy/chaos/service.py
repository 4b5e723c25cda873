"""How long each service was not given: a tile to who asks, an acknowledgement to who reports, a notice to who listens.

Three clients ask and listen all the time, straight at the router. A pause between two answers belongs to the newest
fault that began before it ended. As long as a process that gives the service is stopped, or its disk full, it cannot
serve: that time is taken off, and what is left is what the cloud took to come back.
"""

import itertools
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from typing import Final

from gnd.deploy.chaos.faults import BY_NAME, Fault
from gnd.deploy.chaos.street import LAYER, SentReport
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusClosed, RequestFailed
from gnd.gnd_map.tile import Tile
from gnd.schemas.keys import tile_key, update_keys

SERVICES: Final = ("tile", "report", "update")
SERVED_BY: Final = {"tile": ("router", "store"), "report": ("router", "shard"), "update": ("router", "shard", "worker")}
HELD: Final = ("stop", "disk")
"""While a fault of these groups is held, its part cannot serve, whatever the cloud does; what others cost counts."""
_ASK_EVERY_S: Final = 0.01
_REPORT_EVERY_S: Final = 0.03
_READY_S: Final = 60.0


@dataclass(slots=True)
class ServiceGaps:
    """When each service was given, s by the monotonic clock."""

    times_s: dict[str, list[float]] = field(default_factory=lambda: {service: [] for service in SERVICES})

    def note(self, service: str) -> None:
        """It was given now."""
        self.times_s[service].append(time.monotonic())

    def pauses_s(self, begin_s: float, end_s: float) -> dict[str, list[tuple[float, float]]]:
        """(from, to) of every pause between two givings, by service, s; the one that lasts at the end included."""
        found = {}
        for service, times_s in self.times_s.items():
            inside = [begin_s, *(t for t in times_s if begin_s < t < end_s), end_s]
            found[service] = list(itertools.pairwise(inside))
        return found


@dataclass(frozen=True, slots=True)
class Gaps:
    """The longest pauses, s: `by_kind[kind][service]` beyond what the fault was held; `of_kills` over all kills."""

    by_kind: dict[str, dict[str, float]]
    of_kills: dict[str, float]


def gaps(served: ServiceGaps, faults: Sequence[Fault], start_s: float, end_s: float) -> Gaps:
    """What each kind of fault cost.

    Args:
        served: what was given when.
        faults: in order of time.
        start_s: monotonic time of which the faults' times count, s.
        end_s: when the account ends, monotonic, s.
    """
    by_kind: dict[str, dict[str, float]] = {fault.kind: dict.fromkeys(SERVICES, 0.0) for fault in faults}
    for service, pauses in served.pauses_s(start_s, end_s).items():
        held = _union([(start_s + one.at_s, start_s + one.end_s) for one in faults if _excuses(one, service)])
        for begin_s, until_s in pauses:
            blamed = _blamed(faults, begin_s - start_s, until_s - start_s)
            if blamed is None:
                continue
            beyond_s = until_s - begin_s - _overlap_s(held, begin_s, until_s)
            by_kind[blamed.kind][service] = max(by_kind[blamed.kind][service], beyond_s)
    kills = [pauses for kind, pauses in by_kind.items() if kind.startswith("kill ")]
    of_kills = {service: max((one[service] for one in kills), default=0.0) for service in SERVICES}
    return Gaps(by_kind, of_kills)


def _blamed(faults: Sequence[Fault], begin_s: float, until_s: float) -> Fault | None:
    """The fault that a pause belongs to: the first kill within it, else the newest that began before its end."""
    inside = [one for one in faults if begin_s <= one.at_s <= until_s]
    kills = [one for one in inside if one.group == "kill"]
    if kills or inside:
        return (kills or inside)[0]
    before = [one for one in faults if one.at_s < begin_s]
    return before[-1] if before else None


def _excuses(fault: Fault, service: str) -> bool:
    """Whether a part that gives the service could not while the fault was held."""
    return fault.group in HELD and BY_NAME[fault.kind].part in SERVED_BY[service]


def _union(spans: list[tuple[float, float]]) -> list[tuple[float, float]]:
    """The same times without overlaps."""
    found: list[tuple[float, float]] = []
    for begin_s, end_s in sorted(spans):
        if found and begin_s <= found[-1][1]:
            found[-1] = found[-1][0], max(found[-1][1], end_s)
        else:
            found.append((begin_s, end_s))
    return found


def _overlap_s(spans: Sequence[tuple[float, float]], begin_s: float, end_s: float) -> float:
    return sum(max(0.0, min(end_s, until_s) - max(begin_s, from_s)) for from_s, until_s in spans)


@contextmanager
def watched(connect: str, tile: Tile, report: SentReport) -> Iterator[ServiceGaps]:
    """Clients that ask and listen while the block runs, from when each service was given once.

    Args:
        connect: endpoint of the router.
        tile: that is asked for.
        report: that is sent again and again: what comes after the first time is a duplicate, and is acknowledged.
    """
    served, config = ServiceGaps(), BusConfig(connect=(connect,))
    with ExitStack() as stack:
        asking, sending, hearing = (stack.enter_context(open_bus(config, name=f"watch-{n}")) for n in SERVICES)
        hearing.subscribe(update_keys(LAYER, ""), lambda _key, _payload: served.note("update"))
        payload, place = report.packed.encode(), tile_key(LAYER, tile.tile_id)
        works: tuple[Callable[[], None], ...] = (
            lambda: _ask(asking, place, b"", "tile", lambda: served.note("tile"), _ASK_EVERY_S),
            lambda: _ask(sending, report.key, payload, "change", lambda: served.note("report"), _REPORT_EVERY_S),
        )
        for work in works:
            threading.Thread(target=work, daemon=True).start()
        deadline_s = time.monotonic() + _READY_S
        while not all(served.times_s.values()):
            if time.monotonic() > deadline_s:
                silent = [service for service, times_s in served.times_s.items() if not times_s]
                raise TimeoutError(f"no {', '.join(silent)} within {_READY_S:g} s")
            time.sleep(0.02)
        yield served


def _ask(bus: Bus, key: str, payload: bytes, kind: str, given: Callable[[], None], every_s: float) -> None:
    while True:
        try:
            bus.request(key, payload, kind=kind, timeout_s=_READY_S)
        except BusClosed:
            return
        except RequestFailed:
            continue
        given()
        time.sleep(every_s)
