"""Where the processes of a fleet run: all on the loopback interface, or each vehicle behind a link of its own."""

from dataclasses import dataclass
from pathlib import Path

from gnd.deploy.fleet_config import FleetConfig
from gnd.deploy.ports import claim_port
from gnd.deploy.processes import ProcessSpec
from gnd.fleet_bus.links import LinkProfile


@dataclass(frozen=True, slots=True)
class VehicleSite:
    """Where one vehicle is.

    Attributes:
        connect: the router's endpoint as this vehicle reaches it.
        link: profile of its link.
        namespace: the network namespace of its process, None for the launcher's own.
    """

    connect: str
    link: str | LinkProfile
    namespace: str | None = None


@dataclass(frozen=True, slots=True)
class SiteFrame:
    """Where the cloud is, and each vehicle.

    Attributes:
        listen: endpoint that the router opens.
        connect: the same as the cloud's other processes and the launcher reach it.
        vehicles: where each vehicle is, by its number.
        namespace: the network namespace of the cloud's processes, None for the launcher's own.
        carriers: processes that carry the links; they begin first and end last. Names begin with "link-".
        identities: folder that holds the identity of each process by its name, and that of the launcher ("fleet");
            None: the fleet is plain.
    """

    listen: str
    connect: str
    vehicles: tuple[VehicleSite, ...]
    namespace: str | None = None
    carriers: tuple[ProcessSpec, ...] = ()
    identities: Path | None = None

    def identity_of(self, process: str) -> Path | None:
        """The identity folder of a process, None in a plain fleet."""
        return None if self.identities is None else self.identities / process


def loopback_site(config: FleetConfig, agents: int, identities: Path | None = None) -> SiteFrame:
    """Return a site on the loopback interface, where the sessions themselves imitate the link.

    Args:
        config: of the fleet.
        agents: number of vehicles.
        identities: folder of the processes' identities; None: plain.

    Raises:
        DeployError: the port is taken.
    """
    protocol = "tcp" if identities is None else "tls"
    endpoint = f"{protocol}/127.0.0.1:{claim_port(config.port)}"
    return SiteFrame(endpoint, endpoint, (VehicleSite(endpoint, config.link),) * agents, identities=identities)
