"""A real cloud of processes that is attacked, an honest client of it, and programs that attack."""

import itertools
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

from gnd.cloud_merger.admission import KNOWN_AFTER_S
from gnd.deploy.chaos.street import ChaosStreet
from gnd.deploy.processes import ProcessSpec
from gnd.fleet_bus.bus import Bus
from gnd.schemas.changes import ChangeAck
from gnd.schemas.keys import change_key, state_key, tile_key
from gnd.schemas.report_id import deterministic_report_id
from gnd.schemas.report_states import ReportQuestion, ReportStates
from gnd.schemas.tiles import TileReply
from gnd.tile_store.store import Store
from studies.flooding import flood
from studies.small_cloud import TILE, SmallCloud, base_tile, change_report

REQUEST_S = 20.0  # as a vehicle's outbox waits
HONEST = "honest"
_NUMBERS = itertools.count(1)


class Honest:
    """A vehicle that does as it should."""

    def __init__(self, bus: Bus, store: Store, street: ChaosStreet, vehicle: str = HONEST) -> None:
        self.bus, self.store, self.street, self.vehicle = bus, store, street, vehicle
        self._base, self._began_s = base_tile(), time.monotonic()

    def reports(self) -> str:
        """Its report is acknowledged within a request's usual time; the id."""
        number = next(_NUMBERS)
        t_ms = 1_700_000_000_000 + number
        report = replace(
            change_report(number, self._base),
            report_id=deterministic_report_id(t_ms, self.vehicle, str(number)),
            vehicle=self.vehicle,
        )
        ack = self.send(change_key("ndt", TILE.district), report.encode())
        assert ack.status in ("stored", "duplicate"), ack
        return report.report_id

    def becomes_known(self) -> None:
        """It reports until shards know its name, and once more."""
        while time.monotonic() - self._began_s < KNOWN_AFTER_S + 2.0:
            self.reports()
            time.sleep(1.0)
        self.reports()

    def send(self, key: str, body: bytes) -> ChangeAck:
        return ChangeAck.decode(self.bus.request(key, body, kind="change", timeout_s=REQUEST_S))

    def fetches(self) -> None:
        """A tile comes within a request's usual time."""
        answer = self.bus.request(tile_key("ndt", TILE), b"", kind="tile", timeout_s=REQUEST_S)
        assert TileReply.decode(answer).status == "blob"

    def hears(self, report_id: str) -> None:
        """Its report is looked at, and it hears so."""
        question = ReportQuestion((report_id,)).encode()

        def state() -> str:
            answer = self.bus.request(state_key(self.vehicle), question, kind="change", timeout_s=REQUEST_S)
            return ReportStates.decode(answer).states[0].status

        wait_for(lambda: state() == "released", "the report is released")

    def is_served(self) -> None:
        """All of it."""
        self.fetches()
        self.reports()


def wait_for(condition: Callable[[], object], what: str, within_s: float = 60.0) -> None:
    """Until it holds."""
    until_s = time.monotonic() + within_s
    while not condition():
        assert time.monotonic() < until_s, f"not within {within_s:g} s: {what}"
        time.sleep(0.05)


@contextmanager
def flooding(cloud: SmallCloud, kind: str, hz: float, for_s: float = 1.0) -> Iterator[None]:
    """A process floods; the block begins when it has done so for a while."""
    gate = cloud.folder / f"gate-{next(_NUMBERS)}"
    name = f"attacker-{gate.name}"
    role = (kind, cloud.connect, hz, TILE.morton, str(gate))
    cloud.supervisor.start(ProcessSpec(name, flood, role, restart=False))
    gate.touch()
    time.sleep(for_s + 1.0)
    try:
        yield
    finally:
        gate.unlink()
        cloud.supervisor.stop((name,))


def store_bytes(path: Path) -> int:
    """Of the file with its log."""
    return sum(one.stat().st_size for one in (path, path.with_name(path.name + "-wal")) if one.exists())
