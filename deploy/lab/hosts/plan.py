"""Which part runs on which host: parts of a kind on different hosts, the database away from what else may be lost."""

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Final

from gnd.deploy.errors import LabError
from gnd.deploy.lab.groups import check_lab_name, namespace_name

MOST_HOSTS: Final = 32
MOST_VEHICLES: Final = 50
DATABASES: Final = ("database-a", "database-b")
WITNESS: Final = "witness"
HUB: Final = "hub"
BUCKET: Final = "bucket"
OF_REGION: Final = ("router", "tiles", "shard")
"""What every region has."""
ROUTER_PORT: Final = 7447
HUB_PORT: Final = 7448
DATABASE_PORT: Final = 5432
WITNESS_PORT: Final = 5433
BUCKET_PORT: Final = 8333


@dataclass(frozen=True, slots=True)
class HostsSize:
    """How large the laboratory is.

    Attributes:
        regions: at least 1; each has a router, a tile server and a shard.
        hosts: at least 2, and one for each region.
        vehicles: of each region.
        has_bucket: whether the bodies of tiles lie in a bucket on one of the hosts, not in the database.
        is_secure: whether all have certificates, and the bus has TLS, rights and seals.
    """

    regions: int = 2
    hosts: int = 4
    vehicles: int = 2
    has_bucket: bool = False
    is_secure: bool = False

    def __post_init__(self) -> None:
        if not 2 <= self.hosts <= MOST_HOSTS:
            raise LabError(f"{self.hosts} hosts: a database and its standby need 2, and {MOST_HOSTS} is the most")
        if not 1 <= self.regions <= self.hosts:
            raise LabError(f"{self.regions} regions on {self.hosts} hosts: it must be 1 to the number of hosts")
        if not 1 <= self.vehicles <= MOST_VEHICLES:
            raise LabError(f"{self.vehicles} vehicles a region: it must be 1 to {MOST_VEHICLES}")


@dataclass(frozen=True, slots=True)
class LabHost:
    """One host: a network namespace with one interface.

    Attributes:
        lab: name of the laboratory.
        number: from 0.
        region: where it stands.
        parts: what runs on it.
    """

    lab: str
    number: int
    region: int
    parts: tuple[str, ...] = field(default=())

    @property
    def name(self) -> str:
        """As reports name it."""
        return f"host-{self.number}"

    @property
    def namespace(self) -> str:
        """Its network namespace."""
        return namespace_name(self.lab, self.name)

    @property
    def device(self) -> str:
        """The end of its cable in the middle."""
        return f"h{self.number}"

    @property
    def address(self) -> str:
        """Its address; 198.18.0.0/15 is set aside for measurements (RFC 2544)."""
        return f"198.19.{self.number}.2"

    @property
    def gateway(self) -> str:
        """The address of the other end of its cable."""
        return f"198.19.{self.number}.1"


@dataclass(frozen=True, slots=True)
class HostsPlan:
    """All hosts with their parts.

    Attributes:
        size: of the laboratory.
        hosts: in the order of their numbers.
    """

    size: HostsSize
    hosts: tuple[LabHost, ...]

    def host_of(self, part: str) -> LabHost:
        """Where a part runs; KeyError: nowhere."""
        for host in self.hosts:
            if part in host.parts:
                return host
        raise KeyError(part)

    @property
    def has_witness(self) -> bool:
        """Whether a third host decides who may go on when the two databases do not see each other."""
        return any(WITNESS in host.parts for host in self.hosts)

    def in_region(self, region: int) -> tuple[LabHost, ...]:
        """The hosts of a region."""
        return tuple(host for host in self.hosts if host.region == region)

    @property
    def hub(self) -> str:
        """Endpoint of the hub."""
        return self._endpoint(HUB, HUB_PORT)

    def router(self, region: int) -> str:
        """Endpoint of a region's router."""
        return self._endpoint(f"router-{region}", ROUTER_PORT)

    def _endpoint(self, part: str, port: int) -> str:
        return f"{'tls' if self.size.is_secure else 'tcp'}/{self.host_of(part).address}:{port}"

    def routers(self, region: int) -> tuple[str, ...]:
        """Endpoints of a region's clients, in order: its own router, the hub, the routers of other regions."""
        others = (self.router(other) for other in range(self.size.regions) if other != region)
        return self.router(region), self.hub, *others

    @property
    def database_url(self) -> str:
        """The store, on whichever of the two hosts takes writes; a host that is silent is given up within seconds."""
        hosts = ",".join(f"{self.host_of(part).address}:{DATABASE_PORT}" for part in DATABASES)
        words = (
            "target_session_attrs=read-write", "connect_timeout=2", "tcp_user_timeout=1000",
            "keepalives_idle=1", "keepalives_interval=1", "keepalives_count=1",
        )  # fmt: skip
        return f"postgresql://gnd@{hosts}/gnd?{'&'.join(words)}"


def client_names(plan: HostsPlan, region: int) -> tuple[str, ...]:
    """The clients of a region: its vehicles, then who asks for tiles."""
    return (*(f"vehicle-{region}-{n}" for n in range(plan.size.vehicles)), f"asker-{region}")


def plan_hosts(lab: str, size: HostsSize) -> HostsPlan:
    """Spread the parts over the hosts.

    Hosts are shared out among the regions in order. The database's two sides come first, in the first region where it
    has two hosts; then what belongs to a region, each on the host of its region that has least to do and no database
    if there is one; the hub beside the last region's router, so that no tile server is lost with the way to the
    others; a bucket, if there is one, and a witness where least is to do and no database is. Without a third host there
    is no witness.

    Args:
        lab: name of the laboratory.
        size: of it.

    Raises:
        LabError: no lab can have this name.
    """
    check_lab_name(lab)
    regions = [number * size.regions // size.hosts for number in range(size.hosts)]
    placed: list[tuple[str, int]] = [(DATABASES[0], 0), (DATABASES[1], 1)]
    for region in range(size.regions):
        own = [number for number, where in enumerate(regions) if where == region]
        placed += _spread([f"{part}-{region}" for part in OF_REGION], own, placed)
    placed.append((HUB, dict(placed)[f"router-{size.regions - 1}"]))
    if size.has_bucket:
        placed += _spread([BUCKET], range(size.hosts), placed)
    if size.hosts > len(DATABASES):
        placed += _spread([WITNESS], range(len(DATABASES), size.hosts), placed)
    hosts = (
        LabHost(lab, number, region, tuple(part for part, where in placed if where == number))
        for number, region in enumerate(regions)
    )
    return HostsPlan(size, tuple(hosts))


def _spread(parts: Sequence[str], hosts: Sequence[int], placed: Sequence[tuple[str, int]]) -> list[tuple[str, int]]:
    """Each part to the host that has least to do, those with a database last."""
    load = Counter(where for _, where in placed)
    taken = {where for part, where in placed if part in DATABASES}
    found: list[tuple[str, int]] = []
    for part in parts:
        where = min(hosts, key=lambda host: (host in taken, load[host], host))
        load[where] += 1
        found.append((part, where))
    return found
