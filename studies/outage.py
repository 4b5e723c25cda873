"""`kill -9` of the router, the tile server and the shard: the longest time without service until it is started again.

The processes run under the supervisor of `gnd fleet`. One client asks for a tile again and again, one sends a report,
one follows the notices of versions that are committed twenty times a second.
"""

import os
import signal
import tempfile
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path

from gnd.deploy.repeating import repeated
from gnd.fleet_bus.bus import Bus, open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.fleet_bus.errors import BusClosed, RequestFailed
from gnd.schemas.keys import change_key, tile_key, update_keys
from studies.frame.measure import Figure
from studies.small_cloud import READY_S, SmallCloud, change_report, small_cloud

VICTIMS = {"router": ("tile", "report", "update"), "store": ("tile",), "merger-0": ("report", "update")}
KILLS = 3
BETWEEN_S = 4.0
ASK_EVERY_S = 0.01
PUBLISH_EVERY_S = 0.05


@dataclass(slots=True)
class OutageService:
    """When each service was last given, and the longest pause since `reset`, s, by the monotonic clock."""

    last_s: dict[str, float] = field(default_factory=dict)
    longest_s: dict[str, float] = field(default_factory=dict)
    _lock: threading.Lock = field(default_factory=threading.Lock)

    def note(self, service: str) -> None:
        """It was given now."""
        with self._lock:
            now_s = time.monotonic()
            pause_s = now_s - self.last_s.get(service, now_s)
            self.longest_s[service] = max(self.longest_s.get(service, 0.0), pause_s)
            self.last_s[service] = now_s

    def reset(self) -> None:
        """Forget the pauses until now."""
        with self._lock:
            self.longest_s = {}

    def pauses_s(self) -> dict[str, float]:
        """The longest pause of each service, the one that lasts included."""
        for service in ("tile", "report", "update"):
            with self._lock:
                lasting_s = time.monotonic() - self.last_s[service]
                self.longest_s[service] = max(self.longest_s.get(service, 0.0), lasting_s)
        return dict(self.longest_s)


def run() -> list[Figure]:
    """Kill each part three times."""
    return [
        Figure(f"kill -9 of {victim}: longest time without {service}", longest_s, "s", f"{KILLS} kills")
        for victim, services in measure(KILLS).items()
        for service, longest_s in services.items()
    ]


def measure(kills: int, between_s: float = BETWEEN_S) -> dict[str, dict[str, float]]:
    """The longest pause, s, of each service by each victim that gives it."""
    with tempfile.TemporaryDirectory() as name, small_cloud(Path(name)) as cloud, _clients(cloud) as served:
        return {victim: _kill(cloud, served, victim, kills, between_s) for victim in VICTIMS}


def _kill(cloud: SmallCloud, served: OutageService, victim: str, kills: int, between_s: float) -> dict[str, float]:
    served.reset()
    for _ in range(kills):
        os.kill(cloud.pid(victim), signal.SIGKILL)
        time.sleep(between_s)
    pauses_s = served.pauses_s()
    return {service: pauses_s[service] for service in VICTIMS[victim]}


@contextmanager
def _clients(cloud: SmallCloud) -> Iterator[OutageService]:
    """Clients that ask and listen while the block runs, from when each service was given once."""
    served = OutageService()
    tile = tile_key("ndt", cloud.base[0].tile_id)
    place = change_key("ndt", cloud.base[0].tile_id.district)
    report = change_report(0, cloud.base[0]).encode()
    config = BusConfig(connect=(cloud.connect,))
    with ExitStack() as stack:
        asking, sending, hearing = (stack.enter_context(open_bus(config, name=name)) for name in ("a", "s", "h"))
        hearing.subscribe(update_keys("ndt", ""), lambda _key, _payload: served.note("update"))
        for work in (
            lambda: _ask(asking, tile, b"", "tile", lambda: served.note("tile")),
            lambda: _ask(sending, place, report, "change", lambda: served.note("report")),
        ):
            threading.Thread(target=work, daemon=True).start()
        stack.enter_context(repeated(cloud.publish, PUBLISH_EVERY_S))
        deadline_s = time.monotonic() + READY_S
        while len(served.last_s) < 3:
            if time.monotonic() > deadline_s:
                raise TimeoutError(f"only {sorted(served.last_s)} within {READY_S:g} s")
            time.sleep(0.02)
        time.sleep(1.0)
        yield served


def _ask(bus: Bus, key: str, payload: bytes, kind: str, given: Callable[[], None]) -> None:
    while True:
        try:
            bus.request(key, payload, kind=kind, timeout_s=READY_S)
        except BusClosed:
            return
        except RequestFailed:
            continue
        given()
        time.sleep(ASK_EVERY_S)
