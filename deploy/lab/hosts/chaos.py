"""The faults of `gnd chaos` in the laboratory: drawn from a seed, two seconds apart, so that several hold at a time.

What belongs to a store in a file (full disks, damaged pages) is left out, and the time of day, which has faults of its
own. A line is held up in the middle of the network.
"""

import threading
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Final

from gnd.deploy.chaos.faults import BY_NAME, plan
from gnd.deploy.chaos.inflict import MESSENGER, Inflictor
from gnd.deploy.chaos.run import Timeline
from gnd.deploy.chaos.street import ChaosStreet
from gnd.deploy.errors import LabError
from gnd.deploy.lab.hosts.cloud import identity_of, links_of_region
from gnd.deploy.lab.hosts.network import LabEnd, lose_between
from gnd.deploy.lab.hosts.plan import HUB, client_names
from gnd.deploy.lab.hosts.running import HostsCloud
from gnd.deploy.processes import Supervisor
from gnd.fleet_bus.bus import open_bus
from gnd.fleet_bus.config import BusConfig
from gnd.tile_store.sqlite_store import SqlStore

KINDS: Final = tuple(
    BY_NAME[name]
    for name in (
        *(f"{what} {part}" for what in ("kill", "stop") for part in ("router", "store", "shard", "worker", "vehicle")),
        "late line",
        "twice",
        "out of order",
    )
)
_PARTS: Final = {"store": "tiles", "worker": "shard"}
"""What the laboratory calls them."""


class _HeldLines:
    """The links of clients, over which nothing passes while they are held."""

    def __init__(self, cloud: HostsCloud) -> None:
        self._middle, self._held = cloud.lab.cloud_namespace, dict[str, ExitStack]()
        self._hosts = [LabEnd.of_host(host) for host in cloud.plan.hosts]
        self._links = {
            name: LabEnd.of_link(link)
            for region in range(cloud.plan.size.regions)
            for name, link in zip(
                client_names(cloud.plan, region), links_of_region(cloud.plan, cloud.lab, region), strict=True
            )
        }

    def cut(self, name: str) -> None:
        """As `hold`: a network that fails tells nobody."""
        self.hold(name)

    def hold(self, name: str) -> None:
        """See `HurtLines.hold`."""
        if name in self._held:
            return
        own = [self._links[name]]
        undone = [lose_between(self._middle, *ways) for ways in ((own, self._hosts), (self._hosts, own))]
        self._held[name] = ExitStack()
        for undo in undone:
            self._held[name].callback(undo)

    def mend(self, name: str) -> None:
        """See `HurtLines.mend`."""
        if (undo := self._held.pop(name, None)) is not None:
            undo.close()


@dataclass(frozen=True)
class LabVictim:
    """A laboratory as what chaos hurts.

    Attributes:
        cloud: running.
        store: of it, opened here.
        wires: links of the clients.
    """

    cloud: HostsCloud
    store: SqlStore
    wires: _HeldLines

    @property
    def supervisor(self) -> Supervisor:
        """See `HurtCloud.supervisor`."""
        return self.cloud.supervisor

    @property
    def path(self) -> Path:
        """There is none: the store is in a database.

        Raises:
            LabError: always.
        """
        raise LabError("the store of a laboratory is no file")

    @property
    def folder(self) -> Path:
        """See `HurtCloud.folder`."""
        return self.cloud.folders.root

    @property
    def vehicles(self) -> Path:
        """See `HurtCloud.vehicles`."""
        return self.cloud.folders.vehicles

    def names(self, part: str) -> list[str]:
        """See `HurtCloud.names`; the hub is a router, and who asks for tiles has lines, too."""
        prefix = _PARTS.get(part, part)
        found = [name for name in self.supervisor.pids() if name.split("-")[0] == prefix]
        found += [name for name in self.supervisor.pids() if part == "router" and name == HUB]
        return sorted(found)

    def step_clock(self, by_s: float) -> None:
        """Nothing: clocks of hosts have faults of their own.

        Raises:
            LabError: always.
        """
        raise LabError(f"the clock of a laboratory is not set by chaos ({by_s:+g} s)")


@dataclass(slots=True)
class LabChaos:
    """Inflicts chaos, and remembers what it did.

    Attributes:
        victim: that is hurt.
        seed: draws the faults; each time that they are inflicted the next seed.
        inflictor: begins and ends them.
        rows: of all faults that there were, as `gnd chaos` tells them.
    """

    victim: LabVictim
    seed: int
    inflictor: Inflictor
    rows: list[dict[str, Any]] = field(default_factory=list)
    _times: int = 0

    def inflict(self, count: int, stop: threading.Event) -> str:
        """So many faults, each ended; what was done, in words."""
        seed = self.seed + self._times
        self._times += 1
        timeline = Timeline(self.inflictor, lambda _what, _n: None)
        timeline.run(plan(seed, count, KINDS), stop, lambda: bool(self.victim.cloud.died))
        self.rows += timeline.rows
        return f"{len(timeline.rows)} faults of seed {seed}"

    def still_open(self) -> int:
        """How many reports of the messenger are not released."""
        return self.inflictor.still_open()


@contextmanager
def lab_chaos(cloud: HostsCloud, street: ChaosStreet, seed: int, store: SqlStore) -> Iterator[LabChaos]:
    """What inflicts chaos while the block runs; the calling thread must be in the middle's namespace."""
    victim = LabVictim(cloud, store, _HeldLines(cloud))
    own = identity_of(cloud.plan, cloud.folders, MESSENGER)
    config = BusConfig(connect=(cloud.plan.hub, *cloud.plan.routers(0)[:1]), patient=True, identity=own)
    with ExitStack() as stack:
        bus = stack.enter_context(open_bus(config, name=MESSENGER))
        inflictor = Inflictor(victim, street, seed, bus)
        stack.callback(inflictor.close)
        yield LabChaos(victim, seed, inflictor)
